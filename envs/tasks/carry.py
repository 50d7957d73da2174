"""The carry task: bring a box from one table to another."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.rotations import about_z, heading, inverse, multiply, rotate
from torchrl_mcp.envs.tasks.rewards import transport_reward
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
from torchrl_mcp.envs.tasks.transport import (
    ANY_DIRECTION,
    goal_of,
    horizontal_extent,
    mocap_positions,
    placement,
    places,
)
from torchrl_mcp.envs.tasks.transport_env import Transport
from torchrl_mcp.envs.tasks.waypoints import carry_waypoint, place_seen

OBJECTS = {"target": 7, "source": 7, "box": 13}
"""The objects in the order of the scene: target table, source table and box. How many numbers the goal has of each:
position (3), orientation (4), linear (3) and angular velocity (3)."""

RESTING_GAP = 0.01
"""Largest distance in metres between box and top at which the box stands on the top."""

RELEASE_GAP = CLEARANCE + RESTING_GAP
"""Largest distance in metres between box and top at which the joint opens, reached at the box's initial height."""


carry_reward = partial(transport_reward, weights=(0.1, 0.2, 0.3, 0.4), proximity_scale=0.25)
"""The reward with the weights of its four terms: the character's speed towards the box and its distance from the box,
and the speed of the box towards the target and its distance from the target."""


class Carry(Transport):
    """A character takes a box from a source table to a target table.

    The character's ``carrier`` takes the box by touching it while it stands on the source: a joint then fixes the box
    to the carrier, and the source sinks by 10 cm. The joint opens once the box is over the target, less than 11 cm
    above it, and does not close again within the episode. *Over* means that the centre of the box is over the top; a
    box *stands* there if its lowest point is less than 1 cm above it. A box that was knocked off the source cannot be
    taken. ``box_taken`` (1, bool) is whether the box was taken in this episode, and ``success`` (1, bool) whether it
    then was let go and stands on the target.

    ``goal`` (27) is position and orientation of the target table, of the source table and of the box, and linear and
    angular velocity of the box, in the character's heading frame, with positions relative to the root; ``goal_layout``
    has the names of its entries. A table's position is the middle of its top.

    At the source's height, the box is level with the carrier's centre of mass in the rest pose. Tables hold the box;
    characters pass through them, because a top at waist height would be a wall. The carrier passes through the box,
    because contact would work against the joint.

    The reward is by default as printed in the paper. Two variants of the same authors' public code are options: the
    distance to the target instead of its square, which still has a gradient at 10 m, and reward 1 while successful. A
    box at rest on the target has a printed reward of at most 0.73; with the second variant it is 1.

    With ``reward_weights`` of a curriculum, training uses
    :func:`~torchrl_mcp.envs.tasks.rewards.training_reward`, and a success ends the episode.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        object_distances: Range (lo, hi) of the box's distance from the character, in metres. The paper's begins at 0;
            here lo is raised until the box touches no character.
        object_directions: Range (lo, hi) of the direction of the box, in radians from the character's heading.
        target_distances: Range (lo, hi) of the target's distance from the box, in metres. The paper's begins at 0; here
            lo is raised until the tables are apart.
        target_directions: Range (lo, hi) of the direction from the box to the target, in radians from the direction of
            the box: 0 is straight beyond the box.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``. The paper speaks of thousands of steps;
            3000 are 100 s, as in the same authors' public code for a ball.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.tasks.transport_env.Transport`.

    Raises:
        ValueError: If an argument is out of range, or the character has no carrier.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> env = Carry("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "goal"].shape
        torch.Size([2, 3, 27])
    """

    objects = OBJECTS
    reward_of = staticmethod(carry_reward)
    success_distance = TOP_HALF_SIZE

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        object_distances: Sequence[float] = (0.0, 10.0),
        object_directions: Sequence[float] = ANY_DIRECTION,
        target_distances: Sequence[float] = (0.0, 10.0),
        target_directions: Sequence[float] = ANY_DIRECTION,
        max_episode_steps: int = 3000,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            character,
            num_envs,
            furnish=self._furnish,
            model_fields=["eq_data"],
            max_episode_steps=max_episode_steps,
            episode={"taken": torch.zeros((), dtype=torch.float64)},
            **kwargs,
        )
        self.ranges = placement(
            self.curriculum.mixture,
            object_distances=object_distances,
            object_directions=object_directions,
            target_distances=target_distances,
            target_directions=target_directions,
        )
        self._keep_clear()
        self.ranges.to(self.device)
        # Live views, made once.
        model, state, outputs = self.simulation.model, self.simulation.state, self.simulation.outputs
        self._carrier, self._box = self.pose(str(self.character.carrier)), self.pose("box")
        self._tables = {name: self.pose(name) for name in ("source", "target")}
        weld, names = model.equality(JOINT).id, [model.sensor(sensor).name for sensor in range(model.nsensor)]
        gaps = [int(model.sensor_adr[sensor]) for sensor, name in enumerate(names) if name.startswith(GAP)]
        self._vertical = outputs["geom_xmat"][:, model.geom("box").id, 6:]
        self._gaps = outputs["sensordata"][:, gaps[0] : gaps[-1] + 1]
        self._joined, self._joint = state["eq_active"][:, weld], state["eq_data"][:, weld, 3:10]
        self._source_height = state["mocap_pos"][:, 1, 2]
        self._object, self._target = self._box[0], self._tables["target"][0]
        self.track(object=self._object)
        self.make_specs()

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The box on the source, and the target, at drawn places; both tables, and the box, face anywhere."""
        start = super().initial_state(num)
        box, target = places(start["qpos"][:, :2], self.ranges.draw(num, self.generator))
        angles = torch.rand(num, 2, dtype=torch.float64, device=self.device, generator=self.generator)
        turns, tables = about_z(2 * math.pi * angles), self._marks.repeat(num, 1, 1)
        tables[:, :, :2] = torch.stack([target, box], 1)
        start["qpos"][:, -7:-5], start["qpos"][:, -4:] = box, turns[:, 1]
        return {**start, "mocap_pos": tables, "mocap_quat": turns}

    def after_step(self, diverged: Tensor) -> None:
        """Fix the box to a carrier that touches it on the source, which sinks, and let it go over the target."""
        touching = (self._gaps <= 0).any(-1) & (self.episode["taken"] == 0)
        closing = self._over(touching, "source", RESTING_GAP)
        opening = self._over(self._joined == 1, "target", RELEASE_GAP)
        if len(closing):
            self._joint[closing] = relative_pose(*(part[closing] for part in (*self._carrier, *self._box)))
            self._joined[closing] = self.episode["taken"][closing] = 1
            self._source_height[closing] -= CLEARANCE
        self._joined[opening] = 0

    def offer(self, index: int) -> None:
        """Lift a box that was let go onto the source, where it lies, so that it can be taken again.

        Args:
            index: The simulation. Nothing changes if its box is held or was never taken.
        """
        if not self.episode["taken"][index] or self._joined[index]:
            return
        state, height = self.simulation.state, float(self._marks[1, 2])
        place = state["qpos"][index, -7:-5].clone()
        turn = about_z(heading(state["qpos"][index, -4:]))
        state["mocap_pos"][index, 1] = torch.cat([place, place.new_tensor([height])])
        state["mocap_quat"][index, 1] = state["qpos"][index, -4:] = turn
        state["qpos"][index, -5], state["qvel"][index, -6:] = height + HALF_SIZE, 0.0
        self.episode["taken"][index] = 0

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, and where it sees tables and box."""
        state, objects = self.see(ids)
        return {
            "observation": state,
            "goal": goal_of(objects, self.objects, self.goal_positions, *self._waypoints(ids)),
            "success": self.success()[ids].unsqueeze(-1),
            "box_taken": self.episode["taken"][ids].bool().unsqueeze(-1),
        }

    def _waypoints(self, ids: Tensor | slice) -> list[Tensor]:
        """The places to go to next, if the goal has them."""
        if not self.waypoint:
            return []
        com, _, box, _, target = self._motion()
        taken, held = self.episode["taken"] == 1, self._joined == 1
        return [place_seen(self, carry_waypoint(com, box, target, taken, held), ids)]

    def success(self) -> Tensor:
        """Whether the box was taken, is no longer held and stands on the target, shape ``(N,)``, bool."""
        put_down = (self.episode["taken"] == 1) & (self._joined == 0)
        success = torch.zeros_like(put_down)
        success[self._over(put_down, "target", RESTING_GAP)] = True
        return success

    def _over(self, candidates: Tensor, table: str, gap: float) -> Tensor:
        """Simulations among ``candidates``, ``(N,)`` bool, in which the box is over a table, ``(n,)``.

        The lowest point of the box is less than ``gap`` metres above the top.
        """
        ids = candidates.nonzero().squeeze(-1)
        if not len(ids):
            return ids
        position, orientation = (part[ids] for part in self._tables[table])
        from_middle = rotate(inverse(orientation), self._box[0][ids] - position)
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
        model = self.simulation.model
        self._marks = mocap_positions(model).to(self.device)
        width, source = math.sqrt(2) * HALF_SIZE, float(self._marks[1, 2])
        extent = horizontal_extent(
            model, len(self._bodies), self.initial_states.poses(), source, source + 2 * HALF_SIZE
        )
        self.ranges.keep_clear("object_distances", width + extent)
        self.ranges.keep_clear("target_distances", 2 * width)


def relative_pose(position: Tensor, orientation: Tensor, other_position: Tensor, other_orientation: Tensor) -> Tensor:
    """Another body's position and orientation in a body's frame, shape ``(*B, 7)``."""
    back = inverse(orientation)
    return torch.cat([rotate(back, other_position - position), multiply(back, other_orientation)], -1)
