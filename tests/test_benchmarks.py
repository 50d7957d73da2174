"""The benchmarks run; what they measure is no business of a test."""

import csv
import importlib.util
import runpy
import sys
from itertools import product
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from torch.nn.functional import normalize

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.envs import Heading
from torchrl_mcp.runs import experiment, policies
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
    assert capsys.readouterr().out == "sb3-dummy-4: skipped, for stable-baselines3 is not installed\n"


def test_what_a_return_can_reach_is_measured_for_every_task(tmp_path):
    rows = run("ideal.py", tmp_path / "out.csv")
    assert {row["task"] for row in rows} == {"heading", "carry", "dribble", "holdout"}
    assert all(0 < float(row["standing"]) < float(row["ideal"]) <= 1 for row in rows)


def test_a_steered_gate_plays_every_task_that_moves_an_object(tmp_path):
    rows = run("steered.py", tmp_path / "out.csv")
    assert [row["task"] for row in rows] == ["carry"] * 2 + ["dribble"] * 3
    assert all(0 < float(row["normalised_return"]) < 1 for row in rows)


@pytest.mark.parametrize("target", [(5.0, 0.0), (0.0, 4.0), (-3.0, 0.5)], ids=["beyond the ball", "left", "behind"])
def test_the_rule_of_the_steered_gate_brings_a_ball_to_its_target(monkeypatch, target):
    monkeypatch.syspath_prepend(BENCHMARKS)
    behind = runpy.run_path(str(BENCHMARKS / "steered.py"))["behind"]
    player, ball, target = torch.zeros(1, 2), torch.tensor([[2.0, 0.0]]), torch.tensor([target])
    for _ in range(1000):  # a point that pushes the ball before it
        player = player + 0.03 * normalize(behind(ball - player, normalize(target - ball, dim=-1)), dim=-1)
        apart = ball - player
        ball = player + apart * (0.3 / apart.norm()).clamp(min=1.0)
        if (ball - target).norm() < 0.5:
            return
    raise AssertionError(f"the ball lies at {ball.tolist()}")


def test_the_soak_damages_checkpoints_and_none_is_accepted_wrongly(tmp_path):
    rows = run("soak.py", tmp_path / "out.csv", "flips")
    assert [row["check"] for row in rows] == ["resume", "evaluate"]
    for row in rows:
        assert int(row["refused"]) > 0
        assert int(row["refused"]) + int(row["harmless"]) == int(row["flips"]) == 20


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


def test_primitive_reuse_is_measured_for_every_size_and_precision(tmp_path):
    rows = measured("primitive_reuse.py", tmp_path / "out.csv")
    pairs = [(row["character"], row["precision"]) for row in rows]
    assert pairs == [("ant", "fp32"), ("ant", "bf16"), ("humanoid", "fp32"), ("humanoid", "bf16")]
    for row in rows:
        for side in ("reuse_ms", "no_reuse_ms"):
            assert 0 < float(row[f"{side}_min"]) <= float(row[side])
        assert float(row["ratio"]) > 0


@pytest.mark.parametrize("what", ["timestep", "stress"])
def test_characters_are_measured(tmp_path, what):
    rows = measured("characters.py", tmp_path / "out.csv", what, "--characters", "biped")
    assert {row["character"] for row in rows} == {"biped"}
    if what == "timestep":
        assert all(0 < float(row["smooth"]) < 0.1 for row in rows)
    else:
        assert all(row["diverged"] == "0" for row in rows)


def test_legs_are_measured_in_the_corpus_and_as_the_built_in_network_moves_them(tmp_path):
    rows = measured("legs_apart.py", tmp_path / "out.csv", "--characters", "biped")
    assert [row["motion"] for row in rows] == ["generated corpus", "built-in network"]
    for row in rows:
        assert int(row["frames"]) > 10
        assert float(row["deepest_mm"]) >= 0
        assert 1 >= float(row["deeper_than_0_mm"]) >= float(row["deeper_than_20_mm"]) >= 0


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


@pytest.mark.slow
def test_every_scene_has_room_for_its_contacts_and_constraints_on_warp(tmp_path):
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    rows = run("contact_room.py", tmp_path / "out.csv")
    assert len({row["scene"] for row in rows}) == 16
    for row in rows:
        assert 0 < float(row["of_contacts"]) < 0.8, row["scene"]
        assert 0 < float(row["of_constraints"]) < 0.8, row["scene"]
        assert row["faults"] == "0"


def test_the_model_of_scaling_finds_the_constants_that_made_the_times_and_predicts_by_them(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    scaling = runpy.run_path(str(BENCHMARKS / "scaling.py"))
    steps, rows = scaling["STEPS"], []
    for size, threads in product((64, 256, 1024), (1, 2)):
        row = {"num_envs": size, "threads": threads, "workers": 0}
        row["physics_seconds"] = steps * size * 1e-4 / (1, 1.5)[threads - 1]
        row["update_seconds"] = steps * size * 2e-4 / (1, 2)[threads - 1]
        rows.append(row | {"forward_seconds": steps * (1e-3 + size * 1e-5), "other_seconds": steps * 2e-3})
    found = scaling["fit"](rows)
    expected = {"physics_per_sample": 1e-4, "physics_gain": 1.5, "update_per_sample": 2e-4, "update_gain": 2.0}
    expected |= {"forward_per_step": 1e-3, "forward_per_sample": 1e-5, "other_per_step": 2e-3, "other_per_sample": 0}
    assert found == pytest.approx(expected, abs=1e-9)
    # Four cores: a third of physics is serial by Amdahl's law, and the update divides by four.
    seconds = 1e-4 * (1 / 3 + 2 / 3 / 4) + 2e-4 / 4 + 1e-5 + 3e-3 / 256
    assert scaling["predict"](256, 4, False, found, linear=False) == pytest.approx(1 / seconds, rel=1e-3)
    seconds += 1e-4 / 2.5 - 1e-4 * (1 / 3 + 2 / 3 / 4)
    assert scaling["predict"](256, 4, False, found, linear=True) == pytest.approx(1 / seconds, rel=1e-3)


def test_every_checkpoint_of_every_practice_is_evaluated_as_its_run_says(tmp_path, monkeypatch):
    settings = ["method=mcp", "character=biped", "task=dribble", "stage=transfer", "pretrained=builtin", "preset=smoke"]
    settings += ["width=1", "gating.network.width=0.1", "critic.width=0.1"]
    settings += ["logger=none", "progress_bar=false", "num_threads=1", "checkpoint_interval=1", "evaluation.episodes=0"]
    settings += ["training.total_frames=256", "keep_checkpoints=9", "task.evaluation.max_episode_steps=4"]
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        for name in ("printed", "emphasis"):
            experiment.train(compose("train", [*settings, f"practice={name}", f"run_dir={tmp_path / 'runs' / name}"]))
    monkeypatch.syspath_prepend(BENCHMARKS)
    monkeypatch.setattr(
        sys, "argv", ["practice.py", str(tmp_path / "runs"), "--episodes", "3", "--output", str(tmp_path / "practice")]
    )
    runpy.run_path(str(BENCHMARKS / "practice.py"), run_name="__main__")
    with (tmp_path / "practice.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["practice"], row["steps"]) for row in rows] == list(product(("printed", "emphasis"), ("128", "256")))
    cfg = policies.policy_config(tmp_path / "runs" / "emphasis")
    found = policies.evaluate_run(
        tmp_path / "runs" / "emphasis", episodes=3, seed=cfg.evaluation.seed, **cfg.evaluation.environment
    )["deterministic"]
    assert float(rows[-1]["normalised_return"]) == pytest.approx(found["normalised_return"], abs=1e-4)
    assert float(rows[-1]["success"]) == found["metrics"]["success"]
    assert (tmp_path / "practice_dribble.png").exists()
    assert (tmp_path / "practice_dribble_success.png").exists()


def test_a_gate_is_trained_by_soft_actor_critic_and_by_ppo(tmp_path):
    rows = run("off_policy.py", tmp_path / "out.csv", "--seeds", "0")
    assert [row["learner"] for row in rows] == ["SAC"] * 2 + ["PPO"] * 2
    assert all(0 < float(row["normalised_return"]) < 1 for row in rows)
    assert (tmp_path / "out.png").exists()


def test_the_gates_of_soft_actor_critic_play_the_composite_of_the_frozen_primitives(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    make_env = runpy.run_path(str(BENCHMARKS / "off_policy.py"))["make_env"]
    env = make_env(3, seed=0, max_episode_steps=5, curriculum={"random_first_length": True})  # episodes end one by one
    state, gates = env.reset(), torch.rand(3, 8)
    agent = policies.restore(builtin("mcp", "biped"), num_envs=1, seed=0)[1]
    for _ in range(7):
        before = env.base_env.get_state()
        observation = agent.parts["observation_normaliser"](env.base_env._observe(slice(None))["observation"].float())
        torch.testing.assert_close(state["observation"], observation)
        loc, scale = agent.parts["primitives"](observation)
        action = MultiplicativeGaussian(loc, scale, gates).mean.detach()
        step, state = env.step_and_maybe_reset(state.set("action", gates))
        assert torch.equal(step["action"], gates)
        env_alone = Heading("biped", 3, seed=0, max_episode_steps=5)
        expected = env_alone.step(env_alone.reset(before, set_state=True).set("action", action))
        torch.testing.assert_close(step["next", "reward"], expected["next", "reward"])
