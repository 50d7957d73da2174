"""``torchrl-mcp-export``: a trained policy for other programs, as ONNX, for ``torch.export.load``, or as a web page."""

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from torchrl_mcp.commands.parsing import CHECKPOINT, add_trust, announce, entry_point, new_parser
from torchrl_mcp.runs import builtin

PROGRAM = "torchrl-mcp-export"

EXAMPLES = f"""\
ONNX files and torch programs take the observation and goal of the environment and return the deterministic action. A
web page runs physics and networks in the browser of its reader, and needs any web server.

examples:
  {PROGRAM} builtin:humanoid --onnx humanoid.onnx   # needs pip install 'torchrl-mcp[onnx]'
  {PROGRAM} runs/my-run --torch my-run.pt2          # needs torch alone
  {PROGRAM} builtin:humanoid-location --gate builtin:humanoid-heading --page humanoid   # needs npm and onnx
"""


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Write the policy, and print how far the ONNX file differs from torch, and the size of the page."""
    options = parser()
    arguments = options.parse_args(words)
    if arguments.onnx is None and arguments.torch is None and arguments.page is None:
        options.error("choose what to write: --onnx FILE, --torch FILE or --page DIR")
    if arguments.gate and arguments.page is None:
        options.error("--gate adds a gate to a page: also pass --page DIR")
    path = builtin.locate(arguments.checkpoint)
    gates = [builtin.locate(gate) for gate in arguments.gate]
    announce(PROGRAM)
    from torchrl_mcp.runs import export
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        if arguments.page:
            print(write_page([path, *gates], arguments.page, command=shlex.join([PROGRAM, *words])))
        if arguments.onnx is None and arguments.torch is None:
            return
        policy, states, metadata = export.example(path)
    if arguments.torch:
        export.write_torch(policy, states, arguments.torch)
        print(arguments.torch)
    if arguments.onnx:
        difference = export.write_onnx(policy, states, arguments.onnx, metadata)
        unchecked = "not checked: onnxruntime is not installed"
        print(arguments.onnx, unchecked if difference is None else f"differs from torch by at most {difference:.0e}")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(
        PROGRAM, "Write a trained policy with its normalisers for other programs, or as a web page.", EXAMPLES
    )
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT)
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


def write_page(checkpoints: Sequence[Path], folder: Path, *, command: str) -> str:
    """Write a web page of gates over the same primitives, and return a line about it.

    Args:
        checkpoints: Run folders or checkpoint files of the gates. The page begins with the first.
        folder: The folder to write.
        command: The command that makes the page.

    Raises:
        ValueError: If a checkpoint is missing or damaged, or the page cannot play it.
    """
    from torchrl_mcp.runs import policies
    from torchrl_mcp.viewer.page import folder as pages

    players: dict[str, pages.Player] = {}
    for path in checkpoints:
        cfg, agent, env = policies.restore(path, num_envs=1, seed=0)
        is_gate = path.parent == builtin.FOLDER and builtin.has_task(path)
        name = path.stem.split("-")[2] if is_gate else cfg.task.name
        players[name if name not in players else f"{name} {len(players) + 1}"] = agent.actor.policy, env
    title = f"{cfg.character.name}: {' or '.join(players)}"
    pages.write_page(players, folder, title=title, command=command)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return f"{folder}, {size / 1e6:.1f} MB: python -m http.server --directory {shlex.quote(str(folder))}"


if __name__ == "__main__":
    main()
