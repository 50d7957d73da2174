"""Evaluates a policy on each of its reference motions."""

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
    """The interface of environments that follow reference motions, such as :class:`~torchrl_mcp.envs.Imitation`.

    Attributes:
        library: Clips, with ``names``, ``durations`` in seconds, and ``loops``.
        switch_probability: Probability that the reference changes in a step.
        clip_end: What happens at the end of a clip; ``truncate`` ends the episode.
        num_envs: Number of environments, ``N``.
        max_episode_steps: Longest episode in control steps.
        control_timestep: Seconds per control step.
        batch_size: Batch size ``[N]``.
        device: Device of the environments.
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
        """Return the states at times of clips; clips and times in seconds have shape ``(N,)``."""
        ...

    def get_state(self) -> TensorDict:
        """Return the state of the simulations."""
        ...

    def reset(self) -> TensorDictBase:
        """Begin episodes."""
        ...


def follow_each(
    policy: TensorDictModuleBase, env: FollowsClips, *, deterministic: bool = True, device: torch.device | str = "cpu"
) -> list[ClipResult]:
    """Follow every clip in the same number of episodes, whose beginnings are spread evenly over the clip.

    If a clip is longer than an episode, all episodes begin early enough to end within the clip.

    Args:
        policy: From ``observation`` and ``goal`` to ``action``.
        env: Environments whose reference does not change during an episode. Their number is a multiple of the number of
            clips.
        deterministic: Play the deterministic action instead of a sample.
        device: Device of the policy.

    Returns:
        One result per clip, in the order of the library.

    Raises:
        ValueError: If the reference may change during an episode, or the number of environments is not a multiple of
            the number of clips.
    """
    library = env.library
    count = len(env.library)
    if env.switch_probability or env.clip_end != "truncate":
        raise ValueError(
            "the reference must not change during an episode: make the environments with switch_interval=inf and "
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
