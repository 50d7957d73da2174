"""The work of the commands. Their parsers are in ``cli``, in files of the same names."""

import sys

from torchrl_mcp import __version__


def announce(program: str) -> None:
    """Print that a command is importing its libraries, which takes seconds without other output."""
    print(f"{program} {__version__}: loading PyTorch and MuJoCo ...", file=sys.stderr, flush=True)
