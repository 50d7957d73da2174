"""A run in training, watched: its policy is always that of the newest checkpoint."""

import copy
import time
from pathlib import Path

from torch import nn

from torchrl_mcp.training import checkpoint, run_folder


class Watch:
    """Networks that follow the checkpoints of a run.

    A newest checkpoint that is damaged or only half there is passed over.

    Args:
        run: The run folder.
        parts: Of the agent, which are changed in place, on the CPU.
        interval: Seconds between two looks at the folder.

    Attributes:
        frames: Environment steps after which the checkpoint in use was written, -1 before the first.
    """

    def __init__(self, run: Path, parts: nn.ModuleDict, *, interval: float = 1.0) -> None:
        self.frames = -1
        self._run, self._parts, self._interval = run, parts, interval
        self._next_look = 0.0
        self._seen: set[tuple[str, int, int]] = set()

    def __call__(self) -> bool:
        """Look, if it is time, and take up the newest checkpoint that is intact; return whether there was one."""
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
            # What does not fit is noticed in the middle, when some parts are loaded.
            loaded = copy.deepcopy(self._parts)
            checkpoint.load_agent(loaded, path)
        except (FileNotFoundError, ValueError):  # training has removed it meanwhile, or it is of another run
            return False
        self._parts.load_state_dict(loaded.state_dict())
        self.frames = run_folder.frames(path)
        print(f"{path.name}: {self.frames:,} steps", flush=True)
        return True
