"""``torchrl-mcp-evaluate``: returns and diagnostics of a trained policy.

With ``--output RUN/evaluation.json`` it writes the file that training writes at its end.
"""

import argparse
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchrl_mcp.commands.parsing import (
    CHECKPOINT,
    add_task,
    add_trust,
    announce,
    count,
    entry_point,
    new_parser,
    seed,
    settings,
    task_settings,
)
from torchrl_mcp.evaluation.wording import skill_text
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.training.run_folder import MODES, write_json

PROGRAM = "torchrl-mcp-evaluate"


@entry_point(PROGRAM, FloatingPointError)
def main(words: list[str]) -> None:
    """Play one episode in each of many environments and print the statistics."""
    arguments = parser().parse_args(words)
    path = locate(arguments.checkpoint)
    announce(PROGRAM)
    from torchrl_mcp.runs.policies import evaluate_clips, evaluation
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        changes = task_settings(arguments.task)
        clips = []
        if arguments.clips:
            clips = evaluate_clips(path, episodes=arguments.clips, seed=arguments.seed, **changes)
        results = evaluation(path, episodes=arguments.episodes, seed=arguments.seed, **changes)
    report(arguments, results, [asdict(clip) for clip in clips])


def report(arguments: argparse.Namespace, results: dict[str, Any], clips: list[dict[str, Any]]) -> None:
    """Print the statistics, and write them to a file if requested."""
    from torchrl_mcp.evaluation.diagnostics import COLLAPSED
    from torchrl_mcp.runs.tables import text_table

    print(f"{arguments.checkpoint}: {arguments.episodes} episodes, seed {arguments.seed}")
    for mode in MODES:
        numbers = results[mode]
        low, high = numbers["interval"]
        print(
            f"{mode}: normalised return {numbers['normalised_return']:.3f} "
            f"(95 % interval of the mean {low:.3f} to {high:.3f}, std {numbers['normalised_return_std']:.3f}), "
            f"return {numbers['return']:.1f}, length {numbers['length']:.0f}, terminated {numbers['terminated']:.0%}"
            + "".join(f", {name} {value:.3f}" for name, value in numbers["metrics"].items())
        )
        if reach := numbers.get("reach"):
            print(f"    {skill_text(reach)}")
        if "success_return" in numbers:
            print(f"    normalised return {numbers['success_return']:.3f} with the reward 1 while successful")
        if diagnostics := numbers["diagnostics"]:
            print(text_table([{"diagnostic": name, "value": value} for name, value in diagnostics.items()]))
        if numbers["diagnostics"].get("options/effective_options", math.inf) < COLLAPSED:
            print("the options have collapsed: one of them acts almost always")
    if clips:
        print(text_table(clips))
    if arguments.output:
        numbers = results | ({"clips": clips} if clips else {})
        write_json(numbers, arguments.output)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(
        PROGRAM, "Play episodes with a trained policy, and print returns and diagnostics of gates and options."
    )
    parser.add_argument("checkpoint", help=CHECKPOINT)
    defaults = settings("train")["evaluation"]
    parser.add_argument(
        "--episodes",
        type=count,
        default=defaults["episodes"],
        help="number of episodes, one in each environment (default %(default)s)",
    )
    parser.add_argument(
        "--seed", type=seed, default=defaults["seed"], help="seed of environments and sampling (default %(default)s)"
    )
    parser.add_argument(
        "--clips",
        type=count,
        metavar="N",
        help="also follow each reference motion by itself in N episodes (imitation only)",
    )
    add_task(parser)
    add_trust(parser)
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file as well")
    return parser


if __name__ == "__main__":
    main()
