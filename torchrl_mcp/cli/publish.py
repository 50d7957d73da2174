"""``torchrl-mcp-publish``: a trained policy as a small file, with a model card."""

import argparse
from pathlib import Path

from torchrl_mcp.cli.parsing import add_trust, count, explained, new_parser, settings
from torchrl_mcp.commands import announce

PROGRAM = "torchrl-mcp-publish"

EXAMPLES = f"""\
The file contains only the policy, in bfloat16, without the frozen parts of networks that come with the library. All
commands accept the file as a CHECKPOINT. The model card beside it describes training, task and returns.

examples:
  {PROGRAM} runs/heading --output heading.torchrl --limits "falls on turns of more than 90 degrees"
"""


@explained(PROGRAM)
def main() -> None:
    """Write the file and its card."""
    arguments = parser().parse_args()
    if arguments.output.suffix != ".torchrl":
        raise ValueError(f"{arguments.output} must have the name of a checkpoint: end it with .torchrl")
    if not arguments.run.is_dir():
        raise ValueError(f"there is no run folder {arguments.run}: pass the folder of a training")
    announce(PROGRAM)
    from torchrl_mcp.commands.publish import publish
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


if __name__ == "__main__":
    main()
