"""Gymnasium's Ant."""

from importlib.resources import as_file, files

import mujoco


def ant() -> mujoco.MjSpec:
    """The ant of Gymnasium's Ant-v5, read from the installed Gymnasium: 14 degrees of freedom, 8 motors.

    The file includes floor and light. Physics runs at 100 Hz; Gymnasium acts on every fifth step.

    Reference:
        Schulman et al., High-Dimensional Continuous Control Using Generalized Advantage Estimation, 2015;
        https://gymnasium.farama.org/environments/mujoco/ant/
    """
    with as_file(files("gymnasium") / "envs/mujoco/assets/ant.xml") as path:
        return mujoco.MjSpec.from_file(str(path))
