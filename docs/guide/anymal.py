"""Isaac Lab's quadruped ANYmal, whose goal is the commanded velocity."""

from isaaclab.app import AppLauncher

AppLauncher(headless=True)  # before anything else of Isaac Lab is imported

import gymnasium  # noqa: E402
import isaaclab_tasks  # noqa: E402, F401
from isaaclab_tasks.utils import parse_env_cfg  # noqa: E402
from torchrl.envs import CatTensors, EnvBase, IsaacLabWrapper  # noqa: E402

from torchrl_mcp.adapters.autoreset import RepeatObservation  # noqa: E402

STATE = ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel", "actions")
GOAL = ("velocity_commands",)


def make(
    num_envs: int,
    seed: int | None = None,
    speed: tuple[float, float] = (-1.0, 1.0),
    device: str = "cuda:0",
    task: str = "Isaac-Velocity-Flat-Anymal-C-v0",
) -> EnvBase:
    """Make quadrupeds.

    Args:
        num_envs: Number of quadrupeds.
        seed: Seed.
        speed: Slowest and fastest commanded speed, forwards, in m/s.
        device: Device of the simulation, the same as that of the training.
        task: Name of the task.
    """
    cfg = parse_env_cfg(task, device=device, num_envs=num_envs)
    cfg.seed = seed
    cfg.commands.base_velocity.ranges.lin_vel_x = tuple(speed)
    cfg.observations.policy.concatenate_terms = False
    env = IsaacLabWrapper(gymnasium.make(task, cfg=cfg).unwrapped, device=device)
    env.append_transform(CatTensors([("policy", name) for name in STATE], "observation", sort=False))
    env.append_transform(CatTensors([("policy", name) for name in GOAL], "goal", sort=False))
    return env.append_transform(RepeatObservation())
