"""The description of a body, with facts that its MuJoCo file cannot hold."""

from contextlib import nullcontext
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import mujoco

from torchrl_mcp.envs.characters.contract import Violation, violations
from torchrl_mcp.envs.characters.mirror import SIDES, Sides


@dataclass(frozen=True)
class Character:
    """An articulated body under PD control.

    Its MJCF file holds the body alone, without floor, light or task, standing in its rest pose: x forward, y left, z
    up, soles on z = 0. The root has a free joint; every other body has one joint of its own name, ball or hinge, or is
    welded to its parent. A hinge has one ``position`` actuator of that name, a ball joint three, ``<name>_x``, ``_y``
    and ``_z``, which together are PD control of the exponential map; a joint without actuators is passive, and so is
    its twin on the other side. Shapes are spheres, capsules and boxes with
    ``contype=0 conaffinity=1``: they collide with a scene whose shapes have ``contype=1``, not with one another.

    Args:
        name: Name of the character and of its file.
        feet: Bodies that may touch the ground.
        key_bodies: Bodies whose positions best describe a pose: head, hands, feet.
        carrier: Body that picks up the box of the carry task, or None if there is none.
        file: MJCF file; None for the library's file of that name.
        sides: Beginnings or ends of bodies' names on the right and on the left, such as ``(("FR_", "FL_"),)``.
    """

    name: str
    feet: tuple[str, ...]
    key_bodies: tuple[str, ...]
    carrier: str | None
    file: Path | None = None
    sides: Sides = SIDES

    def spec(self, *, self_collision: bool = False) -> mujoco.MjSpec:
        """Return the body, for a scene.

        Args:
            self_collision: Let its bodies collide with one another, except bodies that a joint connects.
        """
        opened = nullcontext(self.file) if self.file else as_file(files(__package__) / f"{self.name}.xml")
        with opened as path:
            spec = mujoco.MjSpec.from_file(str(path))
        for geom in spec.geoms:
            if self_collision and geom.conaffinity:
                geom.contype = 1
        return spec

    def check(self) -> list[Violation]:
        """Return the body's violations of the contract above, each with its remedy; empty if there are none."""
        return violations(
            self.spec(), feet=self.feet, key_bodies=self.key_bodies, carrier=self.carrier, sides=self.sides
        )
