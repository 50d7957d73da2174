"""Which runs share a cell, and what is compared between cells."""

import json
import math
from itertools import count

import pytest

from torchrl_mcp.report.comparison import ablations, caveats, cells, methods
from torchrl_mcp.report.results import read_run
from torchrl_mcp.report.sections import method_colours, row, task_sections

GATE_KEPT = ["primitives", "gating", "observation_normaliser"]


def grouped(*folders):
    return cells([read_run(folder) for folder in folders])


def test_seeds_share_a_cell_with_their_mean_deviation_and_interval(write_run):
    (cell,) = grouped(*(write_run(str(seed), seed=seed, score=score) for seed, score in enumerate([0.4, 0.5, 0.9])))
    assert [run.seed for run in cell.runs] == [0, 1, 2]
    assert (cell.settings, cell.remarks) == ({}, [])
    estimate = cell.mean()
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.6, 0.4, 0.9))
    assert cell.mean("stochastic").value == pytest.approx(0.5)
    assert cell.deviation() == pytest.approx(math.sqrt((0.04 + 0.01 + 0.09) / 2))


def test_tasks_characters_stages_and_methods_are_apart_in_the_papers_order(write_run):
    folders = [
        write_run("a", method="mine"),
        write_run("b", method="moe"),
        write_run("c", method="finetune"),
        write_run("d", method="finetune", stage="pretrain"),
        write_run("e", task="dribble", character="trex"),
        write_run("f", task="carry"),
        write_run("g", task="juggle"),
    ]
    found = [(cell.place, cell.stage, cell.method) for cell in grouped(*folders)]
    assert found == [
        (("heading", "biped"), "pretrain", "finetune"),
        (("heading", "biped"), "transfer", "finetune"),
        (("heading", "biped"), "transfer", "moe"),
        (("heading", "biped"), "transfer", "mine"),
        (("carry", "biped"), "transfer", "scratch"),
        (("dribble", "trex"), "transfer", "scratch"),
        (("juggle", "biped"), "transfer", "scratch"),
    ]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"preset": "paper"}, ("preset", "paper")),
        ({"preset": None}, ("preset", "unknown")),
        ({"total_frames": 2000}, ("total_frames", 2000)),
        ({"num_primitives": 4}, ("num_primitives", 4)),
        ({"mixer__name": "additive"}, ("mixer", "additive")),
        ({"exploration__name": "weights"}, ("exploration", "weights")),
        ({"transfer__freeze": ["observation_normaliser"]}, ("trained", "gate and primitives")),
        ({"transfer__keep": GATE_KEPT}, ("gate", "kept")),
        ({"symmetry": "augment"}, ("symmetry", "augment")),
        ({"budget__pretrain": 6_000_000}, ("budget.pretrain", 6_000_000)),
        ({"pretrained": "builtin"}, ("pretrained", "builtin")),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_runs_with_different_choices_are_never_averaged(write_mcp, settings, told):
    usual, other = grouped(write_mcp("a", score=0.2), write_mcp("b", seed=1, score=0.8, **settings))
    if usual.runs[0].seed:
        usual, other = other, usual
    assert (usual.mean().value, other.mean().value) == (0.2, 0.8)
    assert told in other.settings.items()
    assert set(other.settings) >= set(usual.settings)


def test_any_other_difference_of_the_configuration_tells_cells_apart(write_run):
    steps = [1e-4, 3e-4, 1e-4]
    folders = [write_run(str(i), seed=i, score=0.5, optimizer__lr=step) for i, step in enumerate(steps)]
    found = grouped(*folders)
    assert [(cell.settings, len(cell.runs)) for cell in found] == [
        ({"optimizer.lr": 1e-4}, 2),
        ({"optimizer.lr": 3e-4}, 1),
    ]


def test_what_a_choice_brings_along_goes_without_saying(write_run):
    fast, paper = (write_run(p, preset=p, optimizer__lr=step) for p, step in {"fast": 1e-3, "paper": 1e-6}.items())
    assert [cell.settings for cell in grouped(fast, paper)] == [{"preset": "fast"}, {"preset": "paper"}]


@pytest.mark.parametrize(
    "setting",
    [
        {"device": "cuda"},
        {"pretrained": "runs/other"},
        {"logger__name": "csv"},
        {"task__pretrain__speed": 2.0},
        {"evaluation__episodes": 3},
        {"added_later": 1},
    ],
    ids=str,
)
def test_what_changes_no_learning_parts_no_seeds(write_run, setting):
    (name,) = setting
    before = {} if name == "added_later" else {name: None}
    (cell,) = grouped(write_run("a", **before), write_run("b", seed=1, **setting))
    assert len(cell.runs) == 2


def test_an_argument_that_only_some_runs_name_tells_them_apart(write_run):
    made = {"task__transfer___target_": "torchrl_mcp.envs.Heading"}
    found = grouped(write_run("a", **made), write_run("b", seed=1, **made, task__transfer__max_turn=0.3))
    told = {cell.runs[0].seed: cell.settings for cell in found}
    assert told == {0: {"task.transfer.max_turn": "default"}, 1: {"task.transfer.max_turn": 0.3}}


MIXTURE = "task__transfer__curriculum__mixture"


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ({"optimizer__schedule": None}, {"optimizer__schedule": {"max": 1e-3}}, "optimizer.schedule"),
        (
            {"task__transfer__curriculum__initial_states": "rest"},
            {"task__transfer__curriculum__initial_states": {"rest": 1.0, "motions": 0.5}},
            "task.transfer.curriculum.initial_states",
        ),
        ({MIXTURE: [{"weight": 1.0}, {"weight": 2.0}]}, {MIXTURE: [{"weight": 1.0}]}, f"{MIXTURE}.1.weight"),
        ({"parts__layers": [{"width": 4}]}, {"parts__layers": [{"width": 4}, {"width": 8}]}, "parts.layers.1.width"),
        (
            {"task__transfer__curriculum": {"success_worth": 2.0, "random_first_length": True}},
            {"task__transfer__curriculum": {"random_first_length": True}},
            "task.transfer.curriculum.success_worth",
        ),
    ],
    ids=[
        "null or a group",
        "a name or a group",
        "shorter list of a curriculum",
        "shorter list",
        "left out of a curriculum",
    ],
)
def test_a_group_in_another_form_tells_runs_apart(write_run, first, second, name):
    found = grouped(write_run("a", **first), write_run("b", seed=1, **second))
    assert [set(cell.settings) for cell in found] == [{name.replace("__", ".")}] * 2


@pytest.mark.parametrize("setting", ["motions.seed", "imitation.switch_to"])
def test_a_pretraining_tells_transfers_apart_that_keep_its_networks(write_run, write_mcp, setting):
    for write, expected in ((write_run, 1), (write_mcp, 2)):
        folders = [write(f"{expected}{value}", seed=value, **{setting.replace(".", "__"): value}) for value in (0, 1)]
        assert len(grouped(*folders)) == expected


def test_caveats_tell_what_differs_between_cells(write_run, write_mcp):
    found = grouped(
        write_run("a", commit="aaa"),
        write_run("b", commit="bbb", total_frames=2000),
        write_mcp("c", commit="aaa", preset="paper", total_frames=3000),
    )
    assert caveats(found) == ["presets: fast, paper", "commits: aaa, bbb", "numbers of steps of Scratch: 1,000, 2,000"]


def test_a_method_of_your_own_is_known_by_the_title_and_the_settings_that_it_tells(write_run):
    about = {"method": "mine", "method__title": "My Own", "method__standard": {"top": 3}}
    variant, standard = grouped(write_run("a", top=2, **about), write_run("b", top=3, **about))
    if variant.is_standard:
        variant, standard = standard, variant
    assert (standard.title, standard.is_standard, variant.is_standard) == ("My Own", True, False)
    assert (row(standard).label, row(variant).label) == ("My Own", "My Own, top=2")


TEMPERED = [
    *("method.explorer.distribution_class", "mixer", "mixer.distribution_class"),
    *("exploration.actor.distribution_class", "parts.distribution_class", "actor.distribution_class"),
]
"""Where a resolved configuration has the temperature of a mixer to which other settings refer."""


@pytest.mark.parametrize("stage", ["pretrain", "transfer"])
def test_a_setting_to_which_others_refer_is_named_once_by_its_shortest_path(write_mcp, stage):
    about = {
        "stage": stage,
        "mixer__name": "tempered",
        "method__title": "MCP",
        "method__standard__mixer": "multiplicative",
    }
    folders = [
        write_mcp(str(value), **about, **{f"{path}.temperature".replace(".", "__"): value for path in TEMPERED})
        for value in (1, 4)
    ]
    labels = [row(cell).label for cell in grouped(*folders)]
    assert labels == [f"MCP, tempered mixer, mixer.temperature={value}" for value in (1, 4)]


def test_settings_with_equal_values_that_the_command_line_names_are_all_named(write_run):
    folders = [write_run(str(value), step_size__actor=value, step_size__critic=value) for value in (0.1, 0.2)]
    assert [cell.settings for cell in grouped(*folders)] == [{"step_size.actor": 0.1}, {"step_size.actor": 0.2}]
    for folder in folders:
        origin = json.loads((folder / "origin.json").read_text())
        command = ["torchrl-mcp-train", "step_size.critic=1", "+step_size.actor=1"]
        (folder / "origin.json").write_text(json.dumps(origin | {"command": command}))
    assert [list(cell.settings) for cell in grouped(*folders)] == [["step_size.actor", "step_size.critic"]] * 2


def test_runs_of_different_titles_have_a_row_each_with_their_title_alone(write_mcp):
    titles = ["MCP", "Tempered MCP"]
    folders = [write_mcp(title, method__title=title, score=0.5) for title in titles]
    assert [row(cell).label for cell in grouped(*folders)] == titles


def test_a_variant_is_named_also_where_no_other_is_beside_it(write_mcp):
    (cell,) = grouped(write_mcp("a", mixer__name="additive"))
    assert not cell.is_standard
    assert row(cell).label == "MCP, additive mixer"


def test_cells_with_the_same_label_have_a_curve_each(write_run):
    mine = {"method": "mine", "method__title": "Mine", "depth": 2}
    found = grouped(write_run("old", method__standard__depth=2, **mine), write_run("new", **mine), write_run("scratch"))
    assert [row(cell).label for cell in found] == ["Scratch", "Mine", "Mine"]
    (section,) = task_sections(found, map(str, count()), method_colours(found))
    assert "of Scratch; Mine; Mine" in section.plot.svg


def test_methods_have_colours_of_their_own_those_of_table_2_first(write_run):
    names = ["mine", "mcp", "scratch", "hers"]
    found = grouped(*(write_run(name, method=name) for name in names))
    assert methods(found) == {"scratch": "Scratch", "mcp": "MCP", "hers": "hers", "mine": "mine"}
    assert list(method_colours(found)) == ["scratch", "mcp", "hers", "mine"]
    assert len(set(method_colours(found).values())) == 4


@pytest.mark.parametrize(
    ("setting", "key", "values"),
    [
        ("num_primitives", "num_primitives", [4, 8, 16]),
        ("mixer", "mixer__name", ["additive", "multiplicative"]),
        ("exploration", "exploration__name", ["action", "weights"]),
        ("curriculum", "curriculum__name", ["mixed", "none"]),
    ],
)
def test_an_ablation_holds_the_cells_that_differ_in_its_setting_alone(write_mcp, write_run, setting, key, values):
    folders = [write_mcp(f"{value}", **{key: value}) for value in reversed(values)]
    others = [write_mcp("longer", total_frames=2000), write_run("scratch"), write_mcp("task", task="carry")]
    (found,) = ablations(grouped(*folders, *others), setting)
    assert [cell.choices[setting] for cell in found.cells] == values
    assert all(cell.runs[0].total_frames == 1000 for cell in found.cells)


@pytest.mark.parametrize(("actor", "num_cells"), [("own.Actor", 1), ("own.Explorer", 2)])
def test_the_choice_of_exploration_separates_only_runs_whose_actor_explores_by_it(write_run, actor, num_cells):
    """The group ``exploration`` is in all configurations, but some methods have an actor of their own."""
    explorer = {"actor___target_": actor, "exploration__actor___target_": "own.Explorer"}
    folders = [
        write_run(f"{std}", seed=seed, exploration__actor__std=std, **explorer) for seed, std in enumerate((0.5, 1.0))
    ]
    assert len(grouped(*folders)) == num_cells


def test_training_the_primitives_as_well_is_an_ablation_of_transfer_alone(write_mcp):
    variants = [{}, {"transfer__freeze": ["observation_normaliser"]}]
    folders = [write_mcp(f"{s}-{i}", stage=s, **v) for s in ("transfer", "pretrain") for i, v in enumerate(variants)]
    (found,) = ablations(grouped(*folders), "trained")
    assert [(cell.stage, cell.choices["trained"]) for cell in found.cells] == [
        ("transfer", "gate"),
        ("transfer", "gate and primitives"),
    ]
