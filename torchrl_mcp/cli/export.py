"""``torchrl-mcp-export``: a trained policy for other programs, as ONNX, for ``torch.export.load``, or as a web page."""

import argparse
import sys
from pathlib import Path

from torchrl_mcp.cli.parsing import add_trust, explained, new_parser
from torchrl_mcp.commands import announce
from torchrl_mcp.runs.builtin import locate

PROGRAM = "torchrl-mcp-export"

EXAMPLES = f"""\
ONNX files and torch programs take the observation and goal of the environment and return the deterministic action. A
web page runs physics and networks in the browser of its reader, and needs any web server.

examples:
  {PROGRAM} builtin:humanoid --onnx humanoid.onnx   # needs pip install 'torchrl-mcp[onnx]'
  {PROGRAM} runs/my-run --torch my-run.pt2          # needs torch alone
  {PROGRAM} builtin:humanoid-location --gate builtin:humanoid-heading --page humanoid   # needs npm and onnx
"""


@explained(PROGRAM)
def main() -> None:
    """Write the policy, and print its difference from torch, or the page's size."""
    options = parser()
    arguments = options.parse_args()
    if arguments.onnx is None and arguments.torch is None and arguments.page is None:
        options.error("choose what to write: --onnx FILE, --torch FILE or --page DIR")
    if arguments.gate and arguments.page is None:
        options.error("--gate adds a gate to a page: also pass --page DIR")
    path = locate(arguments.checkpoint)
    gates = [locate(gate) for gate in arguments.gate]
    announce(PROGRAM)
    from torchrl_mcp.commands.export import page
    from torchrl_mcp.runs import export
    from torchrl_mcp.runs.trust import trusting

    if arguments.page:
        with trusting(arguments.trust):
            print(page([path, *gates], arguments.page, words=[PROGRAM, *sys.argv[1:]]))
    if arguments.onnx is None and arguments.torch is None:
        return
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
    parser = new_parser(
        PROGRAM, "Write a trained policy with its normalisers for other programs, or as a web page.", EXAMPLES
    )
    parser.add_argument(
        "checkpoint",
        metavar="CHECKPOINT",
        help="run folder (its newest checkpoint), checkpoint file, builtin:CHARACTER or builtin:CHARACTER-TASK",
    )
    add_trust(parser)
    parser.add_argument("--onnx", type=Path, metavar="FILE", help="write an ONNX file")
    parser.add_argument("--torch", type=Path, metavar="FILE", help="write a program for torch.export.load")
    parser.add_argument("--page", type=Path, metavar="DIR", help="write a folder with a web page")
    parser.add_argument(
        "--gate",
        action="append",
        default=[],
        metavar="CHECKPOINT",
        help="another gate over the same primitives, to which the page can switch; repeatable",
    )
    return parser


if __name__ == "__main__":
    main()
