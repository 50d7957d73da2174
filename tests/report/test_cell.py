"""The numbers and remarks of a cell."""

import json
import math

import pytest

from torchrl_mcp.report.comparison import caveats, cells
from torchrl_mcp.report.results import read_run

GATE_KEPT = ["primitives", "gating", "observation_normaliser"]


def grouped(*folders):
    return cells([read_run(folder) for folder in folders])


def test_only_complete_runs_count_and_the_others_are_remarked(write_run):
    (cell,) = grouped(
        write_run("a", score=0.5),
        write_run("b", seed=1, score=0.7),
        write_run("c", seed=2, score=9.0, progress=0.25),
        write_run("d", seed=3, progress=0.25),
        write_run("e", seed=4),
        write_run("f", seed=5, score=math.nan),
    )
    assert cell.mean().value == pytest.approx(0.6)
    assert cell.remarks == ["seeds 2, 3 unfinished, 25% of the steps", "seed 4 not evaluated", "seed 5 damaged"]


def test_a_cell_without_a_complete_run_has_no_numbers_but_a_standing(write_run):
    (cell,) = grouped(write_run("a", progress=0.2), write_run("b", seed=1, progress=0.4))
    assert (cell.mean(), cell.gap, cell.standing) == (None, None, "30% trained")


def test_a_single_seed_has_the_interval_of_its_episodes(write_run):
    (cell,) = grouped(write_run("a", score=0.5))
    assert (cell.mean().low, cell.mean().high) == (0.48, 0.52)
    assert math.isnan(cell.deviation())
    assert cell.remarks == ["one seed: the interval is over its episodes"]


def test_a_seed_that_is_stored_twice_counts_once(write_run):
    twice = write_run("a", score=0.4), write_run("b", score=0.6)
    (one,) = grouped(*twice)
    assert (one.mean().value, one.mean().low, one.mean().high) == pytest.approx((0.5, 0.48, 0.52))
    assert one.spread == ""
    assert one.remarks == ["one seed: the interval is over its episodes", "seed 0 occurs more than once"]
    (two,) = grouped(*twice, write_run("c", seed=1, score=0.8))
    assert two.returns("stochastic") == pytest.approx([0.4, 0.7])
    assert (two.mean().value, two.mean().low, two.mean().high) == pytest.approx((0.65, 0.5, 0.8))
    assert two.spread == "range "
    assert two.deviation() == pytest.approx(0.3 / math.sqrt(2))
    assert (len(two.by_seed), two.begun) == (2, 2)


def test_the_return_in_which_a_success_pays_is_a_mean_over_seeds_unless_a_run_lacks_it(write_run):
    folders = [write_run(name, seed=seed, score=0.5) for seed, name in enumerate("ab")]
    assert grouped(*folders)[0].success_return is None
    for folder, score in zip(folders, (0.4, 0.8), strict=True):
        path = folder / "evaluation.json"
        content = json.loads(path.read_text())
        content["deterministic"]["success_return"] = score
        path.write_text(json.dumps(content))
    assert grouped(*folders)[0].success_return == pytest.approx(0.6)
    assert grouped(*folders, write_run("c", seed=2, score=0.5))[0].success_return is None


def test_a_seed_that_occurs_twice_and_different_evaluations_are_remarked(write_run):
    (cell,) = grouped(write_run("a", score=0.5), write_run("b", score=0.5, episodes=32))
    assert cell.remarks == [
        "one seed: the interval is over its episodes",
        "seed 0 occurs more than once",
        "mixed evaluations: 128 episodes of seed 12345, 32 episodes of seed 12345",
    ]


def test_an_evaluation_in_other_episodes_than_configured_is_remarked(write_run):
    planned = {"evaluation__episodes": 128, "evaluation__seed": 12345}
    runs = [write_run(f"{seed}", seed=seed, score=0.5, episodes=32, **planned) for seed in range(2)]
    (cell,) = grouped(*runs)
    assert cell.remarks == ["seeds 0, 1 evaluated in 32 episodes of seed 12345, unlike after training"]


def test_an_evaluation_in_another_task_than_configured_is_remarked(write_run):
    planned = {"success_reward": False, "speed": 1.0, "curriculum": None, "place": {"low": 0.0, "high": 1.0}}
    held = {"success_reward": True, "speed": 1.0, "place": {"low": 0.0, "high": 2.0}, "added_later": 1}
    settings = {"score": 0.5, "evaluation__environment": planned}
    runs = [write_run(f"{seed}", seed=seed, environment=held, **settings) for seed in range(2)]
    (cell,) = grouped(*runs)
    assert cell.remarks == [
        "seeds 0, 1 evaluated in 128 episodes of seed 12345 with success_reward=True with place.high=2.0, "
        "unlike after training"
    ]


def test_evaluations_in_different_tasks_are_remarked(write_run):
    environments = [{"speed": 1.0, "success_reward": rewarded} for rewarded in (False, True)]
    (cell,) = grouped(*(write_run(str(i), seed=i, score=0.5, environment=use) for i, use in enumerate(environments)))
    told = (
        "evaluations: 128 episodes of seed 12345 with success_reward=False, "
        "128 episodes of seed 12345 with success_reward=True"
    )
    assert cell.remarks == [f"mixed {told}"]
    assert caveats([cell]) == [told]


@pytest.mark.parametrize(
    ("sources", "told"),
    [
        (("runs/mcp/seed0", "runs/mcp/seed1"), []),
        ([f"runs/mcp/seed{seed}/checkpoints/checkpoint-000000004096.torchrl" for seed in (0, 1)], []),
        (
            [f"checkpoint-00000000{steps}.torchrl" for steps in (4096, 8192)],
            ["mixed pre-trainings: checkpoint-000000004096.torchrl, checkpoint-000000008192.torchrl"],
        ),
        (("networks/mcp-biped-0.torchrl", "networks/mcp-biped-1.torchrl"), []),
        (("runs/mcp/seed0", "runs/longer/seed1"), ["mixed pre-trainings: runs/longer, runs/mcp"]),
        (("builtin:biped", None), ["mixed pre-trainings: builtin:biped, none"]),
    ],
    ids=str,
)
def test_seeds_that_begin_with_different_pretrainings_are_remarked(write_mcp, sources, told):
    (cell,) = grouped(*(write_mcp(str(i), seed=i, score=0.5, pretrained=source) for i, source in enumerate(sources)))
    assert cell.remarks == told


def test_a_method_s_own_settings_are_standard_in_both_stages(write_mcp):
    transferred, eight, sixteen = grouped(
        write_mcp("a", stage="pretrain", task="imitation"),
        write_mcp("b", stage="pretrain", task="imitation", num_primitives=16),
        write_mcp("c", pretrained="a"),
    )
    assert [cell.is_standard for cell in (transferred, eight, sixteen)] == [True, True, False]


@pytest.mark.parametrize("settings", [{"transfer__keep": GATE_KEPT}, {"symmetry": "augment"}], ids=["gate", "symmetry"])
def test_a_kept_gate_and_symmetry_are_variants_whatever_the_method_tells(write_mcp, settings):
    usual, variant = grouped(write_mcp("a", score=0.2), write_mcp("b", score=0.8, **settings))
    assert (usual.is_standard, variant.is_standard, variant.reported) == (True, False, None)


def test_what_training_used_and_the_evaluation_did_not_is_remarked(write_run):
    evaluated = {"speed": 1.0, "curriculum": None}
    aids = {"initial_states": {"rest": 0.2, "motions": 0.8}, "mixture": [{"weight": 2}], "reward_weights": None}
    trained = {"speed": 1.0, "curriculum": aids}
    runs = {"plain": evaluated, "practised": trained}
    plain, practised = grouped(
        *(
            write_run(name, curriculum__name=name, task__transfer=use, task__evaluation=evaluated)
            for name, use in runs.items()
        )
    )
    assert [cell.settings for cell in (plain, practised)] == [{"curriculum": "plain"}, {"curriculum": "practised"}]
    assert not any(remark.startswith("trained with") for remark in plain.remarks)
    (remark,) = (remark for remark in practised.remarks if remark.startswith("trained with"))
    assert remark == (
        "trained with curriculum=practised: curriculum.initial_states.rest=0.2, "
        "curriculum.initial_states.motions=0.8, curriculum.mixture.0.weight=2"
    )


def test_the_gap_is_our_mean_less_the_papers(write_mcp):
    (cell,) = grouped(write_mcp("a", score=0.5), write_mcp("b", seed=1, score=0.7))
    assert cell.reported == (0.976, 0.002)
    assert cell.gap == pytest.approx(0.6 - 0.976)


@pytest.mark.parametrize(
    "settings",
    [
        {"num_primitives": 4},
        {"mixer__name": "additive"},
        {"transfer__freeze": []},
        {"stage": "pretrain"},
        {"task": "juggle"},
        {"character": "ant"},
    ],
    ids=str,
)
def test_the_paper_has_no_figure_for_what_it_did_not_measure(write_mcp, settings):
    (cell,) = grouped(write_mcp("a", score=0.5, **settings))
    assert (cell.reported, cell.gap) == (None, None)


@pytest.mark.parametrize(("seeds", "name"), [(1, ""), (2, "range "), (3, "range "), (4, "")])
def test_what_a_bootstrap_of_few_seeds_gives_is_called_their_range(write_run, seeds, name):
    scores = [0.4, 0.6, 0.7, 0.9][:seeds]
    (cell,) = grouped(*(write_run(str(seed), seed=seed, score=score) for seed, score in enumerate(scores)))
    assert cell.spread == name
    if name:
        assert (cell.mean().low, cell.mean().high) == pytest.approx((min(scores), max(scores)))


def test_runs_of_the_demonstration_are_named_as_its_own(write_run):
    folder = write_run("demo/transfer", preset=None, demo__minutes=8)
    assert read_run(folder).preset == "demo"
    assert read_run(write_run("mine", preset=None)).preset == "unknown"


def test_the_place_between_standing_still_and_the_ideal_is_averaged_over_seeds(write_run):
    folders = [write_run(str(seed), seed=seed, task="dribble", score=0.5) for seed in range(2)]
    (without,) = grouped(*folders)
    assert without.reach == {}
    for folder, skill in zip(folders, (0.5, 0.7), strict=True):
        found = json.loads((folder / "evaluation.json").read_text())
        found["deterministic"]["reach"] = {"skill": skill, "standing": 0.2, "ideal": 0.6}
        (folder / "evaluation.json").write_text(json.dumps(found))
    (cell,) = grouped(*folders)
    assert len(cell.complete) == 2
    assert cell.reach == pytest.approx({"skill": 0.6, "standing": 0.2, "ideal": 0.6})


def test_a_reach_of_another_version_is_left_out(write_run):
    folder = write_run("a", task="dribble", score=0.5)
    found = json.loads((folder / "evaluation.json").read_text())
    found["deterministic"]["reach"] = {"place": 0.5, "standing": 0.2, "ideal": 0.6}
    (folder / "evaluation.json").write_text(json.dumps(found))
    (cell,) = grouped(folder)
    assert (len(cell.complete), cell.reach) == (1, {})


def test_a_seed_that_occurs_twice_counts_once_in_every_mean(write_run):
    folders = [write_run(name, seed=seed, task="dribble", score=score) for name, seed, score in COPIES]
    for folder, (_, _, score) in zip(folders, COPIES, strict=True):
        found = json.loads((folder / "evaluation.json").read_text())
        found["deterministic"] |= {"metrics": {"success": score}, "success_return": score}
        found["deterministic"]["reach"] = {"skill": score, "standing": 0.2, "ideal": 0.6}
        (folder / "evaluation.json").write_text(json.dumps(found))
    (cell,) = grouped(*folders)
    mean = (0.2 + (0.6 + 0.8) / 2) / 2
    assert cell.mean().value == pytest.approx(mean)
    assert cell.metrics["success"] == pytest.approx(mean)
    assert cell.reach["skill"] == pytest.approx(mean)
    assert cell.success_return == pytest.approx(mean)


COPIES = [("a", 0, 0.2), ("b", 1, 0.6), ("copy", 1, 0.8)]
"""Runs by name, with seed and result; two runs have the same seed."""


def test_metrics_are_means_over_seeds_of_deterministic_episodes_without_terms_of_the_reward(write_run):
    folders = [write_run(str(seed), seed=seed, task="carry", score=0.5) for seed in range(2)]
    for folder, share in zip(folders, (0.25, 0.75), strict=True):
        found = json.loads((folder / "evaluation.json").read_text())
        found["deterministic"]["metrics"] = {"success": share, "reward_pose": 0.3}
        found["stochastic"]["metrics"] = {"success": 0.0, "reward_pose": 0.3}
        (folder / "evaluation.json").write_text(json.dumps(found))
    (cell,) = grouped(*folders)
    assert cell.metrics == {"success": 0.5}


def test_the_speed_is_of_the_steps_that_were_taken(write_run):
    (cell,) = grouped(write_run("a", score=0.5), write_run("b", seed=1, progress=0.5))
    assert cell.speed == pytest.approx((1000 + 500) / (10 + 5))  # the runs of the fixture take 10 ms per step


def test_whole_numbers_with_and_without_a_decimal_point_are_the_same_setting(write_run):
    folders = [write_run("a", score=0.5, width=1), write_run("b", seed=1, score=0.5, width=1.0)]
    (cell,) = grouped(*folders)
    assert [run.seed for run in cell.runs] == [0, 1]
