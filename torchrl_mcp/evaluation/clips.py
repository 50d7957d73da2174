"""Evaluation of a policy on each of its reference motions."""

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_mcp.evaluation.rollout import evaluate


@dataclass(frozen=True)
class ClipResult:
    """Statistics of the episodes that follow one clip.

    Attributes:
        clip: Name of the clip.
        seconds: Duration of the clip, or of one cycle if it loops.
        episodes: Number of episodes.
        completed: Share of episodes that neither fell nor lost the reference.
        tracking_error: Mean distance of the bodies from the reference in metres, averaged over episodes.
        length: Mean length of an episode in control steps.
    """

    clip: str
    seconds: float
    episodes: int
    completed: float
    tracking_error: float
    length: float


class FollowsClips(Protocol):
    """Environments that follow reference motions, such as :class:`~torchrl_mcp.envs.Imitation`.

    Attributes:
        library: Clips, with ``names``, ``durations`` in seconds, and ``loops``.
        switch_probability: Probability of a change of the reference in a step.
        clip_end: What follows the end of a clip.
    """

    library: Any
    switch_probability: float
    clip_end: str
    num_envs: int
    max_episode_steps: int
    control_timestep: float
    batch_size: torch.Size
    device: torch.device

    def beginning(self, clips: Tensor, times: Tensor) -> dict[str, Tensor]:
        """State at times in seconds of clips, ``(N,)`` each."""
        ...

    def get_state(self) -> TensorDict:
        """State of the simulations."""
        ...

    def reset(self) -> TensorDictBase:
        """Begin episodes."""
        ...


def follow_each(
    policy: TensorDictModuleBase, env: FollowsClips, *, deterministic: bool = True, device: torch.device | str = "cpu"
) -> list[ClipResult]:
    """Follow every clip in the same number of episodes, which begin at times spread evenly over it.

    If a clip is longer than an episode, the episodes begin early enough to end within it.

    Args:
        policy: From ``observation`` and ``goal`` to ``action``.
        env: Environments without changes of the reference; their number is a multiple of the number of clips.
        deterministic: Play the deterministic action rather than a sample.
        device: Device of the policy.

    Raises:
        ValueError: If the reference may change, or the clips do not divide the environments.
    """
    library = env.library
    count = len(env.library)
    if env.switch_probability or env.clip_end != "truncate":
        raise ValueError(
            "the reference changes within an episode: make the environment with switch_interval=inf and "
            "clip_end='truncate'"
        )
    if env.num_envs % count:
        raise ValueError(f"num_envs={env.num_envs} must be a multiple of the number of clips, {count}")
    episodes = env.num_envs // count
    needed = (env.max_episode_steps + 2) * env.control_timestep
    latest = torch.where(library.loops | (library.durations < needed), library.durations, library.durations - needed)
    clips = torch.arange(count, device=env.device).repeat_interleave(episodes)
    shares = (torch.arange(episodes, dtype=torch.float64, device=env.device) + 0.5) / episodes
    times = latest[clips] * shares.repeat(count)
    env.reset()
    start = env.get_state().update(TensorDict(env.beginning(clips, times), env.batch_size))
    outcome = evaluate(policy, env, start=start, deterministic=deterministic, device=device)
    columns = (~outcome.terminated, outcome.metrics["tracking_error"], outcome.lengths)
    means = torch.stack([column.double().view(count, episodes).mean(1) for column in columns], 1).tolist()
    rows = zip(library.names, library.durations.tolist(), means, strict=True)
    return [ClipResult(name, seconds, episodes, *numbers) for name, seconds, numbers in rows]
