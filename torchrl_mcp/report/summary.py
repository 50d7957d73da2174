"""The summary that a run prints at its end: results, folder, and next commands."""

import math
from pathlib import Path
from typing import Any

from torchrl_mcp.evaluation.wording import skill_text
from torchrl_mcp.report.comparison import reported
from torchrl_mcp.report.results import Run, read_run
from torchrl_mcp.runs import quoting
from torchrl_mcp.runs.trust import trust_options
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, MODES, NORMALISED_RETURN, read_json, read_metrics


def summary(folder: Path) -> str:
    """Return the summary of the run in a folder: returns beside the paper's, and the next commands."""
    lines = [*_returns(folder), "next:"]
    trust = trust_options(folder / CONFIG)
    lines += [f"  {quoting.command(name, *trust, folder)}" for name in ("play", "evaluate")]
    lines.append(f"  {quoting.command('report', folder)}")
    return "\n".join(lines)


def final_return(folder: Path) -> float | None:
    """Return the normalised return of the run in a folder, or None if it has none.

    It is the return of the evaluation with deterministic actions, or without one, the last return of training.
    """
    if evaluation := _evaluation(folder):
        return evaluation["deterministic"]["normalised_return"]
    return last_return(folder)


def last_return(folder: Path) -> float | None:
    """Return the normalised return of the last iteration in which an episode ended, None if none has."""
    returns = [row.get(NORMALISED_RETURN, math.nan) for row in read_metrics(folder)]
    return next((value for value in reversed(returns) if math.isfinite(value)), None)


def _returns(folder: Path) -> list[str]:
    """Return lines with the returns of deterministic and of sampled actions, and of the paper."""
    if not (evaluation := _evaluation(folder)):
        last = last_return(folder)
        shown = "none, since no episode of full length has ended" if last is None else f"{last:.3f}"
        return [f"normalised return in training: {shown}"]
    modes = {mode: evaluation[mode] for mode in MODES}
    values = [
        "{} {:.3f} ({:.3f} to {:.3f})".format(mode, numbers["normalised_return"], *numbers["interval"])
        for mode, numbers in modes.items()
    ]
    episodes = f"normalised return of {evaluation['episodes']} episodes, with 95 % intervals:"
    if "skill" in (reach := modes["deterministic"].get("reach", {})):
        values.insert(1, skill_text(reach))
    return [episodes, *(f"  {value}" for value in [*values, *_paper(folder)])]


def _paper(folder: Path) -> list[str]:
    """Return a line with the paper's return of Table 2, or none if the run is not comparable."""
    run = read_run(folder)
    if not isinstance(run, Run) or not (paper := reported(run)):
        return []
    return [f"paper {paper.mean:.3f} +- {paper.std:.3f} (training budget not stated)"]


def _evaluation(folder: Path) -> dict[str, Any]:
    path = folder / EVALUATION
    return read_json(path) if path.is_file() else {}
