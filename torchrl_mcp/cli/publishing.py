"""Published policies and their model cards."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from torchrl_mcp.report.paper import CHARACTERS, TABLE_2
from torchrl_mcp.runs import experiment, policies
from torchrl_mcp.runs.builtin import FOLDER, PREFIX, builtin
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.run_folder import PROVENANCE, read_json

PLACES = ("run_dir=", "run_root=", "resume=")
"""Prefixes of arguments that only concern the machine of the run."""


def publish(run: Path, output: Path, *, episodes: int, limits: Sequence[str]) -> None:
    """Write the policy of a run, evaluate the written file, and write its model card beside it.

    Args:
        run: The run folder.
        output: The file.
        episodes: Episodes of the evaluation, with the seed of the run's own evaluation.
        limits: Sentences about the policy's limits.

    Raises:
        ValueError: If the folder holds no run, or its policy cannot be published.
    """
    cfg = experiment.run_config(run)
    policies.publish_run(run, output)
    numbers = policies.evaluation(output, episodes=episodes, seed=cfg.evaluation.seed)
    origin = read_json(run / PROVENANCE) if (run / PROVENANCE).is_file() else {}
    card = output.with_suffix(".md")
    card.write_text(
        model_card(output, cfg, numbers, origin, steps=run_folder.frames(checkpoint.find(run)), limits=limits)
    )
    print(f"{output} ({output.stat().st_size / 1e6:.1f} MB)\n{card}")


def model_card(
    path: Path,
    cfg: DictConfig,
    numbers: Mapping[str, Any],
    origin: Mapping[str, Any],
    *,
    steps: int,
    limits: Sequence[str],
) -> str:
    """Return the model card of a published file, in Markdown.

    Args:
        path: The file.
        cfg: Configuration of the run.
        numbers: Evaluation of the file, as returned by :func:`~torchrl_mcp.runs.policies.evaluation`.
        origin: Provenance of the run; missing entries are written as unknown.
        steps: Environment steps of training.
        limits: Sentences about the policy's limits.
    """
    name = path.stem.removeprefix("mcp-")
    checkpoint_name = f"{PREFIX}{name}" if path.parent.resolve() == FOLDER.resolve() else path.name
    modes = ("deterministic", "stochastic")
    returns = text_table([{"actions": mode, **_row(numbers[mode])} for mode in modes], markdown=True)
    character = CHARACTERS.get(cfg.character.name, cfg.character.name)
    return f"""\
# {name}

{cfg.method.title} on `task={cfg.task.name}` with the {character if character == "T-Rex" else character.lower()}.

```bash
torchrl-mcp-play {checkpoint_name} --viewer web
```

{_facts(path, cfg, origin, steps)}

## Returns

Normalised return of this file in the task of the paper: {numbers["episodes"]} episodes, seed {numbers["seed"]},
with 95 % intervals.

{returns}

{_paper(cfg)}

## Limits

{chr(10).join(f"- {limit}" for limit in limits) or "- Not stated."}
"""


def _facts(path: Path, cfg: DictConfig, origin: Mapping[str, Any], steps: int) -> str:
    """Return the table of how a policy was trained."""
    rows = {
        "contents": _contents(path, cfg),
        "training": f"{steps:,} steps, preset {origin.get('choices', {}).get('preset', 'unknown')}, seed {cfg.seed}",
        "command": f"`{command(origin.get('command', []))}`",
        "commit": origin.get("commit") or "unknown",
        "machine": origin.get("machine", {}).get("processor", "unknown"),
        "size": f"{path.stat().st_size / 1e6:.1f} MB, parameters in bfloat16",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def command(words: Sequence[str]) -> str:
    """Return the command that started a run, without folders of the machine."""
    return shlex.join(word for word in words if not word.startswith(PLACES))


def _contents(path: Path, cfg: DictConfig) -> str:
    """Return the contents of a file, and the source of the policy's other parts."""
    if not (shared := checkpoint.shared(path)):
        return "the whole policy"
    origin = builtin(cfg.method.name, cfg.character.name)
    names = " and ".join(f"`{name}`" for name in shared)
    return f"the gate and the normaliser of its goal; the frozen parts {names} are in `{origin.name}`"


def _row(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Cells of the table of returns."""
    cells = {
        "normalised return": "{:.3f} ({:.3f} to {:.3f})".format(numbers["normalised_return"], *numbers["interval"]),
        "fallen": f"{numbers['terminated']:.0%}",
    }
    if reach := numbers.get("reach"):
        cells["standing still"], cells["ideal"] = f"{reach['standing']:.3f}", f"{reach['ideal']:.3f}"
    return cells | {name.replace("_", " "): f"{value:.3f}" for name, value in numbers["metrics"].items()}


def _paper(cfg: DictConfig) -> str:
    """Return a sentence about Table 2, if it has the cell."""
    reported = TABLE_2.get((cfg.task.name, cfg.character.name, cfg.method.name))
    if cfg.stage.name != "transfer" or reported is None:
        return "The paper has no return to compare with."
    return (
        f"The paper's {cfg.method.title} reaches {reported.mean:.3f} ± {reported.std:.3f}; its training budget is not "
        "stated."
    )
