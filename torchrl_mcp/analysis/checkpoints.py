"""Computes the data of the paper's figures from checkpoints: walks, random exploration, and trajectories."""

import dataclasses
import math
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase

from torchrl_mcp.analysis.holdout import Trajectories, play_directions
from torchrl_mcp.analysis.walks import Walk, record_walk, specialisation
from torchrl_mcp.envs import CharacterEnv, Heading, Imitation
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions.single import single_motion
from torchrl_mcp.methods.actor import PRIMITIVES, Explorer
from torchrl_mcp.runs import build, policies
from torchrl_mcp.training import checkpoint, run_folder

UNTRAINED = 10
"""Number of untrained networks whose mean is compared with trained networks."""

SPACING = math.radians(7.5)
"""Angle between the target directions of trajectories, in radians."""


def walk_of(
    path: Path, *, clip: str | None, walkers: int, seconds: float, seed: int
) -> tuple[Walk, Mapping[str, float]]:
    """Return a walk of an imitation checkpoint, and the specialisation of untrained networks on the same states.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        clip: Name of the generated motion to follow, or None for walking straight ahead.
        walkers: Number of simulations.
        seconds: Duration of the walk in seconds.
        seed: Seed of the environments.

    Returns:
        The walk, and the mean :func:`~torchrl_mcp.analysis.walks.specialisation` of untrained networks.

    Raises:
        ValueError: If the run has another task than imitation or no weights of primitives, or the policy cannot walk.
    """
    cfg = policies.policy_config(path)
    if cfg.task.name != "imitation":
        raise ValueError(
            f"{path} has task={cfg.task.name}, but Figure 7 shows pre-training: pass a run of task=imitation"
        )
    _, agent, env = policies.restore(path, num_envs=1, seed=seed)
    if "gates" not in agent.actor.stored:
        raise ValueError(f"{path} has method={cfg.method.name}, which has no gate: pass a run of a method with a gate")
    clips = single_motion(cfg.character.name, clip)
    limit = math.ceil(seconds / env.control_timestep) + 1  # the task's own limit would end the walk after 10 s
    endless = {"switch_interval": math.inf, "max_episode_steps": limit}
    cfg, agent, env = policies.restore(path, num_envs=walkers, seed=seed, clips=clips, **endless)
    walk = record_walk(agent.actor.policy, cast("Imitation", env), seconds=seconds)
    return walk, untrained(cfg, agent, cast("Imitation", env), walk)


@torch.no_grad()
def untrained(cfg: DictConfig, agent: build.Agent, env: CharacterEnv, walk: Walk) -> Mapping[str, float]:
    """Return the mean specialisation of :data:`UNTRAINED` untrained networks in the states of a walk.

    Args:
        cfg: Configuration of the run.
        agent: The trained agent, whose normalisers the untrained networks use.
        env: Environments of the run's task.
        walk: Walk of the trained agent.
    """
    numbers = []
    for seed in range(UNTRAINED):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            untrained_agent = build.make_agent(cfg, env)
        for name in ("observation_normaliser", "goal_normaliser"):
            untrained_agent.parts[name].load_state_dict(agent.parts[name].state_dict())
        outputs = untrained_agent.actor.policy(walk.inputs.clone())
        gates = outputs["gates"].double().numpy()
        actions = outputs[PRIMITIVES[0]].double().numpy()
        numbers.append(specialisation(dataclasses.replace(walk, gates=gates, actions=actions)))
    return {key: statistics.mean(row[key] for row in numbers) for key in numbers[0]}


def explorer(cfg: DictConfig, agent: build.Agent, num: int, generator: torch.Generator) -> Explorer:
    """Return the random explorer of a method, as in Section 5.3.

    Args:
        cfg: Configuration of the run.
        agent: Networks of the run.
        num: Number of simulations.
        generator: Source of randomness.

    Raises:
        ValueError: If the method has no explorer.
    """
    if cfg.method.explorer is None:
        raise ValueError(
            f"method={cfg.method.name} has nothing to combine at random: pass checkpoints of methods that have a "
            "method.explorer, such as mcp. The figure always includes noise on actions, the exploration of scratch"
        )
    return build.instantiate(cfg.method.explorer)(agent.parts, num, generator)


def explorer_title(cfg: DictConfig) -> str:
    """Return a method's title and the name of the function that makes its explorer, as in ``MCP, random weights``."""
    function = cfg.method.explorer._target_.rpartition(".")[2]
    return f"{cfg.method.title}, {function.replace('_', ' ')}"


def ground(cfg: DictConfig, num: int, *, seconds: float, seed: int) -> tuple[CharacterEnv, TensorDictBase]:
    """Return environments for exploration and their common initial state.

    Characters of this library begin in the middle of a walk. Episodes end with a fall or at the time limit.

    Args:
        cfg: Configuration of a run with the character.
        num: Number of simulations.
        seconds: Duration of an episode in seconds.
        seed: Seed of the environments.

    Raises:
        ValueError: If the environments of the run have no character.
    """
    name = cfg.character.name
    if name in CHARACTERS:
        env: CharacterEnv = Heading(name, num, seed=seed, num_threads=cfg.num_threads)
        moment = single_motion(name).at(torch.zeros(num, dtype=torch.int64), torch.zeros(num)).moment
        start = {"qpos": moment.qpos, "qvel": moment.qvel}
    else:
        plain = OmegaConf.merge(cfg, {"transforms": []})
        env = cast("CharacterEnv", build.make_env(cast("DictConfig", plain), num_envs=num, seed=seed))
        if not isinstance(env, CharacterEnv):
            raise ValueError(
                f"{type(env).__name__} has no character whose path could be drawn: pass runs of characters"
            )
        env.reset()
        start = {key: env.get_state()[key][:1].repeat(num, 1) for key in ("qpos", "qvel")}
    env.max_episode_steps = round(seconds / env.control_timestep)
    return env, TensorDict(start, env.batch_size)


def trajectories(path: Path, *, seed: int) -> dict[str, Trajectories]:
    """Return trajectories of a holdout policy on held-out directions, and for pre-training also on seen directions.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        seed: Seed of the environments.

    Returns:
        Trajectories by title. The title names stage and directions, and marks runs that are still training.
    """
    cfg = policies.policy_config(path)
    panels = {}
    steps = run_folder.frames(checkpoint.find(path))
    finished = steps < 0 or steps >= cfg.training.total_frames  # a file without a number of steps was published
    pretrained = cfg.stage.name == "pretrain"
    for shown in ("pretrain", "transfer") if pretrained else ("transfer",):
        low, high = cfg.task.directions[shown]
        directions = torch.linspace(low, high, round((high - low) / SPACING) + 1, dtype=torch.float64)
        _, agent, env = policies.restore(path, num_envs=len(directions), seed=seed)
        kind = "on directions it saw" if shown == "pretrain" else "on held-out directions"
        panels[f"{_stage(pretrained, finished)},\n{kind}"] = play_directions(agent.actor.policy, env, directions)
    return panels


def _stage(pretrained: bool, finished: bool) -> str:
    """Return the beginning of a title, which tells the stage of a run and whether it is finished."""
    if pretrained:
        return "as pre-trained" if finished else "in pre-training"
    return "after transfer" if finished else "in transfer"
