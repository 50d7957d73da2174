"""The tutorial on methods of your own, command by command, in a folder of its own and with the smallest budgets."""

import csv
import json
import re
import shlex
import sys
from pathlib import Path

import pytest
from refusals import refused

import torchrl_mcp
from torchrl_mcp.commands import evaluate, figures, report, train
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.trust import trusting

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorials" / "method.md"
FILE = re.compile(r"^```\{code-block\} \w+\n:caption: (.*?)\n\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^(?:PYTHONPATH=\. )?(torchrl-mcp-\w+) (.*)$", re.MULTILINE)
PROGRAMS = {
    f"torchrl-mcp-{module.__name__.rpartition('.')[2]}": module for module in (train, evaluate, figures, report)
}
SMALLER = {
    "torchrl-mcp-train": "preset=smoke logger=none num_threads=1 torch_threads=1 progress_bar=false "
    "training.total_frames=128 training.num_epochs=2 task.pretrain.max_episode_steps=20 evaluation.episodes=4 "
    "task.evaluation.max_episode_steps=20 "
    "hydra/job_logging=none hydra/hydra_logging=none",
    "torchrl-mcp-evaluate": "--episodes 4 --output evaluation.json",
    "torchrl-mcp-figures exploration": "--trajectories 2 --seconds 0.3",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working directory in which all that the tutorial shows has been written and called."""
    folder = tmp_path_factory.mktemp("tutorial")
    text = TUTORIAL.read_text()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        path = list(sys.path)
        for name, content in FILE.findall(text):
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_text(content)
        for program, arguments in COMMAND.findall(text):
            line = f"{program} {arguments}"
            smaller = next((words for start, words in SMALLER.items() if line.startswith(start)), "")
            sys.modules.pop("own_methods", None)  # each command has a process of its own
            patch.setattr(sys, "path", list(path))
            patch.setattr(sys, "argv", shlex.split(f"{line} {smaller}"))
            PROGRAMS[program].main()
        patch.syspath_prepend(folder)
        yield folder
    sys.modules.pop("own_methods", None)


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_methods_are_not_the_librarys(folder):
    own = {path.stem for path in (folder / "own").rglob("*.yaml")}
    library = {path.stem for path in (Path(torchrl_mcp.__file__).parents[1] / "conf" / "method").glob("*.yaml")}
    assert own == {"mcp_top", "mcp_temperature"}
    assert not own & library


def test_of_the_weights_the_three_largest_stay(folder):
    with trusting({"own_methods"}):
        _, agent, env = policies.restore(folder / "runs" / "top-new", num_envs=5, seed=0)
    gates = env.rollout(10, agent.actor.policy)["gates"]
    assert ((gates > 0).sum(-1) == 3).all()
    diagnostics = json.loads((folder / "evaluation.json").read_text())["deterministic"]["diagnostics"]
    assert 1 < diagnostics["gates/effective_primitives"] <= 3


def test_the_temperature_is_learned_at_transfer_while_the_primitives_stay(folder):
    with trusting({"own_methods"}):
        _, before, _ = policies.restore(folder / "runs" / "tempered", num_envs=1, seed=0)
        _, after, _ = policies.restore(folder / "runs" / "tempered-new", num_envs=1, seed=0)
    assert before.parts["gating"].log_temperature.item() != after.parts["gating"].log_temperature.item() != 0.0
    kept = after.parts["primitives"].state_dict()
    assert all((value == kept[name]).all() for name, value in before.parts["primitives"].state_dict().items())


def test_figures_call_the_methods_by_their_titles(folder):
    panels = [row["panel"] for row in rows(folder / "figures" / "exploration_ant_summary.csv")]
    assert panels[:2] == ["Top-k MCP, random weights", "Tempered MCP, random weights"]
    assert {row["label"] for row in rows(folder / "figures" / "holdout_curves.csv")} == {"Top-k MCP", "Tempered MCP"}
    assert (folder / "figures" / "holdout_top_k_mcp.png").stat().st_size > 1000


def test_the_report_has_both_methods_with_the_diagnostics_of_their_gates(folder):
    text = (folder / "report" / "report.md").read_text()
    transfer, gates = (
        text.partition(f"## {title}")[2].partition("\n## ")[0] for title in ("Transfer: Holdout", "Gates")
    )
    for title in ("Top-k MCP", "Tempered MCP"):
        assert f"\n| {title} |" in transfer
        assert f"| {title} |" in gates


def test_without_trust_or_the_folder_on_the_path_the_remedy_is_named(folder, monkeypatch):
    def restore():
        policies.restore(folder / "runs" / "top", num_envs=1, seed=0)

    refused(restore, "--trust own_methods")
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry) != folder])
    monkeypatch.delitem(sys.modules, "own_methods")
    with trusting({"own_methods"}):
        refused(restore, "own_methods", "PYTHONPATH")
