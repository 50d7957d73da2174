"""An adaptive sampler of reference motions, which prefers moments at which episodes end."""

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.library import MotionLibrary

PERIOD = 1.0
"""Length in seconds of the periods of a clip that are counted, and longest lead before a failure."""

DECAY = 0.9997
"""Share of the counts that remains after a control step: they cover about the last 100 s."""

PRIOR_STEPS, PRIOR_FAILURES = 100.0, 1.0
"""Initial counts of every period."""


class AdaptiveSampler:
    r"""Draws moments of reference motions, weighted by how often episodes end there.

    .. math:: P(j) \propto W_j \lambda_j

    where :math:`\lambda_j` is the recent share of steps in period j that ended an episode, and :math:`W_j` the
    probability with which the library draws the period. A start is up to a second before a moment of the period, both
    uniform. Starts before the beginning of a clip wrap around if it loops, and are its beginning otherwise.

    Args:
        library: The reference motions.
    """

    def __init__(self, library: MotionLibrary) -> None:
        numbers = (library.durations / PERIOD).ceil().long().clamp_min(1)
        self._clips = torch.arange(len(library)).to(numbers.device).repeat_interleave(numbers)
        self._first = numbers.cumsum(0) - numbers
        self._begins = PERIOD * (torch.arange(len(self._clips)).to(numbers.device) - self._first[self._clips])
        self._durations, self._loops = library.durations, library.loops
        self._lasts = (library.durations[self._clips] - self._begins).clamp_max(PERIOD)
        self._weights = (library.weights / library.durations)[self._clips] * self._lasts
        self.steps = torch.full_like(self._weights, PRIOR_STEPS)
        self.failures = torch.full_like(self._weights, PRIOR_FAILURES)

    def count(self, clips: Tensor, times: Tensor, failed: Tensor) -> None:
        """Count a step of N simulations, and decay the counts of earlier steps.

        Args:
            clips: Index of the clip of each simulation, shape ``(N,)``.
            times: Seconds since the clip's first frame, shape ``(N,)``.
            failed: Whether the step ended the episode, shape ``(N,)``, bool.
        """
        durations = self._durations[clips]
        within = torch.where(self._loops[clips], times % durations, torch.minimum(times, durations))
        last = (durations / PERIOD).ceil().long() - 1
        periods = self._first[clips] + torch.minimum((within / PERIOD).long(), last.clamp_min(0))
        steps, failures = (torch.bincount(chosen, minlength=len(self.steps)) for chosen in (periods, periods[failed]))
        self.steps, self.failures = DECAY * self.steps + steps, DECAY * self.failures + failures

    def draw(self, num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw starts: clips ``(num,)``, int64, and times in seconds ``(num,)``, float64."""
        periods = torch.multinomial(
            self._weights * self.failures / self.steps, num, replacement=True, generator=generator
        )
        clips = self._clips[periods]
        ahead, lead = torch.rand(2, num, generator=generator, dtype=torch.float64, device=clips.device)
        times = self._begins[periods] + self._lasts[periods] * ahead - PERIOD * lead
        return clips, torch.where(self._loops[clips], times % self._durations[clips], times.clamp_min(0.0))

    def state_dict(self) -> dict[str, Tensor]:
        """Return the counts."""
        return {"steps": self.steps, "failures": self.failures}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self.steps, self.failures = (state[name].to(self.steps.device, copy=True) for name in ("steps", "failures"))
