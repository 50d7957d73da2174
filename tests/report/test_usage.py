import pytest

from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.results import read_run
from torchrl_mcp.report.usage import diagnostics, usage, verdict

GATES = {"gates/effective_primitives": 2.0, "gates/sum": 1.5, "gates/usage_0": 0.9, "gates/usage_1": 0.6}
OPTIONS = {"options/effective_options": 1.5, "options/begin_rate": 0.1, "options/usage_0": 0.8, "options/usage_1": 0.2}


def test_diagnostics_are_means_over_seeds_and_usage_is_that_of_a_run(write_run):
    folders = [
        write_run("a", score=0.5, diagnostics=GATES | OPTIONS),
        write_run("b", seed=1, score=0.5, diagnostics=GATES | {"gates/sum": 2.5, "gates/usage_1": 0.0}),
    ]
    (cell,) = cells(map(read_run, folders))
    assert diagnostics(cell, "gates") == {"effective_primitives": 2.0, "sum": 2.0}
    assert diagnostics(cell, "options") == {}
    assert [usage(run, "gates") for run in cell.runs] == [[0.9, 0.6], [0.9, 0.0]]
    assert usage(cell.runs[0], "options") == [0.8, 0.2]


@pytest.mark.parametrize(
    ("change", "group", "said"),
    [
        ({}, "gates", None),
        ({}, "options", None),
        ({"gates/effective_primitives": 1.05}, "gates", "one primitive does almost all the work"),
        ({"gates/sum": 1.95}, "gates", "the gates are almost fully open, so they hardly select"),
        ({"options/effective_options": 1.05}, "options", "one option does almost all the work"),
        ({"options/begin_rate": 0.95}, "options", "a new option begins at almost every step"),
    ],
    ids=str,
)
def test_gates_and_options_that_do_not_choose_are_found_out(write_run, change, group, said):
    run = read_run(write_run("a", score=0.5, diagnostics=GATES | OPTIONS | change))
    assert verdict(run, group) == said


def test_a_single_primitive_is_not_told_that_it_does_all_the_work(write_run):
    single = {"gates/effective_primitives": 1.0, "gates/sum": 0.5, "gates/usage_0": 0.5}
    assert verdict(read_run(write_run("a", score=0.5, diagnostics=single)), "gates") is None
