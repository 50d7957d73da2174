"""Recordings of a run in training: what they show, where they land, and that the run is the same without them."""

import importlib.util
import os

import pytest
import torch
from PIL import Image
from smoke import rows
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_mcp.envs.rendering import opengl
from torchrl_mcp.runs import experiment
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.viewer.recorder import draw_weights

RECORDED = ["record_interval=2", "+recorder.seconds=0.3", "+recorder.width=96", "+recorder.height=64"]


def train(folder, *overrides):
    settings = ["preset=smoke", "num_threads=1", "progress_bar=false", f"run_dir={folder}"]
    settings += ["task.pretrain.max_episode_steps=20", *overrides]
    return experiment.train(compose_run(*settings))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return train(tmp_path_factory.mktemp("runs") / "recorded", "logger=tensorboard", *RECORDED)


def test_pictures_land_in_the_run_folder_every_so_many_iterations(recorded):
    names = {path.name for path in (recorded / "recordings").iterdir()}
    pictures = {"curve": ".png", "gates": ".png"} | ({"film": ".gif"} if opengl._platform() else {})
    assert names == {f"{name}-{step:012d}{end}" for name, end in pictures.items() for step in (256, 512)}
    for path in (recorded / "recordings").iterdir():
        with Image.open(path) as picture:
            assert path.suffix == ".png" or (picture.size, picture.n_frames) == ((96, 64), 3)
            assert len(picture.convert("RGB").getcolors(picture.width * picture.height)) > 10


def test_tensorboard_shows_them_at_their_step(recorded):
    events = EventAccumulator(str(recorded / "tensorboard")).Reload()
    tags = {"curve", "gates"} | ({"film"} if opengl._platform() else set())
    assert set(events.Tags()["images"]) == tags
    for tag in tags:
        first, last = events.Images(tag)
        assert (first.step, last.step) == (256, 512)
        path = next((recorded / "recordings").glob(f"{tag}-*512.*"))
        assert last.encoded_image_string == path.read_bytes()


def test_a_run_is_the_same_with_recordings_and_without(recorded, tmp_path):
    assert rows(recorded) == rows(train(tmp_path / "plain", "logger=none"))


def test_weights_are_drawn_a_line_for_each_primitive():
    figure = draw_weights(torch.tensor([[0.0, 1.0], [0.5, 0.25]]), 0.1)
    first, second = (line.get_xydata().tolist() for line in figure.axes[0].lines)
    assert first == [[pytest.approx(0.1), 0.0], [pytest.approx(0.2), 0.5]]
    assert [weight for _, weight in second] == [1.0, 0.25]


@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="wandb is not installed: pip install wandb")
def test_wandb_keeps_metrics_and_pictures_offline(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = train(tmp_path / "run", "logger=wandb", *RECORDED)
    import wandb

    wandb.finish()
    (kept,) = (folder / "wandb").glob("offline-run-*")
    assert next(kept.glob("*.wandb")).stat().st_size > 1000
    pictures = sorted(path.suffix for path in (kept / "files" / "media").rglob("*.*"))
    assert pictures.count(".png") == 4
    assert pictures.count(".gif") == (2 if opengl._platform() else 0)


@pytest.mark.skipif(importlib.util.find_spec("mlflow") is None, reason="mlflow is not installed: pip install mlflow")
def test_mlflow_keeps_metrics_and_pictures_in_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = train(tmp_path / "run", "logger=mlflow", *RECORDED)
    import mlflow

    mlflow.end_run()
    assert next(folder.rglob("metrics/reward")).read_text().count(os.linesep) == 4
    kept = [
        path.name for path in folder.rglob("*") if path.parent.name == "recordings" and path.parent.parent != folder
    ]
    assert len(kept) == (6 if opengl._platform() else 4)
