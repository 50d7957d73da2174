"""A stand-in for Isaac Lab: a batch on a line that resets its environments itself, with Isaac Lab's names and types."""

import sys
from types import ModuleType, SimpleNamespace

import gymnasium
import numpy as np
import torch
from torchrl.envs.libs import gym, isaac_lab

ACTIONS = 2
LIMIT = 6
"""Steps of an episode."""
SIZES = {
    "base_lin_vel": 3,
    "base_ang_vel": 3,
    "projected_gravity": 3,
    "velocity_commands": 3,
    "joint_pos": ACTIONS,
    "joint_vel": ACTIONS,
    "actions": ACTIONS,
}
"""Entries of the terms of ``policy``, in Isaac Lab's order."""
TASK = "Isaac-Velocity-Flat-Anymal-C-v0"


class ManagerBasedEnv:
    """Isaac Lab's base class, of which one instance may exist in a process."""

    open = 0

    def __init__(self):
        if ManagerBasedEnv.open:
            raise RuntimeError("Simulation context already exists. Cannot create a new one.")
        ManagerBasedEnv.open += 1

    def close(self):
        ManagerBasedEnv.open = 0


class Line(ManagerBasedEnv, gymnasium.Env):
    """Points that move by the first action times 0.5, and fall beyond 1 from the origin.

    ``joint_pos`` has the place and the number of steps in the episode, ``base_lin_vel`` the number of the environment.
    """

    is_vector_env = True
    metadata = {"render_modes": [None, "human", "rgb_array"]}  # noqa: RUF012
    max_episode_length = LIMIT

    def __init__(self, cfg, render_mode=None):
        super().__init__()
        self.cfg = cfg
        self.device = cfg.sim.device
        self.num_envs = cfg.scene.num_envs
        assert not cfg.observations.policy.concatenate_terms
        terms = {name: gymnasium.spaces.Box(-np.inf, np.inf, (size,)) for name, size in SIZES.items()}
        self.single_observation_space = gymnasium.spaces.Dict(policy=gymnasium.spaces.Dict(terms))
        self.single_action_space = gymnasium.spaces.Box(-np.inf, np.inf, (ACTIONS,))
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)
        self.generator = torch.Generator().manual_seed(cfg.seed or 0)
        self.x = torch.zeros(self.num_envs)
        self.commands = torch.zeros(self.num_envs, 3)
        self.last_action = torch.zeros(self.num_envs, ACTIONS)
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.extras = {}

    def reset(self, seed=None, env_ids=None, options=None):
        if seed is not None:
            self.generator.manual_seed(seed)
        self._reset_idx(torch.arange(self.num_envs) if env_ids is None else env_ids)
        return self._observe(), self.extras

    def step(self, action):
        self.last_action = action.clone()
        self.x += 0.5 * action[:, 0]
        self.episode_length_buf += 1
        terminated = self.x.abs() > 1.0
        time_outs = self.episode_length_buf >= self.max_episode_length
        reward = self.x.clone()
        if (ended := (terminated | time_outs).nonzero().squeeze(-1)).numel():
            self._reset_idx(ended)
        self.extras["time_outs"] = time_outs
        return self._observe(), reward, terminated, time_outs, self.extras

    def _reset_idx(self, numbers):
        low, high = self.cfg.commands.base_velocity.ranges.lin_vel_x
        drawn = torch.rand(len(numbers), 2, generator=self.generator)
        self.x[numbers] = 0.1 * drawn[:, 0]
        self.commands[numbers, 0] = low + (high - low) * drawn[:, 1]
        self.last_action[numbers] = 0.0
        self.episode_length_buf[numbers] = 0
        self.extras["log"] = {"Episode_Termination/time_out": 0.0}

    def _observe(self):
        terms = {name: torch.zeros(self.num_envs, size) for name, size in SIZES.items()}
        terms["base_lin_vel"] += torch.arange(self.num_envs).unsqueeze(-1)
        terms["velocity_commands"] += self.commands
        terms["joint_pos"] += torch.stack([self.x, self.episode_length_buf], -1)
        terms["actions"] += self.last_action
        return {"policy": terms}


def parse_env_cfg(task_name, device="cuda:0", num_envs=None, use_fabric=None):
    """Return the configuration of the task."""
    assert task_name == TASK
    ranges = SimpleNamespace(lin_vel_x=(-1.0, 1.0))
    return SimpleNamespace(
        seed=None,
        sim=SimpleNamespace(device=device),
        scene=SimpleNamespace(num_envs=num_envs),
        commands=SimpleNamespace(base_velocity=SimpleNamespace(ranges=ranges)),
        observations=SimpleNamespace(policy=SimpleNamespace(concatenate_terms=True)),
    )


def install(monkeypatch):
    """Let Python and TorchRL find the stand-in as Isaac Lab."""
    modules = {
        "isaaclab": {},
        "isaaclab.app": {"AppLauncher": lambda headless: None},
        "isaaclab.envs": {
            "ManagerBasedEnv": ManagerBasedEnv,
            "DirectRLEnv": type("DirectRLEnv", (), {}),
            "DirectMARLEnv": type("DirectMARLEnv", (), {}),
        },
        "isaaclab_tasks": {},
        "isaaclab_tasks.utils": {"parse_env_cfg": parse_env_cfg},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    for module in (gym, isaac_lab):
        monkeypatch.setattr(module, "_has_isaaclab", True)
    monkeypatch.setattr(ManagerBasedEnv, "open", 0)
    monkeypatch.delitem(sys.modules, "anymal", raising=False)


gymnasium.register(TASK, entry_point=Line, disable_env_checker=True)
