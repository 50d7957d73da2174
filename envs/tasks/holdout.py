"""The holdout task: an ant runs in directions that pre-training held out."""

from functools import partial
from itertools import accumulate
from types import MappingProxyType
from typing import Any

import gymnasium
import mujoco
import torch
from torch import Tensor

from torchrl_mcp.adapters.contract import Reach
from torchrl_mcp.envs.base import CharacterEnv
from torchrl_mcp.envs.characters import ant
from torchrl_mcp.envs.observations import UNITS
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.tasks.rewards import holdout_reward
from torchrl_mcp.values import Count, NotNegative, Range, checked

# Ant-v5's frame_skip, main_body and contact_force_range.
SUBSTEPS = 5
TORSO = 1
CONTACT_FORCE_RANGE = (-1.0, 1.0)


class Holdout(CharacterEnv):
    """Gymnasium's Ant-v5 with a target direction, drawn for each episode and observed as ``goal``.

    The paper pre-trains with directions in [0, 3/2 pi] and transfers to the held-out directions [3/2 pi, 2 pi]. With
    the direction +x, states and rewards equal those of Gymnasium's Ant-v5. In particular, the velocity is measured at
    the torso, and the control cost is computed from the unclipped action, although the motors clip it to [-1, 1].

    - ``observation`` (27) has the root's height and orientation (quaternion), 8 joint angles, and 14 velocities.
    - ``goal`` (2) is (cos, sin) of the direction.
    - ``action`` (8) has the controls of the torque motors, as in Ant-v5, every 0.05 s.

    Args:
        num_envs: Number N of simulations.
        directions: Range (lo, hi) of target directions in radians, counted from +x towards +y.
        max_episode_steps: Actions of 0.05 s until an episode is ``truncated``.
        contact_forces: Whether to observe the clipped external forces on 13 bodies (78 more numbers) and to subtract
            their cost from the reward, as Ant-v5 does by default. At the paper's time, with MuJoCo 2.0, these forces
            were always zero, hence the default here. They take about 20 microseconds per simulation and step, on one
            thread.
        forward_weight: Weight of the velocity in the target direction, per m/s.
        healthy_weight: Reward per step for being healthy.
        control_weight: Cost of the squared action.
        contact_weight: Cost of the squared contact forces.
        healthy_z_range: Lowest and highest healthy height of the torso, in metres.
        terminate_when_unhealthy: Whether the episode of an unhealthy ant ends.
        reset_noise_scale: Half-width of the uniform noise on the initial positions, and standard deviation of the
            normal noise on the initial velocities.
        dtype: Type of the outputs.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.base.CharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> import math
        >>> from torchrl_mcp.envs import Holdout
        >>> env = Holdout(num_envs=2, directions=(0.0, 1.5 * math.pi), seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 27])
    """

    goal_layout = MappingProxyType({"direction": slice(0, 2)})
    units = MappingProxyType(
        {
            **UNITS,
            "direction": "unit vector",
            "joint_angle": "rad",
            "joint_velocity": "rad/s",
            "contact_force": "torque in N m, then force in N, clipped to [-1, 1]",
        }
    )

    @checked
    def __init__(
        self,
        num_envs: Count,
        directions: Range,
        *,
        max_episode_steps: Count = 1000,
        contact_forces: bool = False,
        forward_weight: NotNegative = 1.0,
        healthy_weight: NotNegative = 1.0,
        control_weight: NotNegative = 0.5,
        contact_weight: NotNegative = 0.0005,
        healthy_z_range: Range = (0.2, 1.0),
        terminate_when_unhealthy: bool = True,
        reset_noise_scale: NotNegative = 0.1,
        dtype: torch.dtype = torch.float32,
        **kwargs: Any,
    ) -> None:
        spec = ant()
        model = spec.compile()
        self.scene = spec.to_xml()
        episode = {"goal": torch.zeros(2, dtype=dtype)}
        if contact_forces:
            episode["contact_forces"] = torch.zeros(model.nbody, 6, dtype=torch.float64)
        super().__init__(
            model,
            num_envs,
            substeps=SUBSTEPS,
            max_episode_steps=max_episode_steps,
            episode=episode,
            outputs=["xpos"],
            persistent=contact_forces,
            dtype=dtype,
            **kwargs,
        )
        self.directions = float(directions[0]), float(directions[1])
        self.reset_noise_scale = reset_noise_scale
        self.healthy_z_range = float(healthy_z_range[0]), float(healthy_z_range[1])
        self.terminate_when_unhealthy = terminate_when_unhealthy
        self._reward_of = partial(
            holdout_reward,
            forward_weight=forward_weight,
            healthy_weight=healthy_weight,
            control_weight=control_weight,
            contact_weight=contact_weight,
        )
        # Live views, made once. Gymnasium measures velocities with the body's xpos, one stage of RK4 before the state.
        self._rest = torch.from_numpy(model.qpos0).to(self.device)
        qpos = self.simulation.state["qpos"]
        self._qvel = self.simulation.state["qvel"]
        self._height = qpos[:, 2]
        self._posture = qpos[:, 2:]
        self.track(position=self.simulation.outputs["xpos"][:, TORSO, :2])
        self.observation_layout = _layout(model, contact_forces)
        self.make_specs()

    @classmethod
    def characters(cls) -> tuple[str, ...]:
        """See :meth:`CharacterEnv.characters`: Gymnasium's ant alone."""
        return ("ant",)

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is a return of zero and 1 is Gymnasium's threshold for solved, unclipped.

        .. math:: \bar{R} = \frac{R}{T \, r^*}, \qquad r^* = \frac{6000}{1000}

        with :math:`R` the undiscounted return, :math:`T` ``max_episode_steps`` and :math:`r^*` the reward per step at
        Gymnasium's ``reward_threshold`` for Ant-v5. The paper's normalisation is not documented.
        """
        return episode_return / self._solved()

    def _solved(self) -> float:
        spec = gymnasium.spec("Ant-v5")
        assert spec.reward_threshold is not None
        assert spec.max_episode_steps is not None
        return self.max_episode_steps * spec.reward_threshold / spec.max_episode_steps

    def reach(self) -> Reach:
        """See :meth:`CharacterEnv.reach`: the ideal is Gymnasium's threshold for solved, which can be exceeded."""
        still = torch.zeros(self.num_envs, 2, device=self.device)
        action = torch.zeros_like(self.simulation.state["ctrl"])
        healthy = torch.ones_like(still[:, 0])
        standing = self.max_episode_steps * self._reward_of(still, self.episode["goal"], action, healthy)
        return Reach(standing, torch.full_like(standing, self._solved()))

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The ant near its rest pose, and a direction."""
        model = self.simulation.model
        noise = self.reset_noise_scale
        source = self.generator
        blank = partial(torch.empty, dtype=torch.float64, device=self.device)
        angle = blank(num, 1).uniform_(*self.directions, generator=source)
        shift = blank(num, model.nq).uniform_(-noise, noise, generator=source)
        return {
            "goal": torch.cat([angle.cos(), angle.sin()], -1),
            "qpos": self._rest + shift,
            "qvel": blank(num, model.nv).normal_(0.0, noise, generator=source),
        }

    def after_step(self, diverged: Tensor) -> None:
        """Measure the contact forces, if they are observed; a simulation that did not move keeps its own."""
        if "contact_forces" in self.episode:
            forces = self.simulation.contact_forces().clamp(*CONTACT_FORCE_RANGE)
            forces[diverged] = self.episode["contact_forces"][diverged]
            self.episode["contact_forces"].copy_(forces)

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """Gymnasium's observation, and the direction."""
        parts = [self._posture[ids], self._qvel[ids]]
        if "contact_forces" in self.episode:
            parts.append(self.episode["contact_forces"][ids, 1:].flatten(1))  # Ant-v5 leaves the world body out
        return {"observation": torch.cat(parts, -1), "goal": self.episode["goal"][ids]}

    def reward(self) -> Tensor:
        """Reward of appendix D."""
        contacts = self.episode.get("contact_forces")
        forces = None if contacts is None else contacts.flatten(1)
        action = self.simulation.state["ctrl"]
        return self._reward_of(self.velocity("position"), self.episode["goal"], action, self.healthy(), forces)

    def terminated(self) -> Tensor:
        """Whether the ant is unhealthy."""
        return ~self.healthy() & self.terminate_when_unhealthy

    def healthy(self) -> Tensor:
        """Whether the torso is at a healthy height, shape ``(N,)``, bool."""
        return self._height == self._height.clamp(*self.healthy_z_range)

    def arrows(self, index: int) -> list[Arrow]:
        """See :meth:`CharacterEnv.arrows`: an arrow in the target direction."""
        tail = self.simulation.state["qpos"][index, :3].cpu() + torch.tensor([0.0, 0.0, 0.6])
        tip = tail + torch.nn.functional.pad(self.episode["goal"][index].cpu(), (0, 1))
        return [(tail.double().numpy(), tip.double().numpy())]


def _layout(model: mujoco.MjModel, contact_forces: bool) -> dict[str, slice]:
    """Slices of the observation by name: the root, the hinges, and external forces on bodies if they are observed."""
    joints = [model.joint(joint).name for joint in range(1, model.njnt)]
    sizes = {"root_height": 1, "root.orientation": 4}
    sizes |= {f"{joint}.joint_angle": 1 for joint in joints}
    sizes |= {"root.linear_velocity": 3, "root.angular_velocity": 3}
    sizes |= {f"{joint}.joint_velocity": 1 for joint in joints}
    if contact_forces:
        sizes |= {f"{model.body(body).name or f'body_{body}'}.contact_force": 6 for body in range(1, model.nbody)}
    ends = list(accumulate(sizes.values()))
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}
