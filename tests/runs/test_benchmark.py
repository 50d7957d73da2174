"""Benchmarks: what they consist of, and that they run, go on and survive failures."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp import conf
from torchrl_mcp.runs import benchmark, policies, records

BENCHMARKS = Path(conf.__file__).parent / "benchmark"
CHARACTERS = {"ant", "biped", "humanoid", "trex"}
METHODS = ["scratch", "finetune", "hierarchical", "option_critic", "moe", "latent_space", "mcp"]
# Table 2: which of the METHODS have a number in each row.
TABLE_2 = {
    ("heading", "biped"): "1111111",
    ("heading", "humanoid"): "1111111",
    ("heading", "trex"): "1101111",
    ("carry", "biped"): "1111111",
    ("dribble", "biped"): "1111111",
    ("dribble", "humanoid"): "1111111",
    ("dribble", "trex"): "1101111",
    ("holdout", "ant"): "1100011",
}


def jobs_of(*arguments):
    """The jobs of a benchmark, by way of what the command line does."""
    planned = []

    class Planned(Exception):
        pass

    def stop(jobs, *_):
        planned.extend(jobs)
        raise Planned

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "launch", stop)
        with pytest.raises(Planned):
            benchmark.main(arguments)
    return planned


def smoke(root, *arguments):
    benchmark.main(["benchmark=smoke", f"run_root={root}", "task.evaluation.max_episode_steps=20", *arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("benchmark") / "runs"
    smoke(root)
    return root


@pytest.fixture
def copy(finished, tmp_path):
    """The finished benchmark elsewhere: what to change and run again."""
    root = tmp_path / "runs"
    shutil.copytree(finished, root)
    return root


def folders(root):
    (pretraining,) = root.glob("holdout-ant/pretrain/mcp/*/seed0")
    (transfer,) = root.glob("holdout-ant/transfer/mcp/*/seed0")
    (scratch,) = root.glob("holdout-ant/transfer/scratch/*/seed0")
    return pretraining, transfer, scratch


def numbers(root):
    return {
        path.relative_to(root): json.loads(path.read_text())["deterministic"]["return"]
        for path in root.rglob("evaluation.json")
    }


def times(root):
    return {
        path: path.stat().st_mtime_ns for path in root.rglob("*") if path.is_file() and "multirun" not in path.parts
    }


def test_table_2_has_exactly_the_cells_of_the_paper():
    table = OmegaConf.to_container(OmegaConf.load(BENCHMARKS / "table2.yaml"))
    cells = [(c["task"], c["character"], c["method"]) for c in benchmark.expand(table["rows"], {})]
    paper = [(*row, m) for row, marks in TABLE_2.items() for m, mark in zip(METHODS, marks, strict=True) if mark == "1"]
    assert sorted(cells) == sorted(paper)
    assert table["params"] == {"seed": "0,1,2"}


def test_the_tasks_of_a_character_share_the_pretraining_of_their_method_and_seed(tmp_path):
    arguments = ["character=trex", "method=mcp,scratch", "seed=0,1"]
    jobs = jobs_of("benchmark=table2", f"run_root={tmp_path}", *arguments)
    sources = [job for job in jobs if job.config["stage"]["name"] == "pretrain"]
    assert [(job.config["task"]["name"], job.config["seed"]) for job in sources] == [("imitation", 0), ("imitation", 1)]
    transfers = [job for job in jobs if job.config["stage"]["name"] == "transfer"]
    assert len(transfers) == 2 * 2 * 2
    for job in transfers:
        if job.config["method"]["name"] == "scratch":
            assert job.needs is None
            continue
        (source,) = [other for other in sources if other.config["seed"] == job.config["seed"]]
        assert job.needs == source.folder
        assert job.config["pretrained"] == str(source.folder)
        assert f"pretrained={source.folder}" in job.overrides


def test_every_method_of_a_comparison_takes_as_many_steps(tmp_path):
    arguments = ["task=heading", "character=biped", "preset=comparison", "seed=0"]
    jobs = {job.folder: job for job in jobs_of("benchmark=table2", f"run_root={tmp_path}", *arguments)}
    transfers = [job for job in jobs.values() if job.config["stage"]["name"] == "transfer"]

    def steps(job):
        return job.config["training"]["total_frames"] + (steps(jobs[job.needs]) if job.needs else 0)

    assert {job.config["method"]["name"]: steps(job) for job in transfers} == dict.fromkeys(METHODS, 6_000_000)


def test_pretraining_ignores_how_much_the_gate_of_transfer_explores(tmp_path):
    arguments = ["task=heading", "character=biped", "method=mcp", "seed=0", "exploration=weights"]
    source, transfer = jobs_of(
        "benchmark=table2", f"run_root={tmp_path}", *arguments, "exploration.actor.logits_std=0.5"
    )
    assert source.config["exploration"]["name"] == "action"
    assert transfer.config["exploration"]["actor"]["logits_std"] == 0.5
    assert transfer.needs == source.folder


@pytest.mark.parametrize("setting", ["goal_positions=metres,logarithmic", "waypoint=true,false"])
def test_goals_of_the_task_of_transfer_share_a_pretraining(tmp_path, setting):
    arguments = ["task=dribble", "character=biped", "method=mcp", "seed=0", setting]
    jobs = jobs_of("benchmark=table2", f"run_root={tmp_path}", *arguments)
    assert [job.config["stage"]["name"] for job in jobs] == ["pretrain", "transfer", "transfer"]


def test_a_longer_transfer_shares_the_pretraining_of_a_shorter_one(tmp_path):
    def jobs(*budget):
        arguments = ["task=dribble", "character=biped", "method=mcp", "preset=comparison", "seed=0", *budget]
        return jobs_of("benchmark=table2", f"run_root={tmp_path}", *arguments)

    source, shorter = jobs()
    same, longer = jobs("budget.transfer.dribble=2000000", "budget.scratch.dribble=7000000")
    assert (same.folder, same.config) == (source.folder, source.config)
    assert longer.folder != shorter.folder
    assert (longer.needs, longer.config["training"]["total_frames"]) == (source.folder, 2_000_000)


@pytest.mark.parametrize(
    ("benchmark", "key", "pretrainings", "values"),
    [
        ("num_primitives", lambda cfg: cfg["num_primitives"], 4, [4, 8, 16, 32]),
        ("mixer", lambda cfg: cfg["mixer"]["name"], 2, ["multiplicative", "additive"]),
        ("exploration", lambda cfg: cfg["exploration"]["name"], 1, ["action", "weights"]),
        ("freeze", lambda cfg: "primitives" in cfg["transfer"]["freeze"], 1, [True, False]),
    ],
)
def test_an_ablation_pretrains_anew_only_what_pretraining_depends_on(tmp_path, benchmark, key, pretrainings, values):
    jobs = jobs_of(f"benchmark={benchmark}", f"run_root={tmp_path}", "task=holdout", "character=ant", "seed=0")
    sources = {job.folder: job for job in jobs if job.config["stage"]["name"] == "pretrain"}
    transfers = [job for job in jobs if job.config["stage"]["name"] == "transfer"]
    assert [key(job.config) for job in transfers] == values
    assert len(sources) == pretrainings == len({job.needs for job in transfers})
    if pretrainings > 1:
        assert all(key(sources[job.needs].config) == key(job.config) for job in transfers)


def test_pretraining_of_your_own_is_transferred_from_as_it_is(tmp_path):
    jobs = jobs_of("benchmark=mixer", f"run_root={tmp_path}", "mixer=multiplicative", "seed=0", "pretrained=builtin")
    assert [(job.config["pretrained"], job.needs) for job in jobs] == [("builtin", None)]


def test_what_concerns_the_task_of_transfer_is_kept_from_pretraining():
    settings = {"method": "mcp", "task": "carry", "task.transfer.success_reward": "true", "exploration": "weights"}
    task = {"name": "carry", "transfer": {}}
    expected = {"method": "mcp", "task": "imitation", "stage": "pretrain"}
    assert benchmark.pretraining_of(settings, task) == expected
    ant = {"name": "holdout", "pretrain": {}, "transfer": {}}
    added = {"method": "mcp", "task": "carry", "+task.transfer.success_reward": "true"}
    assert benchmark.pretraining_of(added, task) == expected
    settings = {"task": "holdout", "task.pretrain.max_episode_steps": "50"}
    assert benchmark.pretraining_of(settings, ant) == {**settings, "stage": "pretrain"}


def test_arguments_that_fit_no_row_are_refused_with_the_rows(tmp_path):
    arguments = ["benchmark=table2", f"run_root={tmp_path}", "task=carry", "character=ant"]
    refused(lambda: jobs_of(*arguments), "task=carry character=ant", "heading")
    arguments = ["benchmark=smoke", f"run_root={tmp_path}", "method=mcp,scrach"]
    refused(lambda: jobs_of(*arguments), "method=scrach", "scratch,mcp")
    rows = [{"method": ["mcp"], "curriculum": ["none"]}, {"method": ["moe"]}]
    benchmark.require_in_rows(rows, {"curriculum": ["mixed"], "seed": ["0"]})  # moe's row leaves them open


@pytest.mark.parametrize(
    "content", ["", "params: {}", "rows: {method: [mcp], width: [1]}", "rows: [{method: mcp}]", "rows: [mcp]"]
)
def test_a_benchmark_of_another_form_is_refused_with_the_form(tmp_path, content):
    (tmp_path / "benchmark").mkdir()
    (tmp_path / "benchmark" / "own.yaml").write_text(content)
    arguments = ["benchmark=own", f"hydra.searchpath=[file://{tmp_path}]", f"run_root={tmp_path}"]
    refused(lambda: jobs_of(*arguments), "benchmark=own", "rows")


def test_settings_that_folders_do_not_tell_apart_are_not_varied(tmp_path):
    arguments = ["benchmark=smoke", f"run_root={tmp_path}", "method=scratch", "autocast=true,false"]
    refused(lambda: jobs_of(*arguments), "autocast")


def test_a_benchmark_pretrains_transfers_and_evaluates(finished, capsys):
    pretraining, transfer, scratch = folders(finished)
    assert len(numbers(finished)) == 3
    assert OmegaConf.load(transfer / "config.yaml").pretrained == str(pretraining)
    before, after = (policies.restore(run, num_envs=1, seed=0)[1].parts.state_dict() for run in (pretraining, transfer))
    assert all(torch.equal(before[name], after[name]) for name in before if name.startswith("primitives"))
    for run in (pretraining, transfer, scratch):
        evaluation = json.loads((run / "evaluation.json").read_text())
        assert evaluation["episodes"] == evaluation["stochastic"]["episodes"] == 4
        origin = json.loads((run / "origin.json").read_text())
        assert origin["choices"]["preset"] == "smoke"
        assert origin["choices"]["method"] == OmegaConf.load(run / "config.yaml").method.name


def test_a_benchmark_that_is_complete_does_nothing_and_says_so_on_however_many_threads(copy, capsys):
    before = times(copy)
    smoke(copy, "num_threads=2", "checkpoint_interval=7")
    assert times(copy) == before
    assert "all 3 runs are complete" in capsys.readouterr().out


def test_a_benchmark_goes_on_where_it_was_interrupted(copy, finished):
    pretraining, transfer, scratch = folders(copy)
    # Killed while the pre-training was half done.
    (pretraining / "evaluation.json").unlink()
    max((pretraining / "checkpoints").iterdir()).unlink()
    shutil.rmtree(transfer)
    untouched = times(scratch)
    origin = (pretraining / "origin.json").read_bytes()
    smoke(copy)
    assert numbers(copy) == numbers(finished)
    assert (pretraining / "origin.json").read_bytes() == origin
    assert times(scratch) == untouched


def test_a_benchmark_is_the_same_wherever_it_is_and_however_its_place_is_written(copy, monkeypatch, capsys):
    before = times(copy)
    monkeypatch.chdir(copy.parent)
    smoke("./runs/")  # the finished one, in another folder
    assert "all 3 runs are complete" in capsys.readouterr().out
    assert times(copy) == before


def test_a_pretraining_with_other_networks_makes_another_run(copy, finished):
    pretraining, transfer, _ = folders(copy)
    first, last = sorted((pretraining / "checkpoints").iterdir())
    shutil.copyfile(first, last)  # as if it had not learnt
    before = times(copy)
    refused(lambda: smoke(copy), str(transfer), "pretrained")
    assert times(copy) == before


def test_a_failed_run_is_named_with_its_log_and_stops_only_what_needs_it(copy):
    pretraining, transfer, scratch = folders(copy)
    (pretraining / "evaluation.json").unlink()
    for file in (pretraining / "checkpoints").iterdir():
        file.write_bytes(b"something else")
    for run in (transfer, scratch):
        shutil.rmtree(run)
    with pytest.raises(SystemExit) as stop:
        smoke(copy)
    log = pretraining / "train.log"
    assert stop.value.code.splitlines() == [
        f"failed: {pretraining}, see {log}",
        f"not run: {transfer}, which needs {pretraining}",
    ]
    assert "Traceback" in log.read_text()
    assert "damaged" in log.read_text()
    assert (scratch / "evaluation.json").exists()
    assert not transfer.exists()


def test_a_folder_of_other_settings_is_not_taken_for_done(copy):
    before = times(copy)
    other = not OmegaConf.load(folders(copy)[0] / "config.yaml").autocast  # than the machine's own choice
    refused(lambda: smoke(copy, f"autocast={other}"), "autocast", *map(str, folders(copy)))
    assert times(copy) == before


def test_a_benchmark_of_your_own_code_reads_its_runs_without_being_told_to_trust_them(tmp_path, monkeypatch, capsys):
    lines = ["from torchrl_mcp.methods import scratch", "def parts(*args, **kwargs):"]
    (tmp_path / "own_parts.py").write_text("\n".join([*lines, "    return scratch.gaussian_parts(*args, **kwargs)"]))
    monkeypatch.syspath_prepend(tmp_path)
    for _ in range(2):  # the second time, the run folder is there before
        smoke(tmp_path / "runs", "method=scratch", "parts._target_=own_parts.parts")
        assert "the run is complete" in capsys.readouterr().out
    refused(lambda: records.run_config(next(tmp_path.rglob("config.yaml")).parent), "--trust own_parts")


def needs_plugin(name):
    missing = find_spec("hydra_plugins") is None or find_spec(f"hydra_plugins.hydra_{name}_launcher") is None
    return pytest.mark.skipif(missing, reason=f"needs hydra-{name}-launcher: an optional dependency")


@pytest.mark.slow
@pytest.mark.parametrize(
    "launcher",
    [
        pytest.param(["joblib", "hydra.launcher.n_jobs=2"], marks=needs_plugin("joblib"), id="joblib"),
        pytest.param(["submitit_local", "hydra.launcher.timeout_min=5"], marks=needs_plugin("submitit"), id="submitit"),
        pytest.param(["ray_local", "hydra.launcher.ray.init.num_cpus=2"], marks=needs_plugin("ray"), id="ray"),
    ],
)
def test_launchers_give_the_numbers_of_one_process(tmp_path, finished, monkeypatch, launcher):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    choice, *settings = launcher
    smoke(tmp_path / "runs", f"hydra/launcher={choice}", *settings)
    assert numbers(tmp_path / "runs") == numbers(finished)


@needs_plugin("submitit")
def test_the_slurm_launcher_composes_and_queues_again_what_reached_its_time_limit():
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        overrides = ["hydra/launcher=slurm", "hydra.launcher.partition=long", "benchmark=table2"]
        launcher = compose("train", overrides, return_hydra_config=True).hydra.launcher
    assert launcher["_target_"].endswith("SlurmLauncher")
    assert launcher.partition == "long"
    assert launcher.max_num_timeout > 0


def test_a_plan_refers_to_hydra_for_the_names_of_folders_and_leaves_it_as_it_was():
    former = HydraConfig.instance().cfg
    (*_, job) = jobs_of("benchmark=smoke", "method=scratch", "lmbda=0.5")
    assert "lmbda-0.5" in str(job.folder)
    assert HydraConfig.instance().cfg is former


def test_rows_with_numbers_are_selected_by_the_command_line():
    rows = [{"num_primitives": [4, 8]}]
    assert list(benchmark.expand(rows, {"num_primitives": ["4"]})) == [{"num_primitives": "4"}]


def test_nothing_and_flags_in_rows_are_those_of_the_command_line():
    rows = [{"pretrained": [None], "progress_bar": [True, False]}]
    assert list(benchmark.expand(rows, {"progress_bar": ["true"]})) == [{"pretrained": "null", "progress_bar": "true"}]
