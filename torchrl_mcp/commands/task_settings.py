"""The settings that ``--task`` gives."""

from typing import Any, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_mcp.runs.validation import wrong_values

OWN = ("seed", "num_envs", "device", "episodes", "path")
"""Names that the commands give themselves."""


def task_settings(words: list[str]) -> dict[str, Any]:
    """Return the values that ``--task KEY=VALUE`` gives, by key; dots lead into an argument's own.

    Raises:
        ValueError: If a word cannot be read, has no value or a wrong one, or names what the command gives itself.
    """
    if valueless := [word for word in words if "=" not in word]:
        raise ValueError(f"--task {valueless[0]} has no value: write --task {valueless[0]}=VALUE")
    try:
        given = OmegaConf.from_dotlist(words)
    except (OmegaConfBaseException, LookupError) as error:
        raise ValueError(f"--task {' '.join(words)} cannot be read: {' '.join(str(error).split())}") from error
    settings = cast("dict[str, Any]", OmegaConf.to_container(given))
    if unread := [name for name in OWN if name in settings]:
        raise ValueError(
            f"--task {unread[0]} would have no effect: use the options of this command, which --help lists"
        )
    if wrong := list(wrong_values(settings)):
        raise ValueError("\n".join(f"--task {line}" for line in wrong))
    return settings
