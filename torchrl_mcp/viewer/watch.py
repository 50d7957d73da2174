"""Shows a run during training, by loading the policy from each new checkpoint."""

import copy
import time
from pathlib import Path

from torch import nn

from torchrl_mcp.training import checkpoint, run_folder


class Watch:
    """Loads new checkpoints of a run into networks, and skips damaged or incomplete checkpoints.

    Args:
        run: The run folder.
        parts: Parts of the agent on the CPU, which are changed in place.
        interval: Seconds between checks of the folder.

    Attributes:
        frames: Environment steps of the loaded checkpoint, -1 before the first one.
    """

    def __init__(self, run: Path, parts: nn.ModuleDict, *, interval: float = 1.0) -> None:
        self.frames = -1
        self._run = run
        self._parts = parts
        self._interval = interval
        self._next_check = 0.0
        self._tried: set[tuple[str, int, int]] = set()

    def __call__(self) -> bool:
        """Load the newest intact checkpoint if a check is due; return whether one was loaded."""
        if time.monotonic() < self._next_check:
            return False
        self._next_check = time.monotonic() + self._interval
        return any(self._load(path) for path in run_folder.find_all(self._run) if run_folder.frames(path) > self.frames)

    def _load(self, path: Path) -> bool:
        """Load a checkpoint unless it is damaged or was tried before, and return whether it was loaded."""
        try:
            file = path.name, path.stat().st_size, path.stat().st_mtime_ns
            if file in self._tried:
                return False
            self._tried.add(file)
            if not checkpoint.is_intact(path):
                return False
            # Loading stops halfway if a part does not fit, so load into a copy.
            loaded = copy.deepcopy(self._parts)
            checkpoint.load_agent(loaded, path)
        except (FileNotFoundError, ValueError):  # training has removed the file meanwhile, or it is from another run
            return False
        self._parts.load_state_dict(loaded.state_dict())
        self.frames = run_folder.frames(path)
        print(f"{path.name}: {self.frames:,} steps", flush=True)
        return True
