"""The dribble task: move a ball to a target with the feet."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from torch import Tensor

from torchrl_mcp.envs.tasks.objects import horizontal_extent
from torchrl_mcp.envs.tasks.places import near
from torchrl_mcp.envs.tasks.rewards import SUCCESS_DISTANCE, SUCCESS_REACH
from torchrl_mcp.envs.tasks.transport import Transport
from torchrl_mcp.envs.tasks.waypoints import dribble_waypoint, place_seen
from torchrl_mcp.values import Count, Range

# Radius, mass, friction and damping of the ball are from the same authors' public code.
RADIUS = 0.2
MASS = 0.43
FRICTION = 0.4
DAMPING = -math.log(1 - 0.4)
"""Rate per second at which the ball loses speed and spin: the code's simulator loses a share of 0.4 in a second."""
STIFFNESS = 12000.0
"""Stiffness of the ball's contacts, per second squared: it touches the ground for three physics steps of 1/120 s.

A stiffer ball would touch for fewer steps, and its bounce would depend on when within a step it meets the ground.
"""
CONTACT_DAMPING = 25.0
"""Damping of the ball's contacts, per second: it bounces with 0.6 of its speed, like a football on turf.

FIFA's test manual for turf (2015) asks for a rebound of 0.6 to 1.0 m from 2 m, 0.55 to 0.71 of the speed.
"""


class Dribble(Transport):
    """A character moves a ball to a target.

    **Goal.** ``goal`` (16) has the position of the target, and the position, orientation, linear and angular velocity
    of the ball, in the character's heading frame, with positions in metres relative to the root. ``goal_layout`` has
    the names of these entries.

    **Metrics.** ``success`` (1, bool) says whether the ball is horizontally within 0.5 m of the target and the
    character within 2 m of the ball.

    **Ball.** The ball collides with the ground and with the whole character, and has its own friction. Its damping
    slows translation and rotation alike, so that it rolls without slipping and loses 40 % of its speed in a second. It
    bounces like a football.

    **Reward.** The reward has the variants of :class:`~torchrl_mcp.envs.Carry`. A ball at rest at the target earns at
    most 0.73 with the paper's reward. With ``reward_weights`` of a curriculum, training uses
    :func:`~torchrl_mcp.envs.tasks.rewards.training_reward`.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        object_distances: Range (lo, hi) of the ball's distance from the character, in metres. The paper's range is 0 to
            10. The default begins at 0.5, as in the same authors' public code, or at the first distance without contact
            if this is larger.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.tasks.transport.Transport`, where the arguments are described.

    Raises:
        ValueError: If an argument is out of range.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> from torchrl_mcp.envs import Dribble
        >>> env = Dribble("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "goal"].shape
        torch.Size([2, 3, 16])
    """

    objects: ClassVar[Mapping[str, int]] = {"target": 3, "ball": 13}
    weights = (0.1, 0.1, 0.3, 0.5)
    proximity_scale = 0.5
    success_distance = SUCCESS_DISTANCE
    success_reach = SUCCESS_REACH

    def __init__(
        self, character: str, num_envs: Count, *, object_distances: Range = (0.5, 10.0), **kwargs: Any
    ) -> None:
        super().__init__(character, num_envs, furnish=add_pitch, object_distances=object_distances, **kwargs)
        poses = self.initial_states.poses()
        extent = horizontal_extent(self.simulation.model, len(self._bodies), poses, 0.0, 2 * RADIUS)
        self.ranges.keep_clear("object_distances", extent + RADIUS)
        self.ranges.to(self.device)
        self.begin_with("ball", "target")
        self.make_specs()

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, and where it sees target and ball."""
        state, objects = self.see(ids)
        return {"observation": state, "goal": self.goal(objects, ids), "success": self.success()[ids].unsqueeze(-1)}

    def waypoint_seen(self, ids: Tensor | slice) -> Tensor:
        """See :func:`.dribble_waypoint`."""
        com, _, ball, _, target = self.motion()
        rest = ball + self.object.next_velocity[:, :2] / DAMPING  # the last step's is not known after a reset
        return place_seen(self, dribble_waypoint(com, ball, rest, target), ids)

    def success(self) -> Tensor:
        """Whether the ball is at the target and the character near it, shape ``(N,)``, bool."""
        return near(self.object.position, self.target.position, SUCCESS_DISTANCE) & near(
            self.com, self.object.position, SUCCESS_REACH
        )


def add_pitch(spec: mujoco.MjSpec) -> None:
    """Add a target on the ground without collisions, and the ball."""
    target = spec.worldbody.add_body(name="target", mocap=True)
    disc = mujoco.mjtGeom.mjGEOM_CYLINDER
    ghost = {"contype": 0, "conaffinity": 0}
    target.add_geom(type=disc, size=[SUCCESS_DISTANCE, 0.002, 0], rgba=[0.9, 0.1, 0.1, 0.5], **ghost)
    target.add_geom(type=disc, size=[0.03, 0.75, 0], pos=[0, 0, 0.75], rgba=[0.9, 0.1, 0.1, 1], **ghost)
    add_ball(spec)


def add_ball(spec: mujoco.MjSpec) -> None:
    """Add the ball, solid, at rest on the ground.

    A free joint has one damping for forces and torques. Three slides and a ball joint have the same coordinates but
    separate damping.
    """
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, RADIUS])
    for name, axis, at in zip("xyz", np.eye(3), ball.pos, strict=True):
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        damping = [MASS * DAMPING, 0, 0]
        ball.add_joint(name=f"ball_{name}", type=slide, axis=axis, ref=at, damping=damping, armature=0)
    damping = [0.4 * MASS * RADIUS**2 * DAMPING, 0, 0]
    ball.add_joint(name="ball", type=mujoco.mjtJoint.mjJNT_BALL, damping=damping, armature=0)
    spec.add_texture(
        name="ball",
        type=mujoco.mjtTexture.mjTEXTURE_CUBE,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=64,
        height=384,
        rgb1=[0.95, 0.95, 0.95],
        rgb2=[0.1, 0.1, 0.1],
    )
    material = spec.add_material(name="ball")
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ball"
    ball.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[RADIUS, 0, 0],
        mass=MASS,
        material="ball",
        rgba=[1, 1, 1, 1],
        contype=1,
        conaffinity=1,
        friction=[FRICTION, 0, 0],
        priority=1,  # use the ball's friction and bounce, not the greater friction and the mean softness of both geoms
        solref=[-STIFFNESS, -CONTACT_DAMPING],
        solimp=[0.97, 0.97, 0.001, 0.5, 2],
    )
