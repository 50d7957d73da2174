"""The carry task: bring a box from one table to another."""

import math
from typing import Any

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.rewards import carry_reward
from torchrl_mcp.envs.rotations import about_z, inverse, multiply, rotate
from torchrl_mcp.envs.transport import Transport, mocap_positions

MASS = 5.0
"""Mass of the box, in kg. Paper: 5."""

# The paper states no sizes. The tops end just inside the box, so that a character at a table touches the box first.
HALF_SIZE = 0.15
TOP_HALF_SIZE = 0.14
TOP_THICKNESS = 0.03
DROP = 0.05
"""Metres by which the target's top is lower than the source's: a box carried at its initial height passes over it."""

TOP_CONTACT = 2
"""MuJoCo's contact bit of the tops, which only the box shares: for characters, tops would be walls."""

RESTING_GAP = 0.01
"""Largest distance in metres between box and top at which the box stands on the top."""

RELEASE_GAP = DROP + RESTING_GAP
"""Largest distance in metres between box and top at which the joint opens, reached at the box's initial height."""


class Carry(Transport):
    """A character takes a box from a source table to a target table.

    The character's ``carrier`` takes the box by touching it while it stands on the source: a joint then fixes the box
    to the carrier. The joint opens once the box is over the target, less than 6 cm above it, and does not close again
    within the episode. *Over* means that the centre of the box is over the top; a box *stands* there if its lowest
    point is less than 1 cm above it. A box that was knocked off the source cannot be taken. ``box_taken`` (1, bool) is
    whether the box was taken in this episode, and ``success`` whether it then was let go and stands on the target.

    ``goal`` (27) is position and orientation of the target table, of the source table and of the box, and linear and
    angular velocity of the box. A table's position is the middle of its top. See
    :class:`~torchrl_mcp.envs.transport.Transport` for the variants of the reward.

    At the source's height, the box is level with the carrier's centre of mass in the rest pose. Tables hold the box;
    characters pass through them, because a top at waist height would be a wall. The carrier passes through the box,
    because contact would work against the joint.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.transport.Transport`: distances, reward and time limit. The
            paper's distances begin at 0; here they begin where the box touches no character and the tables are apart.

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

    success_distance = TOP_HALF_SIZE

    def __init__(self, character: str, num_envs: int, **kwargs: Any) -> None:
        super().__init__(
            character,
            num_envs,
            things={"target": 7, "source": 7, "box": 13},
            furnish=self._furnish,
            reward=carry_reward,
            model_fields=["eq_data"],
            episode={"taken": torch.zeros((), dtype=torch.float64)},
            **kwargs,
        )
        model, outputs, state = self.simulation.model, self.simulation.outputs, self.simulation.state
        width, source = math.sqrt(2) * HALF_SIZE, float(mocap_positions(model)[1, 2])
        self.ranges.keep_clear("object_distances", width + self._extent(source, source + 2 * HALF_SIZE))
        self.ranges.keep_clear("target_distances", 2 * width)
        # Live views, made once.
        carrier = model.body(self.character.carrier).id
        self._carrier = outputs["xpos"][:, carrier], outputs["xquat"][:, carrier]
        self._box = self._things.positions[:, -1], self._things.orientations[:, -1]
        self._vertical, self._gaps = outputs["geom_xmat"][:, model.geom("box").id, 6:], outputs["sensordata"]
        self._joined, self._joint = state["eq_active"][:, 0], state["eq_data"][:, 0, 3:10]
        self._make_specs()

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        carrier = self.character.carrier
        if carrier is None:
            able = ", ".join(name for name, character in CHARACTERS.items() if character.carrier)
            raise ValueError(f"character={self.character.name!r} has no body to carry a box with: pass one of {able}")
        height = height_of(spec, carrier)
        add_table(spec, "target", height - HALF_SIZE - DROP, rgba=(0.75, 0.2, 0.15, 1.0))
        add_table(spec, "source", height - HALF_SIZE, rgba=(0.3, 0.45, 0.6, 1.0))
        add_box(spec, height)
        add_joint(spec, carrier)

    def _sample(self, num: int) -> dict[str, Tensor]:
        start = super()._sample(num)
        box = start["qpos"][:, -7:]
        start["mocap_pos"][:, 1, :2] = box[:, :2]
        angles = torch.rand(num, 2, dtype=torch.float64, device=self.device, generator=self.generator)
        turns = about_z(2 * math.pi * angles)
        box[:, 3:] = turns[:, 1]
        return {**start, "mocap_quat": turns}

    def _begin(self, ids: Tensor) -> dict[str, Tensor]:
        return {**super()._begin(ids), "taken": torch.zeros_like(self.episode["taken"][ids])}

    def _show(self, ids: Tensor | slice) -> dict[str, Tensor]:
        return {**super()._show(ids), "box_taken": self.episode["taken"][ids].bool().unsqueeze(-1)}

    def _rewards(self) -> Tensor:
        rewards = super()._rewards()
        touching = (self._gaps <= 0).any(-1) & (self.episode["taken"] == 0)
        closing = self._over(touching, "source", RESTING_GAP)
        opening = self._over(self._joined == 1, "target", RELEASE_GAP)
        if len(closing):
            self._joint[closing] = relative_pose(*(part[closing] for part in (*self._carrier, *self._box)))
            self._joined[closing] = self.episode["taken"][closing] = 1
        self._joined[opening] = 0
        return rewards

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
        position, orientation = (part[ids, list(self._shown).index(table)] for part in self._things[:2])
        from_middle = rotate(inverse(orientation), self._object[ids] - position)
        above = from_middle[:, 2] - HALF_SIZE * self._vertical[ids].abs().sum(-1)
        return ids[(from_middle[:, :2].abs() < TOP_HALF_SIZE).all(-1) & (from_middle[:, 2] > 0) & (above < gap)]


def relative_pose(position: Tensor, orientation: Tensor, other_position: Tensor, other_orientation: Tensor) -> Tensor:
    """Another body's position and orientation in a body's frame, shape ``(*B, 7)``."""
    back = inverse(orientation)
    return torch.cat([rotate(back, other_position - position), multiply(back, other_orientation)], -1)


def height_of(spec: mujoco.MjSpec, body: str) -> float:
    """Height of a body's centre of mass in the rest pose, in metres."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return float(data.body(body).xipos[2])


def add_table(spec: mujoco.MjSpec, name: str, height: float, rgba: tuple[float, float, float, float]) -> None:
    """Add a table; its position is the middle of its top, ``height`` above the ground."""
    table, box = spec.worldbody.add_body(name=name, mocap=True, pos=[0, 0, height]), mujoco.mjtGeom.mjGEOM_BOX
    top, leg = TOP_THICKNESS / 2, (height - TOP_THICKNESS) / 2
    size = [TOP_HALF_SIZE, TOP_HALF_SIZE, top]
    table.add_geom(type=box, size=size, pos=[0, 0, -top], rgba=rgba, contype=TOP_CONTACT, conaffinity=0)
    place = [0, 0, leg - height]
    table.add_geom(type=box, size=[0.02, 0.02, leg], pos=place, rgba=rgba, contype=0, conaffinity=0)


def add_box(spec: mujoco.MjSpec, height: float) -> None:
    """Add the box, whose centre is ``height`` above the ground."""
    box = spec.worldbody.add_body(name="box", pos=[0, 0, height])
    box.add_freejoint(name="box")
    box.add_geom(
        name="box",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[HALF_SIZE] * 3,
        mass=MASS,
        rgba=[0.76, 0.6, 0.38, 1],
        contype=1,
        conaffinity=1 | TOP_CONTACT,
    )


def add_joint(spec: mujoco.MjSpec, carrier: str) -> None:
    """Add a switchable joint between ``carrier`` and box, exclude their contact, and sense the gap between them."""
    body = mujoco.mjtObj.mjOBJ_BODY
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=body, name1=carrier, name2="box", active=False)
    weld.data[:3] = 0  # the anchor: the origin of the box
    weld.solimp[:2] = 0.999  # with MuJoCo's default of 0.9 the box sags
    spec.add_exclude(bodyname1=carrier, bodyname2="box")
    for index, geom in enumerate(spec.body(carrier).geoms):
        if geom.conaffinity:
            geom.name = geom.name or f"{carrier}_{index}"
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_GEOMDIST,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=geom.name,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname="box",
                cutoff=0.01,  # wider gaps are all reported as the cutoff
            )
