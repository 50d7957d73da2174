"""What happens to a run when something goes wrong: another process, a full disk, a damaged file."""

import json
import os
import shutil
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
import smoke
import torch
from omegaconf import OmegaConf
from refusals import contents, refused
from smoke import final_parts, rows
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_mcp.envs import characters
from torchrl_mcp.envs.motions.trex import trex_corpus
from torchrl_mcp.runs import build, experiment, lock, policies
from torchrl_mcp.runs.status import status
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.trainer import Trainer

EVERY = ["training.total_frames=640", "checkpoint_interval=1", "keep_checkpoints=9"]
SHORT = "training.total_frames=128"
"""A single iteration."""


def configure(folder, *overrides):
    return smoke.configure(folder, *EVERY, *overrides)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of five iterations with all its checkpoints."""
    return experiment.train(configure(tmp_path_factory.mktemp("runs") / "whole"))


@pytest.fixture
def killed(whole, tmp_path):
    """The run as it was when it was killed after four iterations."""
    folder = tmp_path / "killed"
    shutil.copytree(whole, folder)
    checkpoint.find(folder).unlink()
    return folder


def damage(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


def test_a_run_that_is_at_work_is_shown_as_running_and_nobody_joins_in(killed, tmp_path):
    before = contents(killed)
    with lock.hold(killed):
        assert status(killed).state == "running"
        for join_in in (lambda: experiment.resume(killed), lambda: experiment.train(configure(killed))):
            refused(join_in, f"process {os.getpid()}")
    assert status(killed).state != "running"
    assert contents(killed) == before


def test_a_run_does_not_go_on_with_another_body(tmp_path, monkeypatch):
    body = tmp_path / "biped.xml"
    shutil.copy(Path(characters.__file__).parent / "biped.xml", body)
    monkeypatch.setitem(characters.CHARACTERS, "biped", replace(characters.BIPED, file=body))
    settings = ["task=heading", "character=biped", "method=scratch", "stage=transfer", SHORT]
    run = experiment.train(configure(tmp_path / "run", *settings))
    body.write_text(body.read_text() + "<!-- stronger -->")
    refused(lambda: experiment.resume(run, total_frames=256), "character=biped", untouched=run)
    refused(lambda: experiment.train(configure(run, *settings)), "character", untouched=run)


@pytest.mark.parametrize("afterwards", [partial(experiment.resume, total_frames=256), shutil.rmtree])
def test_a_run_killed_before_its_first_step_keeps_the_networks_with_which_it_began(tmp_path, monkeypatch, afterwards):
    pretraining = experiment.train(configure(tmp_path / "pretraining", "task=holdout", "method=mcp", SHORT))
    settings = ["task=holdout", "method=mcp", "stage=transfer", f"pretrained={pretraining}", SHORT]
    whole = experiment.train(configure(tmp_path / "whole", *settings))
    with monkeypatch.context() as kill:
        kill.setattr(Trainer, "run", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            experiment.train(configure(tmp_path / "killed", *settings))
    afterwards(pretraining)
    killed = experiment.resume(tmp_path / "killed")
    assert rows(killed) == rows(whole)
    torch.testing.assert_close(final_parts(killed), final_parts(whole), rtol=0, atol=0)


def test_a_run_does_not_go_on_with_other_motions(tmp_path):
    first, second = trex_corpus()[:2]
    (tmp_path / "clips").mkdir()
    first.save(tmp_path / "clips/walk.npz")
    settings = ["task=imitation", "character=trex", "method=scratch", "stage=pretrain", "motions=folder"]
    run = experiment.train(configure(tmp_path / "run", *settings, f"motions.path={tmp_path / 'clips'}", SHORT))
    second.save(tmp_path / "clips/run.npz")
    refused(lambda: experiment.resume(run, total_frames=256), "motions.path", untouched=run)
    (tmp_path / "clips/run.npz").unlink()
    assert run_folder.frames(checkpoint.find(experiment.resume(run, total_frames=256))) == 256


def test_a_resume_that_fails_leaves_the_run_as_it_was(whole):
    refused(lambda: experiment.resume(whole, total_frames=99_999, device="mars"), "device=mars", untouched=whole)
    for steps in (0, -1, 256.0, "abc"):
        resume = partial(experiment.resume, whole, total_frames=steps)
        refused(resume, f"training.total_frames={steps}", untouched=whole)
    assert status(whole).state == "done"


def test_a_run_that_was_stopped_can_end_where_it_is(killed, whole):
    experiment.resume(killed, total_frames=512)
    assert rows(killed) == rows(whole)[:4]
    shown = status(killed)
    assert (shown.state, shown.frames, shown.total) == ("done", 512, 512)
    (entry,) = json.loads((killed / "origin.json").read_text())["extended"]
    assert (entry["planned"], entry["total_frames"], entry["after"]) == (640, 512, 512)


def test_a_resume_to_the_length_that_was_planned_ends_a_run_of_whole_batches(tmp_path):
    folder = experiment.train(configure(tmp_path / "run", "training.total_frames=100", "evaluation.episodes=1"))
    (folder / "evaluation.json").unlink()  # as after a kill during the evaluation
    experiment.resume(folder, total_frames=100)
    assert status(folder).state == "done"
    refused(lambda: experiment.resume(folder, total_frames=90), "training.total_frames=90", untouched=folder)


def test_a_run_holds_its_folder_from_before_the_first_file_to_after_the_last(tmp_path, monkeypatch):
    def seen(function):
        def wrapper(*arguments, **settings):
            states.append(status(tmp_path / "run", 128).state)
            return function(*arguments, **settings)

        return wrapper

    states = []
    monkeypatch.setattr(build, "make_run", seen(build.make_run))
    monkeypatch.setattr(experiment, "evaluation", seen(lambda *arguments, **settings: {"deterministic": {}}))
    experiment.train(configure(tmp_path / "run", SHORT, "evaluation.episodes=1"))
    assert states == ["running", "running"]
    assert lock.holder(tmp_path / "run") is None


def test_a_damaged_newest_checkpoint_is_set_aside_and_the_run_goes_on_from_the_one_before(whole, killed, capsys):
    newest = checkpoint.find(killed)
    damage(newest)
    experiment.resume(killed)
    said = capsys.readouterr().out
    assert f"{newest} is damaged: the run continues from checkpoint-000000000384.torchrl" in said
    assert newest.with_name(f"{newest.name}.damaged").exists()
    assert rows(killed) == rows(whole)
    expected, parts = (policies.restore(run, num_envs=1, seed=0)[1].parts.state_dict() for run in (whole, killed))
    for name, value in expected.items():
        assert torch.equal(parts[name], value), name


def test_tensorboard_shows_every_step_once_after_a_resume(tmp_path):
    folder = experiment.train(configure(tmp_path / "run", "training.total_frames=256", "logger=tensorboard"))
    run_folder.find_all(folder)[0].unlink()
    experiment.resume(folder)
    shown = EventAccumulator(str(folder / "tensorboard")).Reload().Scalars("reward")
    assert [(event.step, event.value) for event in shown] == [
        (int(row["frames"]), pytest.approx(float(row["reward"]))) for row in rows(folder)
    ]


def another_seed(run):
    cfg = OmegaConf.load(run / "config.yaml")
    cfg.seed = 7
    OmegaConf.save(cfg, run / "config.yaml")


def half_a_configuration(run):
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(config[: config.index("training:")])


@pytest.mark.parametrize(
    ("spoil", "names"),
    [
        (another_seed, ["config.yaml", "seed"]),
        (half_a_configuration, ["config.yaml", "training"]),
        (lambda run: (run / "metrics.csv").unlink(), ["metrics.csv"]),
    ],
    ids=["another seed", "half a configuration", "no metrics"],
)
def test_a_run_whose_files_do_not_fit_is_not_resumed(killed, spoil, names):
    spoil(killed)
    refused(lambda: experiment.resume(killed), *names, untouched=killed)


def test_an_evaluation_that_is_cut_is_made_anew(tmp_path):
    folder = experiment.train(configure(tmp_path / "run", SHORT, "evaluation.episodes=1"))
    whole = (folder / "evaluation.json").read_bytes()
    (folder / "evaluation.json").write_bytes(whole[:200])
    experiment.resume(folder)
    assert (folder / "evaluation.json").read_bytes() == whole


def test_a_run_without_checkpoints_is_not_begun_anew(killed):
    shutil.rmtree(killed / "checkpoints")
    refused(lambda: experiment.train(configure(killed)), str(killed), "checkpoints", untouched=killed)


def test_a_disk_that_fills_up_while_the_configuration_is_written_leaves_no_run(tmp_path, monkeypatch):
    def fill_up(cfg, path):
        path.write_text("seed: 0\ntrain")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(OmegaConf, "save", fill_up)
        with pytest.raises(OSError, match="No space left"):
            experiment.train(configure(tmp_path / "run", SHORT))
    assert not (tmp_path / "run" / "config.yaml").exists()
    experiment.train(configure(tmp_path / "run", SHORT))
    assert len(rows(tmp_path / "run")) == 1


def test_what_a_killed_save_left_is_gone_after_a_resume(killed):
    left = killed / "checkpoints" / ".checkpoint-000000000640.torchrl.partial.stage-1f" / "components"
    left.mkdir(parents=True)
    experiment.resume(killed)
    assert not left.parent.exists()


def test_code_that_a_run_folder_or_a_checkpoint_names_is_not_run(killed, tmp_path):
    evil = {"_target_": "torch.utils.collect_env.run", "command": f"touch {tmp_path / 'executed'}"}
    cfg = OmegaConf.load(killed / "config.yaml")
    cfg.parts = evil
    OmegaConf.save(cfg, killed / "config.yaml")
    newest = checkpoint.find(killed)
    with zipfile.ZipFile(newest) as source:
        members = {name: source.read(name) for name in source.namelist()}
    manifest = json.loads(members["manifest.json"])
    manifest["metadata"]["config"]["parts"] = evil
    with zipfile.ZipFile(newest, "w") as target:
        for name, content in (members | {"manifest.json": json.dumps(manifest)}).items():
            target.writestr(name, content)
    for use in (
        lambda: experiment.resume(killed),
        lambda: policies.restore(killed, num_envs=1, seed=0),
        lambda: policies.evaluation(newest, episodes=1, seed=0),
    ):
        refused(use, "torch.utils.collect_env.run", "--trust")
    assert not (tmp_path / "executed").exists()
