"""The demonstration as a whole, with the smallest budget: killed, called again, finished."""

import csv
import json
import math
import subprocess
import sys
import time
from contextlib import redirect_stdout
from io import StringIO
from types import SimpleNamespace

import pytest
from matplotlib.image import imread

from torchrl_mcp.cli import demo as command
from torchrl_mcp.cli import demonstration as demo
from torchrl_mcp.runs import policies

FILES = [
    "results.md",
    "results.json",
    "learning_curves.png",
    "learning_curves.svg",
    "learning_curves.csv",
    "trajectories.png",
    "trajectories.svg",
]
SMOKE = ["preset=demo_smoke"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A demonstration that was killed in the middle and called again."""
    folder = tmp_path_factory.mktemp("runs") / "my demo"
    command = [sys.executable, "-m", "torchrl_mcp.cli.demo", "--smoke", "--output", folder]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while not (folder / "transfer" / "config.yaml").exists():
        assert killed.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    half = contents(folder)
    with redirect_stdout(StringIO()) as output:
        demo.run(folder, SMOKE)
    return SimpleNamespace(folder=folder, half=half, output=output.getvalue())


def contents(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def configurations(folder, *overrides):
    return {name: demo.configure(folder / name, [*own, *overrides]) for name, own in demo.RUNS.items()}


def test_it_was_killed_after_pretraining_and_before_the_end(finished):
    names = {path.relative_to(finished.folder).as_posix() for path in finished.half}
    assert "pretrain/checkpoints/checkpoint-000000000512.torchrl" in names
    assert not names & set(FILES)


def test_called_again_it_keeps_what_was_done_and_does_the_rest_once(finished):
    checkpoint = finished.folder / "pretrain" / "checkpoints" / "checkpoint-000000000512.torchrl"
    assert checkpoint.stat().st_mtime_ns == finished.half[checkpoint]
    for name in demo.RUNS:
        with (finished.folder / name / "metrics.csv").open(newline="") as file:
            assert [int(row["iteration"]) for row in csv.DictReader(file)] == [1, 2, 3, 4]


def test_everything_promised_is_in_one_folder(finished):
    for name in FILES:
        assert (finished.folder / name).stat().st_size > 0
    for name in demo.RUNS:
        assert (finished.folder / name / "config.yaml").is_file()


@pytest.mark.parametrize("name", ["learning_curves.png", "trajectories.png"])
def test_pictures_decode_and_are_not_blank(finished, name):
    picture = imread(finished.folder / name)
    assert min(picture.shape[:2]) > 600
    assert picture.std() > 0.03


def test_the_last_words_are_the_table_and_where_to_find_it(finished):
    assert (finished.folder / "results.md").read_text().strip() in finished.output
    assert str(finished.folder) in finished.output
    assert "film" in finished.output.splitlines()[-1]
    for name in FILES:
        stem, suffix = name.split(".")
        assert stem in finished.output
        assert f".{suffix}" in finished.output


@pytest.mark.parametrize("name", ["before", "after", "scratch_early", "scratch"])
def test_the_table_holds_the_numbers_of_an_evaluation_on_the_held_out_directions(finished, name):
    policy = demo.policies(finished.folder, configurations(finished.folder, *SMOKE))[name]
    expected = policies.evaluate_run(policy.path, episodes=8, seed=12345, directions=[1.5 * math.pi, 2 * math.pi])
    found = json.loads((finished.folder / "results.json").read_text())[name]
    assert {mode: found[mode] for mode in expected} == expected
    rows = [line for line in (finished.folder / "results.md").read_text().splitlines() if policy.label in line]
    for numbers in expected.values():
        assert any(f"{numbers['normalised_return']:.3f} [" in row for row in rows)


def test_an_existing_folder_with_other_settings_is_refused(finished):
    with pytest.raises(ValueError, match="holds a run with other settings: give another --output"):
        demo.configure(finished.folder / "pretrain", [*demo.RUNS["pretrain"], *SMOKE, "seed=1"])


def test_the_full_budget_keeps_a_checkpoint_of_scratch_after_as_many_steps_as_transfer(tmp_path):
    runs = configurations(tmp_path, "preset=demo")
    demo.require_early_checkpoint(runs)
    policies, cfg = demo.policies(tmp_path, runs), runs["scratch"]
    later = policies["scratch"].steps - policies["scratch_early"].steps
    assert later / (cfg.checkpoint_interval * cfg.training.frames_per_batch) < cfg.keep_checkpoints


def test_a_budget_that_leaves_scratch_without_that_checkpoint_is_refused_before_training(tmp_path):
    runs = configurations(tmp_path, *SMOKE, "training.total_frames=1024", "checkpoint_interval=3")
    runs["transfer"].training.total_frames = 512
    with pytest.raises(ValueError, match=r"ends after 512 steps, .* only one every 384"):
        demo.require_early_checkpoint(runs)


def test_the_full_budget_gives_scratch_as_many_steps_as_pretraining_and_transfer_together(tmp_path):
    policies = demo.policies(tmp_path, configurations(tmp_path, "preset=demo"))
    assert policies["scratch"].steps == policies["after"].steps + policies["after"].pretraining_steps
    assert policies["scratch_early"].steps == policies["after"].steps


@pytest.mark.parametrize("override", ["nonsense=1", "seed", "preset=unknown"])
def test_a_wrong_setting_is_named_without_a_traceback(tmp_path, monkeypatch, override):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-demo", "--output", str(tmp_path / "demo"), override])
    with pytest.raises(SystemExit, match=override.partition("=")[0]):
        command.main()
    assert not (tmp_path / "demo").exists()


def test_it_says_in_the_beginning_how_long_it_takes(finished):
    first, *_ = finished.output.splitlines()
    assert first == f"This takes about 1 minutes on two cores. Everything lands in {finished.folder}."


def test_the_ant_is_filmed_once(finished, monkeypatch):
    pictures = []
    monkeypatch.setattr(demo, "save_film", lambda policy, env, path, seconds: pictures.append(path.touch()))
    (finished.folder / demo.FILM).unlink(missing_ok=True)
    lines = [demo.film(finished.folder, 1.0) for _ in range(2)]
    assert len(pictures) == 1
    assert lines[0] == lines[1]
    assert "film.gif" in lines[0]


def test_where_nothing_can_be_drawn_the_demonstration_says_so_and_ends_well(finished, monkeypatch):
    def refuse(*arguments, **settings):
        raise RuntimeError("no OpenGL")

    monkeypatch.setattr(demo, "save_film", refuse)
    (finished.folder / demo.FILM).unlink(missing_ok=True)
    assert demo.film(finished.folder, 1.0) == "  no film: no OpenGL"
