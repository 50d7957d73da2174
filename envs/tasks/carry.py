"""The carry task: bring a box from one table to another."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.rotations import about_z, heading, inverse, multiply, rotate
from torchrl_mcp.envs.steering import UserGoal
from torchrl_mcp.envs.tasks.objects import SceneObject, Weld, horizontal_extent, sensors
from torchrl_mcp.envs.tasks.tables import (
    CLEARANCE,
    GAP,
    HALF_SIZE,
    JOINT,
    TOP_HALF_SIZE,
    add_box,
    add_joint,
    add_table,
    height_of,
)
from torchrl_mcp.envs.tasks.transport import Transport
from torchrl_mcp.envs.tasks.waypoints import carry_waypoint, place_seen
from torchrl_mcp.values import Count

RESTING_GAP = 0.01
"""Largest distance in metres between box and top at which the box stands on the top."""

RELEASE_GAP = CLEARANCE + RESTING_GAP
"""Largest distance in metres between box and top at which the joint opens, reached at the box's initial height."""


class Carry(Transport):
    """A character takes a box from a source table to a target table.

    **Taking and releasing the box.** The character's ``carrier`` takes the box when it touches the box on the source.
    A joint then fixes the box to the carrier, and the source sinks by 10 cm. The joint opens when the centre of the box
    is over the target's top and less than 11 cm above it, and does not close again within the episode. A box that was
    knocked off the source cannot be taken.

    **Metrics.** ``box_taken`` (1, bool) says whether the box was taken in this episode. ``success`` (1, bool) says
    whether the box was taken and released and stands on the target, that is, less than 1 cm above its top.

    **Goal.** ``goal`` (27) has, in the character's heading frame and with positions in metres relative to the root:

    - position and orientation of the target table, whose position is the middle of its top,
    - position and orientation of the source table,
    - position, orientation, linear and angular velocity of the box.

    ``goal_layout`` has the names of these entries.

    **Scene.** The box on the source is level with the carrier's centre of mass in the rest pose. Tables hold the box,
    but characters pass through tables, because a top at waist height would be a wall. The carrier passes through the
    box, because contact would work against the joint. The tables stand apart, and the box begins where it does not
    touch the character: the lower bounds of ``object_distances`` and ``target_distances`` are raised accordingly.

    **Reward.** By default, the reward is the paper's. Two variants of the same authors' public code are options: the
    distance to the target instead of its square, which still has a gradient at 10 m, and reward 1 while successful. A
    box at rest on the target earns at most 0.73 with the paper's reward, and 1 with the second variant. With
    ``reward_weights`` of a curriculum, training uses :func:`~torchrl_mcp.envs.tasks.rewards.training_reward`.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.tasks.transport.Transport`, where the arguments are described.

    Raises:
        ValueError: If an argument is out of range, or the character has no carrier.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> from torchrl_mcp.envs import Carry
        >>> env = Carry("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "goal"].shape
        torch.Size([2, 3, 27])
    """

    objects: ClassVar[Mapping[str, int]] = {"target": 7, "source": 7, "box": 13}
    weights = (0.1, 0.2, 0.3, 0.4)
    proximity_scale = 0.25
    success_distance = TOP_HALF_SIZE

    def __init__(self, character: str, num_envs: Count, **kwargs: Any) -> None:
        super().__init__(
            character,
            num_envs,
            furnish=self._furnish,
            model_fields=["eq_data"],
            episode={"taken": torch.zeros((), dtype=torch.bool)},
            **kwargs,
        )
        self.begin_with("box", "target")
        self.source = SceneObject(self.simulation, "source")
        self._keep_clear()
        self._carrier = SceneObject(self.simulation, str(self.character.carrier))
        self._joint = Weld(self.simulation, JOINT)
        self._gaps = sensors(self.simulation, GAP)
        box = self.simulation.model.geom("box").id
        self._vertical = self.simulation.outputs["geom_xmat"][:, box, 6:]  # components of the box's axes along z
        self.make_specs()

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The box on the source, and the target, at drawn places; both tables, and the box, face anywhere."""
        start = super().initial_state(num)
        angles = torch.rand(num, 2, dtype=torch.float64, device=self.device, generator=self.generator)
        turns = about_z(2 * math.pi * angles)
        self.target.put(start, orientation=turns[:, 0])
        self.source.put(start, self.object.place(start), turns[:, 1])
        self.object.put(start, orientation=turns[:, 1])
        return start

    def after_step(self, diverged: Tensor) -> None:
        """Fix the box to a carrier that touches it on the source, which sinks, and let it go over the target."""
        touching = (self._gaps <= 0).any(-1) & ~self.episode["taken"]
        closing = self._over(touching, self.source, RESTING_GAP)
        opening = self._over(self._joint.active == 1, self.target, RELEASE_GAP)
        if len(closing):
            self._joint.pose[closing] = relative_pose(
                *(part[closing] for part in (*self._carrier.pose, *self.object.pose))
            )
            self._joint.active[closing] = 1
            self.episode["taken"][closing] = True
            self.source.next_position[closing, 2] -= CLEARANCE
        self._joint.active[opening] = 0

    def offer(self, index: int) -> None:
        """Lift a box that was let go onto the source, where it lies, so that it can be taken again.

        Args:
            index: The simulation. Nothing changes if its box is held or was never taken.
        """
        if not self.episode["taken"][index] or self._joint.active[index]:
            return
        box = self.object
        turn = about_z(heading(box.next_orientation[index]))
        self.source.next_position[index, :2] = box.next_position[index, :2]
        self.source.next_position[index, 2] = self.source.rest[2]
        self.source.next_orientation[index] = turn
        box.next_orientation[index] = turn
        box.next_position[index, 2] = self.source.rest[2] + HALF_SIZE
        box.next_velocity[index] = 0.0
        self.episode["taken"][index] = False

    def steer(self, goal: UserGoal) -> None:
        """See :meth:`.CharacterEnv.steer`: a box that was put down is taken again once the target moves."""
        if goal.place is not None and tuple(self.target.next_position[0, :2].tolist()) != goal.place:
            self.offer(0)
        super().steer(goal)

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, and where it sees tables and box."""
        state, objects = self.see(ids)
        return {
            "observation": state,
            "goal": self.goal(objects, ids),
            "success": self.success()[ids].unsqueeze(-1),
            "box_taken": self.episode["taken"][ids].unsqueeze(-1),
        }

    def waypoint_seen(self, ids: Tensor | slice) -> Tensor:
        """See :func:`.carry_waypoint`."""
        com, _, box, _, target = self.motion()
        place = carry_waypoint(com, box, target, self.episode["taken"], self._joint.active == 1)
        return place_seen(self, place, ids)

    def success(self) -> Tensor:
        """Whether the box was taken, is no longer held and stands on the target, shape ``(N,)``, bool."""
        put_down = self.episode["taken"] & (self._joint.active == 0)
        success = torch.zeros_like(put_down)
        success[self._over(put_down, self.target, RESTING_GAP)] = True
        return success

    def _over(self, candidates: Tensor, table: SceneObject, gap: float) -> Tensor:
        """Simulations among ``candidates``, ``(N,)`` bool, in which the box is over a table, ``(n,)``.

        The lowest point of the box is less than ``gap`` metres above the top.
        """
        ids = candidates.nonzero().squeeze(-1)
        if not len(ids):
            return ids
        from_middle = rotate(inverse(table.orientation[ids]), self.object.position[ids] - table.position[ids])
        above = from_middle[:, 2] - HALF_SIZE * self._vertical[ids].abs().sum(-1)
        return ids[(from_middle[:, :2].abs() < TOP_HALF_SIZE).all(-1) & (from_middle[:, 2] > 0) & (above < gap)]

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Add tables, box and the joint between carrier and box to the scene."""
        carrier = self.character.carrier
        if carrier is None:
            able = ", ".join(name for name, character in CHARACTERS.items() if character.carrier)
            raise ValueError(f"character={self.character.name!r} has no body to carry a box with: pass one of {able}")
        height = height_of(spec, carrier)
        add_table(spec, "target", height - HALF_SIZE - CLEARANCE, rgba=(0.75, 0.2, 0.15, 1.0))
        add_table(spec, "source", height - HALF_SIZE, rgba=(0.3, 0.45, 0.6, 1.0))
        add_box(spec, height)
        add_joint(spec, carrier)

    def _keep_clear(self) -> None:
        """Let the box begin where it touches no character, and the tables apart."""
        width = math.sqrt(2) * HALF_SIZE
        top = float(self.source.rest[2])
        poses = self.initial_states.poses()
        extent = horizontal_extent(self.simulation.model, len(self._bodies), poses, top, top + 2 * HALF_SIZE)
        self.ranges.keep_clear("object_distances", width + extent)
        self.ranges.keep_clear("target_distances", 2 * width)
        self.ranges.to(self.device)


def relative_pose(position: Tensor, orientation: Tensor, other_position: Tensor, other_orientation: Tensor) -> Tensor:
    """Another body's position and orientation in a body's frame, shape ``(*B, 7)``."""
    back = inverse(orientation)
    return torch.cat([rotate(back, other_position - position), multiply(back, other_orientation)], -1)
