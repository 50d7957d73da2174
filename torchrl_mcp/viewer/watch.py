"""Watching a run during training: the policy is loaded from each new checkpoint."""

import copy
import time
from pathlib import Path

from torch import nn

from torchrl_mcp.training import checkpoint, run_folder


class Watch:
    """Networks that follow the checkpoints of a run.

    Damaged or incomplete checkpoints are skipped.

    Args:
        run: The run folder.
        parts: Parts of the agent, changed in place, on the CPU.
        interval: Seconds between checks of the folder.

    Attributes:
        frames: Environment steps of the loaded checkpoint, -1 before the first.
    """

    def __init__(self, run: Path, parts: nn.ModuleDict, *, interval: float = 1.0) -> None:
        self.frames = -1
        self._run = run
        self._parts = parts
        self._interval = interval
        self._next_look = 0.0
        self._seen: set[tuple[str, int, int]] = set()

    def __call__(self) -> bool:
        """Load the newest intact checkpoint if a check is due; return whether one was loaded."""
        if time.monotonic() < self._next_look:
            return False
        self._next_look = time.monotonic() + self._interval
        return any(self._take(path) for path in run_folder.find_all(self._run) if run_folder.frames(path) > self.frames)

    def _take(self, path: Path) -> bool:
        """Load a checkpoint, unless it is damaged."""
        try:
            seen = path.name, path.stat().st_size, path.stat().st_mtime_ns
            if seen in self._seen:
                return False
            self._seen.add(seen)
            if not checkpoint.is_intact(path):
                return False
            # Loading fails halfway if a part does not fit, so load into a copy.
            loaded = copy.deepcopy(self._parts)
            checkpoint.load_agent(loaded, path)
        except (FileNotFoundError, ValueError):  # removed by training meanwhile, or from another run
            return False
        self._parts.load_state_dict(loaded.state_dict())
        self.frames = run_folder.frames(path)
        print(f"{path.name}: {self.frames:,} steps", flush=True)
        return True
