"""``torchrl-mcp-evaluate``: returns and diagnostics of a trained policy.

With ``--output RUN/evaluation.json`` it writes the file that training writes at its end.
"""

import argparse
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchrl_mcp.cli.parsing import add_task, add_trust, count, explained, new_parser, seed, settings
from torchrl_mcp.commands import announce
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.training.run_folder import MODES, write_json

PROGRAM = "torchrl-mcp-evaluate"


@explained(PROGRAM)
def main() -> None:
    """Play one episode in each of many environments and print the statistics."""
    arguments = parser().parse_args()
    path = locate(arguments.checkpoint)
    announce(PROGRAM)
    from torchrl_mcp.commands.task_settings import task_settings
    from torchrl_mcp.runs.policies import evaluate_clips, evaluation
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        settings = task_settings(arguments.task)
        alone = {"episodes": arguments.clips, "seed": arguments.seed, **settings}
        clips = evaluate_clips(path, **alone) if arguments.clips else []
        results = evaluation(path, episodes=arguments.episodes, seed=arguments.seed, **settings)
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
            share = round(100 * reach["place"])
            standing = reach["standing"]
            ideal = reach["ideal"]
            print(f"    {share}% of the way from standing still ({standing:.3f}) to an ideal player ({ideal:.3f})")
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
    parser.add_argument(
        "checkpoint",
        help="run folder (its newest checkpoint), checkpoint file, builtin:CHARACTER or builtin:CHARACTER-TASK",
    )
    defaults = settings("train")["evaluation"]
    for name, kind, meaning in (
        ("episodes", count, "number of episodes, one in each environment"),
        ("seed", seed, "seed of environments and sampling"),
    ):
        parser.add_argument(f"--{name}", type=kind, default=defaults[name], help=f"{meaning} (default %(default)s)")
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
