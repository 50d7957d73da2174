import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Small tensors: a thread pool costs more than it gives, and results must not depend on the machine's cores.
torch.set_num_threads(1)

# An example's time says nothing here (first calls compile and allocate); in CI the same examples run every time.
settings.register_profile("default", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "default")


@pytest.fixture(scope="session")
def mocap() -> Path:
    """Folder of third-party motion capture, which is no part of the project."""
    folder = os.environ.get("TORCHRL_MCP_MOCAP")
    if not folder:
        pytest.skip("needs motion-capture files: set TORCHRL_MCP_MOCAP to their folder")
    if not Path(folder).is_dir():
        pytest.fail(f"TORCHRL_MCP_MOCAP={folder!r} is not a folder: correct it, or unset it to skip these tests")
    return Path(folder)
