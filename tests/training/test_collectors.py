"""Collection in workers: the same as in this process, but elsewhere."""

import csv
import multiprocessing
import shutil
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec

import pytest
import torch
from sessions import living
from tensordict.nn import TensorDictModule, TensorDictSequential

from torchrl_mcp.envs import Holdout
from torchrl_mcp.runs import build, experiment, records
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training import checkpoint, collectors
from torchrl_mcp.training.collectors import Batches, LocalSource, RemoteSource
from torchrl_mcp.training.progress import Stopwatch
from torchrl_mcp.training.threads import threads

SMOKE = ["preset=smoke", "logger=none", "progress_bar=false"]
LATENT = ["method=latent_space", "training.num_epochs=1", "training.minibatch_size=128", "training.total_frames=384"]
BACKENDS = [
    "processes",
    pytest.param("ray", marks=pytest.mark.skipif(not find_spec("ray"), reason="needs pip install 'torchrl-mcp[ray]'")),
]


@pytest.fixture(autouse=True)
def private_ray(monkeypatch):
    """Keep Ray from writing into the home and from calling home, and let it start on a busy machine."""
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "300")


def configure(folder, *overrides):
    return compose_run(*SMOKE, f"run_dir={folder}", *overrides)


def rows(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(row):
    return {key: value for key, value in row.items() if not key.startswith(("seconds", "time/"))}


def restored(folder):
    """The trainer of a run, at its newest checkpoint."""
    cfg = records.run_config(folder)
    source = build.make_source(cfg)
    trainer = build.make_trainer(cfg, build.make_agent(cfg, source.env), source, folder)
    trainer.restore(checkpoint.find(folder))
    return trainer


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of three batches whose loss needs the noise that the workers drew."""
    every_checkpoint = ["checkpoint_interval=1", "keep_checkpoints=3"]
    return experiment.train(
        configure(tmp_path_factory.mktemp("run"), "collector=processes", *every_checkpoint, *LATENT)
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_workers_act_by_the_newest_weights_and_statistics_in_every_batch_and_return_their_noise(run, tmp_path, backend):
    folder = run if backend == "processes" else tmp_path
    if backend == "ray":  # whose start forks, which a large process may not
        arguments = [*SMOKE, f"run_dir={folder}", "collector=ray", *LATENT]
        subprocess.run([sys.executable, "-m", "torchrl_mcp.commands.train", *arguments], check=True)
    assert len(rows(folder)) == 3
    for row in rows(folder):  # one gradient step per batch: its samples are of the policy that it changes
        assert float(row["loss/kl"]) == pytest.approx(0, abs=1e-6)
        assert float(row["loss/max_ratio"]) == pytest.approx(1, abs=1e-5)
        assert float(row["loss/ESS"]) == pytest.approx(1, abs=1e-5)
        assert 0 < float(row["time/collection"]) < 1
        assert float(row["time/steps_per_second"]) > 0
    assert [numbers(row) for row in rows(folder)] == [numbers(row) for row in rows(run)]


def test_a_run_resumed_with_workers_begins_other_episodes_and_ends(run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    for name in ("checkpoint-000000000256.torchrl", "checkpoint-000000000384.torchrl"):
        (folder / "checkpoints" / name).unlink()  # as if it had been killed in the second iteration
    experiment.resume(folder)
    resumed, whole = rows(folder), rows(run)
    assert not restored(folder).episodes.lengths.any()  # of episodes that no one goes on with
    assert numbers(resumed[0]) == numbers(whole[0])
    assert [row["frames"] for row in resumed] == ["128", "256", "384"]
    assert resumed[1]["reward"] != whole[1]["reward"]


def test_workers_that_start_again_have_other_seeds(tmp_path, monkeypatch):
    cfg = configure(tmp_path, "method=scratch")
    source = RemoteSource(partial(build.make_env, cfg), num_envs=4, seed=3, num_workers=2, num_threads=1)
    seeds = []

    def begin(make_collector):
        seeds.extend(maker.keywords["seed"] for maker in make_collector.args[0])

    monkeypatch.setattr(source, "_begin", begin)
    policy = build.make_agent(cfg, source.env).actor.policy
    for _ in range(2):
        source.start(policy, Batches(80, torch.device("cpu"), autocast=False, stopwatch=Stopwatch()))
    assert len(set(seeds)) == 4


@pytest.mark.parametrize(("source", "written"), [(LocalSource, "processes or ray"), (RemoteSource, "local")])
def test_a_source_refuses_the_state_of_another_kind(source, written):
    state = {"starts": 1} if source is LocalSource else {"env": {}}
    with pytest.raises(ValueError, match=f"collector={written}: resume with the same collector"):
        source.load_state_dict(object.__new__(source), state)


def test_every_environment_of_every_worker_is_another_and_a_killed_worker_is_named_within_seconds(tmp_path):
    """Each environment remembers its own options, in bfloat16; of the workers, none is left."""
    cfg = configure(tmp_path, "method=option_critic", "epsilon=1")
    source = RemoteSource(partial(build.make_env, cfg), num_envs=4, seed=3, num_workers=2, num_threads=1)
    product = TensorDictModule(torch.nn.LazyLinear(1), in_keys=["observation"], out_keys=["product"])
    product(source.env.reset())
    policy, watch = TensorDictSequential(build.make_agent(cfg, source.env).actor.policy, product), Stopwatch()
    with threads(3):  # the learner's, which workers do not diminish
        source.start(policy, Batches(80, torch.device("cpu"), autocast=True, stopwatch=watch))
        batch = source.collect()
        during, workers, killed = torch.get_num_threads(), source._workers, time.monotonic()
        workers[1].kill()
        with pytest.raises(ChildProcessError, match=r"worker 1 .* has ended by signal SIGKILL"):
            source.collect()
        source.stop()
        assert (during, torch.get_num_threads()) == (3, 3)
    assert time.monotonic() - killed < 15
    assert len(workers) == 2
    assert not set(workers) & set(multiprocessing.active_children())
    assert batch.shape == (4, 20)
    assert batch["product"].dtype is torch.bfloat16
    for key in ("observation", "action"):
        assert len(batch[key][:, 0].unique(dim=0)) == 4
    assert batch["option"].unique().numel() > 4  # of eight, chosen at random
    assert batch["held_option"][:, 1:].equal(batch["option"][:, :-1])
    assert watch.seconds["collection"] > 0


@pytest.mark.slow
@pytest.mark.skipif(not find_spec("ray") or sys.platform != "linux", reason="needs Ray, and Linux's /proc")
def test_everything_that_ray_started_is_gone_soon_after_the_run_was_killed(tmp_path):
    """Ray's agents wait a minute for its server, which the kernel has ended."""
    arguments = [*SMOKE, f"run_dir={tmp_path}", "collector=ray", "training.total_frames=1000000"]
    run = subprocess.Popen([sys.executable, "-m", "torchrl_mcp.commands.train", *arguments], start_new_session=True)
    while not (tmp_path / "metrics.csv").exists():
        assert run.poll() is None
        time.sleep(0.5)
    assert len(living(run.pid)) > 5  # the run, two workers, and what serves them
    run.kill()
    run.wait()
    deadline = time.monotonic() + 120
    while living(run.pid) and time.monotonic() < deadline:
        time.sleep(0.5)
    assert not living(run.pid)


def test_a_worker_follows_the_process_that_started_it(monkeypatch):
    called = []
    monkeypatch.setattr(collectors, "end_with_parent", lambda: called.append(True))
    before = torch.get_rng_state(), torch.get_num_threads()
    assert collectors._begin_worker(lambda seed: seed, seed=3) == 3
    torch.set_rng_state(before[0])
    torch.set_num_threads(before[1])
    assert called


def test_environments_that_do_not_divide_evenly_are_refused():
    with pytest.raises(ValueError, match="num_envs=5 must be a multiple of num_workers=2"):
        RemoteSource(Holdout, num_envs=5, seed=0, num_workers=2, num_threads=1)


def test_a_missing_ray_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(collectors, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'torchrl-mcp\[ray\]'"):
        RemoteSource(Holdout, num_envs=4, seed=0, num_workers=2, num_threads=1, backend="ray")
