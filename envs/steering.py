"""The goal that a user sets while a policy plays."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Steerable:
    """The parts of a task's goal that a user can set in the first simulation, and their current values.

    Args:
        direction: Current target direction in radians from the world's x axis; None if the task has none.
        speed: Current target speed in m/s.
        speeds: Lowest and highest target speed in m/s; None if the speed cannot be set.
        place: Whether the task has a target that can be put somewhere.
    """

    direction: float | None = None
    speed: float = 0.0
    speeds: tuple[float, float] | None = None
    place: bool = False


@dataclass(frozen=True)
class UserGoal:
    """The goal that a user sets in the first simulation. A quantity that is None is left to the task.

    Args:
        direction: Target direction in radians from the world's x axis.
        speed: Target speed in m/s.
        place: Place of the target on the ground, x and y in metres.
    """

    direction: float | None = None
    speed: float | None = None
    place: tuple[float, float] | None = None
