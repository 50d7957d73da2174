"""Learning with mirror images: a symmetric character can do everything with left and right exchanged."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.objectives.ppo import ActorLoss
from torchrl_mcp.values import NotNegative, Positive


class MirroredSamples:
    """Advantages of samples, with a random half of every batch replaced by mirror images.

    The mirror image of a sample has the mirrored state, goal and action, and the same advantage. Its log-probability is
    computed with the current policy, so that the first ratio of PPO is one.

    A policy that is not symmetric may give an image almost no probability. The gradient of the log-probability would
    then be so large that learning diverges. Such a sample is therefore not replaced.

    Args:
        advantages: Estimates advantages of trajectories ``(N, T)``, such as :class:`.Advantages`.
        actor: The actor.
        mirrors: Reflections of ``observation``, ``goal`` and ``action``, which the environment's ``mirrors()`` returns.
        tolerance: How much less likely than the sample its image may be, as a difference of log-probabilities in nats.

    Raises:
        ValueError: If the actor explores over something that has no mirror image.

    Reference:
        Abdolhosseini et al., *On Learning Symmetric Locomotion*, 2019, which adds the images to the samples (DUP).
        https://doi.org/10.1145/3359566.3360070

    Example:
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.critic import value_critic
        >>> from torchrl_mcp.methods.scratch import gaussian_actor, gaussian_parts
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> from torchrl_mcp.objectives import Advantages, MirroredSamples
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = gaussian_parts(sizes, policy=GaussianPolicy)
        >>> actor, critic = gaussian_actor(parts), value_critic(parts, sizes)
        >>> env = Heading("biped", num_envs=4, seed=0)
        >>> with torch.no_grad():
        ...     batch = env.rollout(8, actor.policy)
        >>> advantages = Advantages(critic, gamma=0.99, lmbda=0.95, clip=4.0)
        >>> mirrored = MirroredSamples(advantages, actor, env.mirrors())
        >>> mirrored(batch)["advantage"].shape
        torch.Size([4, 8, 1])
    """

    def __init__(
        self, advantages: Any, actor: Actor, mirrors: Mapping[str, nn.Module], *, tolerance: Positive = 20.0
    ) -> None:
        _require_actions(actor)
        self.advantages = advantages
        self.actor = actor
        self.mirrors = mirrors
        self.tolerance = tolerance
        self.out_keys = advantages.out_keys

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Add the estimates of advantages to trajectories ``(N, T)``, and replace half of the samples by their images.

        The samples are replaced in ``batch`` itself, so that the statistics of the normalisers include the images.
        """
        samples = self.advantages(batch)
        chosen = torch.rand(samples.shape, device=samples.device) < 0.5
        if not chosen.any():
            return samples
        image = samples[chosen]
        for key, mirror in self.mirrors.items():
            image[key] = mirror(image[key])
        acted = self.actor.policy(image.select("observation", "goal"))
        for key in self.actor.stored:
            if key not in self.actor.drawn:
                image[key] = acted[key]
        before = image[self.actor.log_prob]
        image[self.actor.log_prob] = self.actor.trained.get_dist(image).log_prob(image["action"])
        likely = before - image[self.actor.log_prob] <= self.tolerance
        chosen[chosen.clone()] = likely
        samples[chosen] = image[likely]
        return samples


class SymmetryLoss(ActorLoss):
    r"""An actor's loss plus a penalty on actions that differ from the mirror images of actions in mirrored states.

    .. math:: L + c \, \mathbb{E} \left\| \mu(s, g) - M_a \, \mu(M_s s, M_g g) \right\|^2

    Args:
        loss: The actor's loss.
        actor: The actor.
        mirrors: Reflections of ``observation``, ``goal`` and ``action``, which the environment's ``mirrors()`` returns.
        coeff: Weight of the penalty, :math:`c`.

    Raises:
        ValueError: If the actor explores over something that has no mirror image.

    Reference:
        Yu, Turk and Liu, *Learning Symmetric and Low-Energy Locomotion*, 2018, Eq. 4. https://arxiv.org/abs/1801.08093

    Example:
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.critic import value_critic
        >>> from torchrl_mcp.methods.scratch import gaussian_actor, gaussian_parts
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> from torchrl_mcp.objectives import Advantages, BoundedClipPPOLoss, SymmetryLoss
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = gaussian_parts(sizes, policy=GaussianPolicy)
        >>> actor, critic = gaussian_actor(parts), value_critic(parts, sizes)
        >>> env = Heading("biped", num_envs=4, seed=0)
        >>> with torch.no_grad():
        ...     batch = env.rollout(8, actor.policy)
        >>> samples = Advantages(critic, gamma=0.99, lmbda=0.95, clip=4.0)(batch).reshape(-1)
        >>> ppo = BoundedClipPPOLoss(actor.trained, bound_coeff=10.0, clip_epsilon=0.2, entropy_bonus=False)
        >>> report = SymmetryLoss(ppo, actor, env.mirrors(), coeff=4.0)(samples)
        >>> sorted(name for name in report.keys() if name.startswith("loss_"))
        ['loss_bound', 'loss_objective', 'loss_symmetry']
    """

    def __init__(self, loss: ActorLoss, actor: Actor, mirrors: Mapping[str, nn.Module], *, coeff: NotNegative) -> None:
        super().__init__()
        _require_actions(actor)
        self.loss = loss
        self.actor = actor
        self.coeff = coeff
        self.out_keys = [*loss.out_keys, "loss_symmetry"]
        self.mirrors = nn.ModuleDict(dict(mirrors))
        # Random keys, such as the noise of a latent variable, are the same on both sides: only `trained` reads them.
        self._network: Any = actor.trained if actor.drawn else actor.policy

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add ``loss_symmetry`` to the terms of the actor's loss."""
        report: TensorDictBase = self.loss(tensordict)
        image = tensordict.select("observation", "goal", *self.actor.drawn)
        mean = self._mean(image.copy())
        for key in ("observation", "goal"):
            image[key] = self.mirrors[key](image[key])
        difference = mean - self.mirrors["action"](self._mean(image))
        return report.set("loss_symmetry", self.coeff * difference.square().sum(-1).mean())

    def _mean(self, samples: TensorDictBase) -> Tensor:
        mean: Tensor = self._network.get_dist(samples).mean
        return mean


def _require_actions(actor: Actor) -> None:
    if actor.num_options or actor.sampled != "action":
        raise ValueError(
            "symmetry mirrors the actions of one policy: options and gate weights have no mirror images. Pass "
            "symmetry=none, or exploration=action and a method without options"
        )
