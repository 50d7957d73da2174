"""``torchrl-mcp-publish``: a trained policy as a small file, with a model card."""

import argparse
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_mcp.commands.parsing import add_trust, announce, count, entry_point, new_parser, settings
from torchrl_mcp.report.paper import CHARACTERS
from torchrl_mcp.runs import builtin, quoting
from torchrl_mcp.training.run_folder import CONFIG, MODES, PROVENANCE, frames, read_json

if TYPE_CHECKING:
    from omegaconf import DictConfig

PROGRAM = "torchrl-mcp-publish"

EXAMPLES = f"""\
The file contains only the policy, in bfloat16, without the frozen parts of networks that come with the library.
Commands accept the file where they take a CHECKPOINT. The model card beside it describes training, task and returns.

examples:
  {PROGRAM} runs/heading --output heading.torchrl --limits "falls on turns of more than 90 degrees"
"""


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Write the file and its card."""
    arguments = parser().parse_args(words)
    if arguments.output.suffix != ".torchrl":
        raise ValueError(f"{arguments.output} must have the name of a checkpoint: end it with .torchrl")
    if not arguments.run.is_dir():
        raise ValueError(f"there is no run folder {arguments.run}: pass the folder of a training")
    announce(PROGRAM)
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        publish(arguments.run, arguments.output, episodes=arguments.episodes, limits=arguments.limits)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Write a trained policy as a small file, with a model card beside it.", EXAMPLES)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder, whose newest checkpoint is published")
    add_trust(parser)
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="file to write, which ends in .torchrl; the card ends in .md",
    )
    parser.add_argument(
        "--limits",
        action="append",
        default=[],
        help="a sentence about the limits of the policy, for the card; repeatable",
    )
    episodes = settings("train")["evaluation"]["episodes"]
    parser.add_argument(
        "--episodes", type=count, default=episodes, help="episodes of the evaluation on the card (default %(default)s)"
    )
    return parser


def publish(run: Path, output: Path, *, episodes: int, limits: Sequence[str]) -> None:
    """Write the policy of a run, evaluate the written file, and write its model card beside it.

    Args:
        run: The run folder.
        output: The file.
        episodes: Episodes of the evaluation, with the seed of the run's own evaluation.
        limits: Sentences about the policy's limits.

    Raises:
        ValueError: If the folder holds no run, the policy cannot be published, or a file exists already.
    """
    card = output.with_suffix(".md")
    for path in (output, card):
        if path.exists():
            raise ValueError(f"{path} exists already: remove it, or pass another --output")
    from torchrl_mcp.runs import policies, records
    from torchrl_mcp.runs.trust import trust_options
    from torchrl_mcp.training import checkpoint

    cfg = records.run_config(run)
    origin = read_json(run / PROVENANCE) if (run / PROVENANCE).is_file() else {}
    steps = frames(checkpoint.find(run))
    trust = trust_options(run / CONFIG)
    policies.publish_run(run, output)
    try:
        numbers = policies.evaluation(output, episodes=episodes, seed=cfg.evaluation.seed)
        text = model_card(output, cfg, numbers, origin, steps=steps, limits=limits, trust=trust)
        card.write_text(text, encoding="utf-8")
    except BaseException:
        output.unlink()  # without a card, so that the command can be repeated
        raise
    print(f"{output} ({output.stat().st_size / 1e6:.1f} MB)\n{card}")


def model_card(
    path: Path,
    cfg: "DictConfig",
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
    is_builtin = path.parent.resolve() == builtin.FOLDER.resolve()
    checkpoint = f"{builtin.PREFIX}{name}" if is_builtin else path.name
    play = quoting.command("play", *trust, checkpoint, "--viewer", "web")
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


def _facts(path: Path, cfg: "DictConfig", origin: Mapping[str, Any], steps: int) -> str:
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
    from torchrl_mcp.runs.identity import SAME_RUN, is_among

    settings = [word.partition("=") for word in words]
    kept = [parts for parts in settings if not is_among(parts[0].lstrip("+~"), SAME_RUN)]
    return shlex.join(f"{name}{sign}{without_folder(value)}" for name, sign, value in kept)


def without_folder(value: str) -> str:
    """Return the value of a setting, of an absolute path only its last part."""
    return Path(value).name if Path(value).is_absolute() else value


def _contents(path: Path, cfg: "DictConfig") -> str:
    """Return the contents of a file, and the source of the policy's other parts."""
    from torchrl_mcp.training import checkpoint

    if not (shared := checkpoint.shared(path)):
        return "the whole policy"
    names = " and ".join(shared).replace("_", " ")
    return f"all but the {names} of `{builtin.builtin(cfg.method.name, cfg.character.name).name}`"


def _returns(numbers: Mapping[str, Any]) -> str:
    """Return the results of one mode in a line, with the interval of the return."""
    metrics = "".join(f", {name.replace('_', ' ')} {value:.3f}" for name, value in numbers["metrics"].items())
    value = numbers["normalised_return"]
    low, high = numbers["interval"]
    return f"{value:.3f} ({low:.3f} to {high:.3f}), terminated {numbers['terminated']:.0%}{metrics}"


def _paper(path: Path, cfg: "DictConfig", origin: Mapping[str, Any]) -> str:
    """Return the paper's number in Table 2, if it has one. Its heading has a single speed."""
    from omegaconf import OmegaConf

    from torchrl_mcp.report.comparison import reported
    from torchrl_mcp.report.results import Run
    from torchrl_mcp.runs.settings import leaves

    settings_of_run = dict(leaves(OmegaConf.to_container(cfg, resolve=True)))
    paper = reported(Run(path, settings_of_run, provenance=origin))
    if paper is None or OmegaConf.is_list(cfg.task.evaluation.get("speed")):
        return "no return"
    return f"{paper.mean:.3f} ± {paper.std:.3f}"


if __name__ == "__main__":
    main()
