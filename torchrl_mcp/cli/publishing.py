"""Files of policies and their model cards."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from torchrl_mcp.report.paper import CHARACTERS, TABLE_2
from torchrl_mcp.runs import experiment
from torchrl_mcp.runs.builtin import FOLDER, PREFIX, builtin
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.run_folder import PROVENANCE, read_json

PLACES = ("run_dir=", "run_root=", "resume=")
"""Beginnings of what a command says of the machine that it ran on, and of nothing else."""


def publish(run: Path, output: Path, *, episodes: int, limits: Sequence[str]) -> None:
    """Write the policy of a run, evaluate what was written, and write its model card beside it.

    Args:
        run: The run folder.
        output: The file.
        episodes: Of the evaluation, with the seed of the run's own.
        limits: Sentences about what the policy cannot do.

    Raises:
        ValueError: If the folder holds no run, or its policy cannot be published.
    """
    cfg = experiment.run_config(run)
    experiment.publish_run(run, output)
    numbers = experiment.evaluation(output, episodes=episodes, seed=cfg.evaluation.seed)
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
        cfg: Configuration of its run.
        numbers: Its evaluation, as :func:`~torchrl_mcp.runs.experiment.evaluation` returns it.
        origin: Provenance of the run; what it lacks is unknown.
        steps: Environment steps of training.
        limits: Sentences about what the policy cannot do.
    """
    name = path.stem.removeprefix("mcp-")
    checkpoint_name = f"{PREFIX}{name}" if path.parent.resolve() == FOLDER.resolve() else path.name
    modes = {"deterministic": numbers["deterministic"], "exploring": numbers["stochastic"]}
    returns = text_table([{"actions": mode, **_row(of)} for mode, of in modes.items()], markdown=True)
    character = CHARACTERS.get(cfg.character.name, cfg.character.name)
    return f"""\
# {name}

{cfg.method.title} on `task={cfg.task.name}` with the {character if character == "T-Rex" else character.lower()}.

```bash
torchrl-mcp-play {checkpoint_name} --viewer web
```

{_facts(path, cfg, origin, steps)}

## Returns

Normalised return of the file as it is here, in the task as the paper has it: {numbers["episodes"]} episodes,
seed {numbers["seed"]}, with the 95 % interval.

{returns}

{_paper(cfg)}

## Limits

{chr(10).join(f"- {limit}" for limit in limits) or "- Not stated."}
"""


def _facts(path: Path, cfg: DictConfig, origin: Mapping[str, Any], steps: int) -> str:
    """Return the table of how a policy was trained."""
    rows = {
        "holds": ", ".join(_held(path, cfg)),
        "trained": f"{steps:,} steps, preset {origin.get('choices', {}).get('preset', 'unknown')}, seed {cfg.seed}",
        "command": f"`{command(origin.get('command', []))}`",
        "commit": origin.get("commit") or "unknown",
        "machine": origin.get("machine", {}).get("processor", "unknown"),
        "size": f"{path.stat().st_size / 1e6:.1f} MB, parameters in bfloat16",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def command(words: Sequence[str]) -> str:
    """Return the command that began a run, without what it says of the machine's folders."""
    return shlex.join(word for word in words if not word.startswith(PLACES))


def _held(path: Path, cfg: DictConfig) -> Iterator[str]:
    """What is in a file, and where the rest of the policy is."""
    if shared := checkpoint.shared(path):
        yield "the gate and the normaliser of its goal"
        origin = builtin(cfg.method.name, cfg.character.name)
        yield f"over {' and '.join(shared)} of `{origin.name}`, frozen, which imitate the library's generated motions"
    else:
        yield "the whole policy"


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
        return "The paper reports no such policy."
    return (
        f"The paper's {cfg.method.title} reaches {reported.mean:.3f} ± {reported.std:.3f}, after a budget that it does "
        "not state."
    )
