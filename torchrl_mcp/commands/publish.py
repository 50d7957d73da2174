"""Published policies and their model cards."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.report.comparison import reported
from torchrl_mcp.report.paper import CHARACTERS
from torchrl_mcp.report.results import Run
from torchrl_mcp.runs import policies, quoting, records
from torchrl_mcp.runs.builtin import FOLDER, PREFIX, builtin
from torchrl_mcp.runs.identity import SAME_RUN, is_among
from torchrl_mcp.runs.settings import leaves
from torchrl_mcp.runs.trust import trust_options
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.run_folder import CONFIG, MODES, PROVENANCE, read_json


def publish(run: Path, output: Path, *, episodes: int, limits: Sequence[str]) -> None:
    """Write the policy of a run, evaluate the written file, and write its model card beside it.

    Args:
        run: The run folder.
        output: The file.
        episodes: Episodes of the evaluation, with the seed of the run's own evaluation.
        limits: Sentences about the policy's limits.

    Raises:
        ValueError: If the folder holds no run, its policy cannot be published, or a file would be overwritten.
    """
    card = output.with_suffix(".md")
    for path in (output, card):
        if path.exists():
            raise ValueError(f"{path} exists already: remove it, or pass another --output")
    cfg = records.run_config(run)
    policies.publish_run(run, output)
    numbers = policies.evaluation(output, episodes=episodes, seed=cfg.evaluation.seed)
    origin = read_json(run / PROVENANCE) if (run / PROVENANCE).is_file() else {}
    steps = run_folder.frames(checkpoint.find(run))
    trust = trust_options(run / CONFIG)
    card.write_text(model_card(output, cfg, numbers, origin, steps=steps, limits=limits, trust=trust), encoding="utf-8")
    print(f"{output} ({output.stat().st_size / 1e6:.1f} MB)\n{card}")


def model_card(
    path: Path,
    cfg: DictConfig,
    numbers: Mapping[str, Any],
    origin: Mapping[str, Any],
    *,
    steps: int,
    limits: Sequence[str],
    trust: Sequence[str] = (),
) -> str:
    """Return the model card of a published file, in Markdown.

    Args:
        path: The file.
        cfg: Configuration of the run.
        numbers: Evaluation of the file, as returned by :func:`~torchrl_mcp.runs.policies.evaluation`.
        origin: Provenance of the run; missing entries are written as unknown.
        steps: Environment steps of training.
        limits: Sentences about the policy's limits.
        trust: Options with which commands trust the policy's own modules.
    """
    name = path.stem.removeprefix("mcp-")
    checkpoint_name = f"{PREFIX}{name}" if path.parent.resolve() == FOLDER.resolve() else path.name
    play = quoting.command("play", *trust, checkpoint_name, "--viewer", "web")
    returns = "\n".join(f"- {mode}: {_returns(numbers[mode])}" for mode in MODES)
    character = CHARACTERS.get(cfg.character.name, cfg.character.name)
    return f"""\
# {name}

{cfg.method.title} on `task={cfg.task.name}` with the {character if character == "T-Rex" else character.lower()}:
`{play}`.

{_facts(path, cfg, origin, steps)}

Normalised return, {numbers["episodes"]} episodes of seed {numbers["seed"]} (the paper: {_paper(path, cfg, origin)}):

{returns}

Limits:

{chr(10).join(f"- {limit}" for limit in limits) or "- Not stated."}
"""


def _facts(path: Path, cfg: DictConfig, origin: Mapping[str, Any], steps: int) -> str:
    """Return how a policy was trained, as a list."""
    preset = origin.get("choices", {}).get("preset", "unknown")
    machine = origin.get("machine", {})
    facts = (
        f"{_contents(path, cfg)}; {path.stat().st_size / 1e6:.1f} MB in bfloat16",
        f"{steps:,} steps, preset {preset}, seed {cfg.seed}, {machine.get('processor', 'unknown machine')}",
        f"`{command(origin.get('command', []))}`, commit {origin.get('commit') or 'unknown'}",
    )
    return "\n".join(f"- {fact}" for fact in facts)


def command(words: Sequence[str]) -> str:
    """Return the command that started a run, without folders of the machine and settings that make no other run."""
    return shlex.join(word for word in words if not is_among(word.partition("=")[0], SAME_RUN))


def _contents(path: Path, cfg: DictConfig) -> str:
    """Return the contents of a file, and the source of the policy's other parts."""
    if not (shared := checkpoint.shared(path)):
        return "the whole policy"
    origin = builtin(cfg.method.name, cfg.character.name)
    names = " and ".join(shared).replace("_", " ")
    return f"all but the {names} of `{origin.name}`"


def _returns(numbers: Mapping[str, Any]) -> str:
    """Return the results of one mode in a line, with the interval of the return."""
    metrics = "".join(f", {name.replace('_', ' ')} {value:.3f}" for name, value in numbers["metrics"].items())
    value, (low, high) = numbers["normalised_return"], numbers["interval"]
    return f"{value:.3f} ({low:.3f} to {high:.3f}), fallen {numbers['terminated']:.0%}{metrics}"


def _paper(path: Path, cfg: DictConfig, origin: Mapping[str, Any]) -> str:
    """Return the paper's number in Table 2, if it has one. Its heading has a single speed."""
    settings = dict(leaves(OmegaConf.to_container(cfg, resolve=True)))
    paper = reported(Run(path, settings, provenance=origin))
    if paper is None or OmegaConf.is_list(cfg.task.evaluation.get("speed")):
        return "no return"
    return f"{paper.mean:.3f} ± {paper.std:.3f}"
