"""``torchrl-mcp-export``: a trained policy for other programs, as ONNX or for ``torch.export.load``."""

import argparse
from pathlib import Path

from torchrl_mcp.cli.parsing import add_trust, explained, new_parser
from torchrl_mcp.commands import announce
from torchrl_mcp.runs.builtin import locate

PROGRAM = "torchrl-mcp-export"

EXAMPLES = f"""\
The program takes the environment's observation and goal, and returns the deterministic action.

examples:
  {PROGRAM} builtin:humanoid --onnx humanoid.onnx   # needs pip install 'torchrl-mcp[onnx]'
  {PROGRAM} runs/my-run --torch my-run.pt2          # needs torch alone
"""


@explained(PROGRAM)
def main() -> None:
    """Write the policy, and print its difference from torch."""
    options = parser()
    arguments = options.parse_args()
    if arguments.onnx is None and arguments.torch is None:
        options.error("say what to write: --onnx FILE, --torch FILE, or both")
    path = locate(arguments.checkpoint)
    announce(PROGRAM)
    from torchrl_mcp.runs import export
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        policy, states, metadata = export.example(path)
    if arguments.torch:
        export.write_torch(policy, states, arguments.torch)
        print(arguments.torch)
    if arguments.onnx:
        difference = export.write_onnx(policy, states, arguments.onnx, metadata)
        checked = "not checked: onnxruntime is not installed"
        print(arguments.onnx, checked if difference is None else f"differs from torch by at most {difference:.0e}")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Write a trained policy for other programs, with its normalisers.", EXAMPLES)
    parser.add_argument(
        "checkpoint",
        metavar="CHECKPOINT",
        help="run folder (its newest checkpoint), checkpoint file, builtin:CHARACTER or builtin:CHARACTER-TASK",
    )
    add_trust(parser)
    parser.add_argument("--onnx", type=Path, metavar="FILE", help="write ONNX")
    parser.add_argument("--torch", type=Path, metavar="FILE", help="write a program for torch.export.load")
    return parser


if __name__ == "__main__":
    main()
