import json

import pytest

from torchrl_mcp.report.paper import TABLE_2
from torchrl_mcp.report.summary import final_return, summary

CONFIG = """
task: {name: heading}
character: {name: biped}
method: {name: mcp, title: MCP, standard: {num_primitives: 8}}
stage: {name: transfer}
seed: 0
training: {total_frames: 1000}
num_primitives: 8
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "config.yaml").write_text(CONFIG)
    (tmp_path / "metrics.csv").write_text("iteration,episode/normalised_return\n1,0.25\n2,0.5\n3,nan\n")
    return tmp_path


def evaluate(folder):
    numbers = {"normalised_return": 0.75, "interval": [0.7, 0.8]}
    stochastic = {"normalised_return": 0.625, "interval": [0.6, 0.65]}
    content = {"episodes": 128, "deterministic": numbers, "stochastic": stochastic}
    (folder / "evaluation.json").write_text(json.dumps(content))


def test_a_run_ends_with_its_returns_beside_the_papers_and_the_next_commands(folder):
    evaluate(folder)
    lines = summary(folder).splitlines()
    assert "128 episodes" in lines[0]
    assert [line.split()[:2] for line in lines[1:3]] == [["deterministic", "0.750"], ["stochastic", "0.625"]]
    assert f"paper {TABLE_2['heading', 'biped', 'mcp'].mean:.3f}" in lines[3]
    commands = [line.split() for line in lines[lines.index("next:") + 1 :]]
    assert commands == [[f"torchrl-mcp-{name}", str(folder)] for name in ("play", "evaluate", "report")]


def test_the_next_commands_of_a_run_with_own_code_trust_it(folder):
    (folder / "config.yaml").write_text(CONFIG + "parts: {_target_: own_parts.parts}\n")
    play, evaluation, report = summary(folder).splitlines()[-3:]
    assert play.split() == ["torchrl-mcp-play", "--trust", "own_parts", str(folder)]
    assert evaluation.split()[1:3] == ["--trust", "own_parts"]
    assert "--trust" not in report


@pytest.mark.parametrize("change", [("transfer", "pretrain"), ("\nnum_primitives: 8", "\nnum_primitives: 4")], ids=str)
def test_pretraining_and_variants_have_no_figure_of_the_papers(folder, change):
    evaluate(folder)
    (folder / "config.yaml").write_text(CONFIG.replace(*change))
    assert "paper" not in summary(folder)


def test_the_final_return_is_that_of_the_evaluation_or_else_the_last_that_is_known(folder):
    assert final_return(folder) == 0.5
    assert "0.500" in summary(folder)
    evaluate(folder)
    assert final_return(folder) == 0.75


def test_before_the_first_episode_ends_there_is_no_return(folder):
    (folder / "metrics.csv").write_text("iteration,episode/normalised_return\n1,nan\n")
    assert final_return(folder) is None
    assert "no episode of full length has ended" in summary(folder)
