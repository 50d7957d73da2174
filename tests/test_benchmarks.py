"""The benchmarks run; what they measure is no business of a test."""

import csv
import importlib
import importlib.util
import runpy
import sys
from itertools import product
from pathlib import Path

import pytest
import torch
from torch.distributions import Independent, Normal

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.envs import Heading
from torchrl_mcp.evaluation.rollout import Evaluation
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.builtin import builtin

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
ABOUT = {"commit", "date", "processor", "instructions", "cores", "python", "torch", "torchrl", "mujoco", "threads"}


def run(script, output, *arguments):
    """Run a script in this process, which has imported PyTorch, and return the rows that it writes."""
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        patch.chdir(output.parent)
        patch.setattr(sys, "argv", [script, *map(str, arguments), "--quick", "--output", str(output)])
        runpy.run_path(str(BENCHMARKS / script), run_name="__main__")
    torch.set_num_threads(threads)
    with output.open(newline="") as file:
        return list(csv.DictReader(file))


def measured(script, output, *arguments):
    """The same of a script that measures: its rows describe the machine."""
    rows = run(script, output, "--threads", "1", *arguments)
    assert set(rows[0]) >= ABOUT
    return rows


@pytest.fixture(scope="module")
def training(tmp_path_factory):
    """Rows by contender."""
    rows = measured("training_throughput.py", tmp_path_factory.mktemp("training") / "out.csv")
    return {row["contender"]: row for row in rows}


def test_training_throughput_is_measured_and_split_into_shares(training):
    row = training["ours-scratch-bf16"]
    assert 0 < float(row["slowest"]) <= float(row["samples_per_second"]) <= float(row["fastest"])
    assert sum(float(row[key]) for key in ("physics", "forward", "update", "other")) == pytest.approx(1, abs=0.01)
    assert float(row["memory_mib"]) > 0


def test_training_throughput_is_compared_with_stable_baselines3(training):
    pytest.importorskip("stable_baselines3")
    row = training["sb3-dummy-16"]
    assert float(training["ours-scratch-bf16"]["of_best_sb3"]) > 0
    assert float(row["of_best_sb3"]) == 1
    assert 0 < float(row["update"]) < 1
    assert row["physics"] == ""


def test_stable_baselines3_is_left_out_and_named_where_it_is_not_installed(monkeypatch, capsys):
    monkeypatch.syspath_prepend(BENCHMARKS)  # as of a script that is run
    available = runpy.run_path(str(BENCHMARKS / "training_throughput.py"))["available"]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert available(["ours-mcp-fp32", "sb3-dummy-4"]) == ["ours-mcp-fp32"]
    assert capsys.readouterr().out == "sb3-dummy-4: skipped, because stable-baselines3 is not installed\n"


def test_what_a_return_can_reach_is_measured_for_every_task(tmp_path):
    rows = run("ideal.py", tmp_path / "out.csv")
    assert {row["task"] for row in rows} == {"heading", "carry", "dribble", "holdout"}
    assert all(0 < float(row["standing"]) < float(row["ideal"]) <= 1 for row in rows)


def test_a_primitive_of_weight_0_is_out_of_the_product_and_the_others_keep_their_weights(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    lesion = runpy.run_path(str(BENCHMARKS / "lesions.py"))["Lesion"]
    loc, scale, gates = torch.randn(5, 4, 3), torch.rand(5, 4, 3) + 0.1, torch.rand(5, 4)
    others = [0, 1, 3]
    lost = MultiplicativeGaussian(loc, scale, lesion(2, 0.0)(gates))
    expected = MultiplicativeGaussian(loc[:, others], scale[:, others], gates[:, others])
    torch.testing.assert_close((lost.mean, lost.stddev), (expected.mean, expected.stddev))
    held = lesion(2, 0.7)(gates)
    assert (held[:, 2] == 0.7).all()
    assert torch.equal(held[:, others], gates[:, others])


@pytest.mark.trajectories
def test_the_biped_walks_longer_intact_than_without_a_primitive(tmp_path):
    intact, *lesions = run("lesions.py", tmp_path / "out.csv")
    assert [row["lesion"] for row in lesions] == ["weight 0", "mean weight"]
    for row in (intact, *lesions):
        clips = [float(value) for name, value in row.items() if name.startswith("walk_")]
        assert float(row["completed"]) == pytest.approx(sum(clips) / 14, abs=1e-3)
    assert float(lesions[0]["steps"]) < float(intact["steps"]) <= 300


def test_the_soak_damages_checkpoints_and_none_is_accepted_wrongly(tmp_path):
    rows = run("soak.py", tmp_path / "out.csv", "flips")
    assert [row["check"] for row in rows] == ["resume", "evaluate"]
    for row in rows:
        assert int(row["refused"]) > 0
        assert int(row["refused"]) + int(row["harmless"]) == int(row["flips"]) == 20


@pytest.mark.slow
def test_the_soak_acts_unfitly_in_every_task_and_all_that_comes_of_it_is_an_end_of_the_episode(tmp_path):
    rows = run("soak.py", tmp_path / "out.csv", "steps")
    assert len({(row["task"], row["character"]) for row in rows}) == 13
    assert sum(int(row["unfit"]) for row in rows) > 30
    assert all(row["missed"] == row["not_finite"] == "0" for row in rows)


@pytest.mark.slow
def test_the_soak_kills_runs_and_fills_their_disk_and_what_comes_of_them_is_what_nobody_disturbed(tmp_path):
    rows = run("soak.py", tmp_path / "out.csv", "training")
    assert [row["collector"] for row in rows] == ["local", "processes"]
    for row in rows:
        assert int(row["killed"]) > 0
        assert row["other_ends"] == row["changed"] == row["wrong"] == "0"
        assert float(row["slowest_end_s"]) < 30
    assert rows[0]["differing"] == "0"


def test_tasks_are_measured_beside_bare_mujoco(tmp_path):
    rows = measured("task_throughput.py", tmp_path / "out.csv", "--tasks", "Heading", "--characters", "biped")
    (row,) = rows
    assert float(row["of_raw"]) > 0
    assert 0 < float(row["physics"]) < 1


def test_a_gpu_that_is_not_there_is_told_before_anything_is_measured(tmp_path, capsys):
    if torch.cuda.is_available():
        pytest.skip("there is one")
    with pytest.raises(SystemExit):
        run("gpu_throughput.py", tmp_path / "out.csv")
    assert "finds no CUDA device" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.slow
def test_throughput_on_a_gpu_is_rehearsed_without_one(tmp_path):
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    rows = measured("gpu_throughput.py", tmp_path / "out.csv", "--device", "cpu")
    assert [row["physics"] for row in rows] == ["warp", "mujoco"]
    assert {row["device"] for row in rows} == {"cpu"}
    assert all(float(row[name]) > 0 for row in rows for name in ("steps", "samples", "setup_seconds"))


def test_the_model_of_scaling_finds_the_constants_that_made_the_times_and_predicts_by_them(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    scaling = runpy.run_path(str(BENCHMARKS / "scaling.py"))
    steps, rows = scaling["STEPS"], []
    for size, threads in product((64, 256, 1024), (1, 2)):
        row = {"num_envs": size, "threads": threads, "workers": 0}
        row["physics_seconds"] = steps * size * 1e-4 / (1, 1.5)[threads - 1]
        row["update_seconds"] = steps * size * 2e-4 / (1, 2)[threads - 1]
        row |= {"forward_seconds": steps * (1e-3 + size * 1e-5), "other_seconds": steps * 2e-3}
        rows.append(row | {"collection_seconds": 0.0})
    found = scaling["fit"](rows)
    expected = {"physics_per_sample": 1e-4, "physics_gain": 1.5, "update_per_sample": 2e-4, "update_gain": 2.0}
    expected |= {"forward_per_step": 1e-3, "forward_per_sample": 1e-5, "other_per_step": 2e-3, "other_per_sample": 0}
    assert found == pytest.approx(expected, abs=1e-9)
    shares = {row["section"]: row["serial"] for row in scaling["serial_shares"](rows)}
    assert shares == {"physics": "33%", "forward": "100%", "update": "0%", "other": "100%"}
    # Four cores: a third of physics is serial by Amdahl's law, and the update divides by four.
    seconds = 1e-4 * (1 / 3 + 2 / 3 / 4) + 2e-4 / 4 + 1e-5 + 3e-3 / 256
    assert scaling["predict"](256, 4, False, found, linear=False) == pytest.approx(1 / seconds, rel=1e-3)
    seconds += 1e-4 / 2.5 - 1e-4 * (1 / 3 + 2 / 3 / 4)
    assert scaling["predict"](256, 4, False, found, linear=True) == pytest.approx(1 / seconds, rel=1e-3)


def test_a_gate_is_trained_by_soft_actor_critic_and_by_ppo(tmp_path):
    rows = run("off_policy.py", tmp_path / "out.csv", "--seeds", "0")
    assert [row["learner"] for row in rows] == ["SAC"] * 2 + ["PPO"] * 2
    assert all(0 < float(row["normalised_return"]) < 1 for row in rows)
    assert (tmp_path / "out.png").exists()


def test_learners_are_drawn_that_have_rows(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    draw = runpy.run_path(str(BENCHMARKS / "off_policy.py"))["draw"]
    rows = [{"learner": "SAC", "steps": steps, "cpu_seconds": 1.0, "normalised_return": 0.5} for steps in (64, 96)]
    assert [[line.get_label() for line in axes.lines] for axes in draw(rows).axes] == [["SAC"]] * 2


def test_checkpoints_are_evaluated_after_numbers_of_steps_and_only_once(command, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    budgets = importlib.import_module("budgets")
    monkeypatch.setattr(budgets, "BUDGETS", (128, 250, 300, 5000))
    for method in ("mcp", "latent_space"):
        network = BENCHMARKS / "results" / "table2" / "networks" / f"{method}-biped-0.torchrl"
        words = ["preset=smoke", "task=dribble", f"method={method}", "stage=transfer", f"pretrained={network}"]
        settings = ["checkpoint_interval=1", "keep_checkpoints=9", "task.evaluation.max_episode_steps=9"]
        assert command("train", *words, *settings, f"run_root={tmp_path}/runs").returncode == 0
    output = tmp_path / "budgets.csv"
    arguments = ["budgets.py", str(tmp_path / "runs"), "--episodes", "2", "--output", str(output)]
    monkeypatch.setattr(sys, "argv", arguments)
    budgets.main()
    first = output.read_text()
    rows = list(csv.DictReader(first.splitlines()))
    # of the checkpoints after 128, 256, 384 and 512 steps, the third has more than 5 % above 300
    assert sorted({(row["method"], row["budget"], row["steps"]) for row in rows}) == [
        (method, budget, steps)
        for method in ("latent_space", "mcp")
        for budget, steps in (("128", "128"), ("250", "256"))
    ]
    assert len(rows) == 8  # two modes
    assert (tmp_path / "budgets.png").exists()
    monkeypatch.setattr(budgets.policies, "evaluation", None)
    budgets.main()
    assert output.read_text() == first


def test_updates_are_repeated_and_the_policy_is_compared_before_and_after(command, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    network = BENCHMARKS / "results" / "table2" / "networks" / "latent_space-biped-0.torchrl"
    words = ["preset=smoke", "task=dribble", "method=latent_space", "stage=transfer", f"pretrained={network}"]
    settings = ["checkpoint_interval=1", "keep_checkpoints=9", "task.evaluation.max_episode_steps=9"]
    assert command("train", *words, *settings, f"run_dir={tmp_path}/run").returncode == 0
    main = runpy.run_path(str(BENCHMARKS / "divergence.py"))["main"]
    output = tmp_path / "divergence.csv"
    arguments = ["divergence.py", str(tmp_path / "run"), "--updates", "1", "--output", str(output)]
    monkeypatch.setattr(sys, "argv", arguments)
    main()
    with (tmp_path / "run" / "metrics.csv").open() as file:
        trained = {row["iteration"]: row["loss/kl"] for row in csv.DictReader(file)}
    repeated = {row["iteration"]: row["estimate"] for row in csv.DictReader(output.open())}
    assert repeated == {iteration: trained[iteration] for iteration in ("2", "3", "4")}


def test_the_extremes_of_an_update_are_separated_from_the_other_samples(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    changes = runpy.run_path(str(BENCHMARKS / "divergence.py"))["changes"]
    states = torch.zeros(1000, 1)
    states[7] = -6.0
    means = torch.full((1000, 1), 0.1)
    means[7] = 10.0
    # Between normal distributions of unit variance, the divergence is half of the squared distance of the means.
    row = changes(states, Independent(Normal(torch.zeros(1000, 1), 1.0), 1), Independent(Normal(means, 1.0), 1))
    expected = {"exact": (999 * 0.005 + 50) / 1000, "without_extremes": 0.005, "median": 0.005, "largest": 50.0}
    expected |= {"far_inputs": 0.001, "far_inputs_of_extremes": 1.0, "smallest_std": 1.0}
    assert row == pytest.approx(expected)


def test_of_few_samples_at_least_one_is_an_extreme(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    changes = runpy.run_path(str(BENCHMARKS / "divergence.py"))["changes"]
    means = torch.zeros(100, 1)
    means[7] = 10.0
    row = changes(means, Independent(Normal(torch.zeros(100, 1), 1.0), 1), Independent(Normal(means, 1.0), 1))
    assert (row["without_extremes"], row["far_inputs_of_extremes"]) == (0.0, 1.0)


def test_every_episode_of_a_transport_task_has_one_outcome(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    outcomes = runpy.run_path(str(BENCHMARKS / "failures.py"))["outcomes"]
    steps = torch.arange(1.0, 13.0)  # a step per second
    distances = [steps, 3 + steps, steps, 0.9 - 0.001 * steps, 1.1 + 0 * steps, 0.5 + 0.2 * (steps % 2)]
    played = Evaluation(
        returns=torch.zeros(6),
        lengths=torch.tensor([12, 5, 6, 12, 12, 12]),
        terminated=torch.tensor([False, True, True, False, False, False]),
        metrics={"success": torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])},
    )
    found = outcomes(played, torch.stack(distances, 1), timestep=1.0)
    chosen = {name: flags.nonzero().flatten().tolist() for name, flags in found.items()}
    expected = {"success": [0], "falls at the start": [1], "falls later": [2], "stops short": [3], "other": [4, 5]}
    assert chosen == expected


def test_failures_of_a_run_are_counted(monkeypatch, capsys):
    monkeypatch.syspath_prepend(BENCHMARKS)
    main = runpy.run_path(str(BENCHMARKS / "failures.py"))["main"]
    network = str(builtin("mcp", "biped", "dribble"))
    monkeypatch.setattr(sys, "argv", ["failures.py", network, "--episodes", "4"])
    main()
    shares = [int(cell[:-1]) for cell in capsys.readouterr().out.split() if cell.endswith("%")]
    assert len(shares) == 5
    assert sum(shares) == 100


def test_the_gates_of_soft_actor_critic_play_the_composite_of_the_frozen_primitives(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    make_env = runpy.run_path(str(BENCHMARKS / "off_policy.py"))["make_env"]
    env = make_env(3, seed=0, max_episode_steps=5, curriculum={"random_first_length": True})  # episodes end one by one
    state, gates = env.reset(), torch.rand(3, 8)
    agent = policies.restore(builtin("mcp", "biped"), num_envs=1, seed=0)[1]
    for _ in range(7):
        before = env.base_env.get_state()
        observation = agent.parts["observation_normaliser"](env.base_env.observe(slice(None))["observation"].float())
        torch.testing.assert_close(state["observation"], observation)
        loc, scale = agent.parts["primitives"](observation)
        action = MultiplicativeGaussian(loc, scale, gates).mean.detach()
        step, state = env.step_and_maybe_reset(state.set("action", gates))
        assert torch.equal(step["action"], gates)
        env_alone = Heading("biped", 3, seed=0, max_episode_steps=5)
        expected = env_alone.step(env_alone.reset(before, set_state=True).set("action", action))
        torch.testing.assert_close(step["next", "reward"], expected["next", "reward"])


def test_every_distribution_draws_an_action_with_its_log_probability_in_each_state():
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        contenders = runpy.run_path(str(BENCHMARKS / "throughput.py"))["DRAWING"]
    for name, make in contenders.items():
        if "compiled" not in name:
            assert make(4)(0).shape == (4,)
    torch.set_num_threads(threads)
