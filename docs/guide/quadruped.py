"""mjlab's quadruped Go1, whose goal is the commanded velocity."""

from dataclasses import replace

from mjlab.tasks.registry import load_env_cfg
from torchrl.envs import EnvBase, MJLabEnv


def make(
    num_envs: int,
    seed: int | None = None,
    speed: tuple[float, float] = (-1.0, 1.0),
    device: str = "cuda:0",
    task: str = "Mjlab-Velocity-Flat-Unitree-Go1",
) -> EnvBase:
    """Make quadrupeds.

    Args:
        num_envs: Number of quadrupeds.
        seed: Seed, which also draws what differs from robot to robot, such as the friction of the feet.
        speed: Slowest and fastest commanded speed, forwards, in m/s.
        device: Device of the simulation, the same as that of the training.
        task: Name of the task.
    """
    cfg = load_env_cfg(task)
    cfg.seed = seed
    cfg.commands["twist"].ranges.lin_vel_x = tuple(speed)
    actor = cfg.observations["actor"]
    command = actor.terms.pop("command")
    cfg.observations = {"observation": actor, "goal": replace(actor, terms={"command": command})}
    return MJLabEnv(task, cfg=cfg, num_envs=num_envs, device=device)
