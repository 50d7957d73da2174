"""Web pages of trained policies."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from torchrl_mcp.runs import builtin, policies
from torchrl_mcp.viewer.page.folder import Player, write_page


def page(checkpoints: Sequence[Path], folder: Path, *, words: Sequence[str]) -> str:
    """Write a page of gates over the same primitives, and return a line about it.

    Args:
        checkpoints: Run folders or checkpoint files of the gates, of which the page begins with the first.
        folder: The folder to write.
        words: Words of the command that makes the page.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or the page cannot play it.
    """
    players: dict[str, Player] = {}
    for path in checkpoints:
        cfg, agent, env = policies.restore(path, num_envs=1, seed=0)
        words_of_name = path.stem.split("-")[2:] if path.parent == builtin.FOLDER else []
        name = words_of_name[0] if words_of_name else cfg.task.name
        players[name if name not in players else f"{name} {len(players) + 1}"] = agent.actor.policy, env
    title = f"{cfg.character.name}: {' or '.join(players)}"
    write_page(players, folder, title=title, command=shlex.join(words))
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return f"{folder}, {size / 1e6:.1f} MB: python -m http.server --directory {shlex.quote(str(folder))}"
