"""Quotes settings and commands, so that they can be pasted into a shell."""

import re
import shlex

PLAIN = re.compile(r"(?!(null|true|false|inf|nan)$)(\.{0,2}/|[a-z_])[\w/.@+-]*", re.ASCII | re.IGNORECASE)
"""Texts that Hydra reads as text without quotes."""


def setting(name: str, value: object) -> str:
    r"""Return the argument ``name=value`` of a command line, quoted for Hydra.

    >>> print(setting("seed", 1), setting("run_dir", "runs/a=b"))
    seed=1 run_dir="runs/a=b"
    """
    return f"{name}={value if isinstance(value, int | float) else quoted(str(value))}"


def quoted(text: str) -> str:
    """Return a text for Hydra's command line, in quotes if Hydra would otherwise read it differently."""
    if PLAIN.fullmatch(text):
        return text
    # Within quotes Hydra reads backslashes literally, except before a quote, including the closing quote.
    escaped = re.sub(r'(\\*)("|$)', lambda match: match[1] * 2 + (r"\"" if match[2] else ""), text)
    return f'"{escaped}"'


def command(name: str, *words: object) -> str:
    """Return a command of the library, quoted for a shell.

    Args:
        name: The command's name without ``torchrl-mcp-``.
        words: Arguments of the command; settings come from :func:`setting`.

    >>> print(command("play", "runs/my run"))
    torchrl-mcp-play 'runs/my run'
    """
    return shlex.join([f"torchrl-mcp-{name}", *map(str, words)])
