"""The demonstration as a whole, with the smallest budget: interrupted, called again, finished."""

import csv
import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from torchrl_mcp.commands import demo
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.processes import start
from torchrl_mcp.training.trainer import Trainer
from torchrl_mcp.viewer import film

FILES = ["report.html", "report.md"]
SMOKE = {"preset": "demo_smoke"}
HALF = 256
"""Environment steps of half of the smallest budget."""


class Interruption(Exception):
    """The demonstration is cut off."""


def interrupt(folder):
    """Leave the gate half trained."""
    save = Trainer.save

    def save_and_stop(trainer):
        save(trainer)
        if trainer.progress.frames == HALF:
            raise Interruption

    gate = demo.configure(folder, [], pretrain=False, **SMOKE)["mcp"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "save", save_and_stop)
        with pytest.raises(Interruption):
            demo.learn([gate])


def kill(folder):
    """The same by a signal to the command."""
    command = [sys.executable, "-m", "torchrl_mcp.commands.demo", "--smoke", "--output", folder]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while not list(folder.glob(f"mcp/checkpoints/checkpoint-*{HALF}.torchrl")):
        assert killed.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    killed.kill()
    killed.wait()


def go_on(folder, stop):
    """Run the demonstration after it was stopped in the middle."""
    stop(folder)
    half = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    with redirect_stdout(StringIO()) as output:
        demo.run(folder, [], **SMOKE)
    return SimpleNamespace(folder=folder, half=half, output=output.getvalue())


def work_here(task, argument):
    """Do here what goes on from a checkpoint, and the page, in place of processes, whose imports take seconds."""
    if task is demo.learn and not Path(argument[0].run_dir).exists():
        return start(task, argument)
    task(argument)
    return SimpleNamespace(is_alive=lambda: False, join=lambda timeout=None: None, exitcode=0)


def require_continued(demonstration):
    assert f"mcp/checkpoints/checkpoint-000000000{HALF}.torchrl" in demonstration.half
    assert not demonstration.half & {*FILES, "mcp/evaluation.json"}
    for name in ("mcp", "scratch"):
        with (demonstration.folder / name / "metrics.csv").open(newline="") as file:
            assert [int(row["iteration"]) for row in csv.DictReader(file)] == [1, 2, 3, 4]


def next_commands(demonstration):
    return demo.commands(demonstration.folder, demo.configure(demonstration.folder, [], pretrain=False, **SMOKE))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A demonstration that was interrupted in the middle and called again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "start", work_here)
        return go_on(tmp_path_factory.mktemp("runs") / "my demo", interrupt)


def test_called_again_it_goes_on_where_it_was_interrupted(finished):
    require_continued(finished)


@pytest.mark.slow
def test_called_again_it_goes_on_where_it_was_killed(tmp_path):
    require_continued(go_on(tmp_path / "my demo", kill))


def test_everything_promised_is_in_one_folder(finished):
    for name in FILES:
        assert (finished.folder / name).stat().st_size > 0
        assert name in finished.output


def test_the_report_compares_both_with_learning_curves(finished):
    rows = re.findall(r"^\| (\w+) \| ", (finished.folder / "report.md").read_text(), re.MULTILINE)
    assert {"MCP", "Scratch"} <= set(rows)
    page = (finished.folder / "report.html").read_text()
    assert re.search(r"Heading.*Humanoid", page)
    assert page.count("<svg") > 1


@pytest.mark.parametrize("name", ["mcp", "scratch"])
def test_the_table_holds_the_numbers_of_an_evaluation(finished, name):
    again = policies.evaluation(finished.folder / name, episodes=4, seed=12345)
    title = demo.TITLES[name]
    (row,) = (line for line in finished.output.splitlines() if line.startswith(f"{title} "))
    numbers = again["deterministic"]
    low, high = numbers["interval"]
    assert f"{numbers['normalised_return']:.3f} [{low:.3f}, {high:.3f}]" in row
    assert f"{again['stochastic']['normalised_return']:.3f}" in row
    assert row.split()[1:3] == ["512", f"{demo.BUILTIN_STEPS:,}" if name == "mcp" else "0"]


def test_both_are_filmed_side_by_side_under_the_same_arrow(finished):
    path = finished.folder / demo.FILM
    if not path.exists():
        assert "no film" in finished.output
        pytest.skip("no OpenGL")
    with Image.open(path) as film:
        first = np.asarray(film.convert("RGB"), dtype=int)
    assert first.shape == (240, 640, 3)
    red = [np.argwhere((half[..., 0] > 150) & (half[..., 1] < 90)) for half in (first[:, :320], first[:, 320:])]
    assert all(len(pixels) > 20 for pixels in red)
    assert np.abs(red[0].mean(0) - red[1].mean(0)).max() < 12


def test_its_next_commands_are_commands_of_this_library(finished):
    for words in map(shlex.split, next_commands(finished).values()):
        assert shlex.join(words) in finished.output
        assert words[0] in (Path(sys.executable).parent / words[0]).name
        assert (Path(sys.executable).parent / words[0]).exists()


def test_with_pre_training_its_steps_count_for_mcp_and_scratch_has_as_many(finished, tmp_path):
    runs = demo.configure(tmp_path, [], pretrain=True, **SMOKE)
    for name in ("mcp", "scratch"):
        (tmp_path / name).mkdir()
        shutil.copy(finished.folder / name / "evaluation.json", tmp_path / name)
    rows = {line.split()[0]: line.split()[1:3] for line in demo.table(runs).splitlines() if line}
    assert rows["MCP"] == ["512", "512"]
    assert rows["scratch"] == ["1,024", "0"]
    assert list(demo.commands(tmp_path, runs)) == ["steer it in the browser"]


def test_it_ends_with_a_web_page_of_the_gate(finished):
    page = finished.folder / demo.PAGE / "page.json"
    if not page.exists():
        pytest.skip("no npm, or no connection")
    (gate,) = json.loads(page.read_text())["gates"]
    assert gate["task"] == "Heading"
    assert shlex.join(["--directory", str(page.parent)]) in finished.output


def test_without_npm_the_demonstration_gives_the_reason_and_writes_no_page(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "PAGE", "another page")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    demo.export_page(finished.folder)
    assert "npm" in capsys.readouterr().out
    assert not (finished.folder / "another page").exists()


def test_an_existing_folder_with_other_settings_is_refused(finished):
    with pytest.raises(ValueError, match=r"holds a run that differs in .*seed.*: give another --output"):
        demo.configure(finished.folder, ["seed=1"], pretrain=False, **SMOKE)


@pytest.mark.parametrize("pretrain", [False, True])
def test_the_full_budgets_are_the_ones_that_it_tells(tmp_path, pretrain):
    runs = demo.configure(tmp_path, [], preset="demo", pretrain=pretrain)
    steps = {name: cfg.training.total_frames for name, cfg in runs.items()}
    assert steps["scratch"] == steps["mcp"] + steps.get("pretrain", 0)
    assert runs["mcp"].pretrained == (str(tmp_path / "pretrain") if pretrain else "builtin")
    told = [int(number.replace(",", "")) for number in re.findall(r"[\d,]{5,}\d", demo.introduction(runs, tmp_path))]
    assert {told[0], told[-1]} == {steps.get("pretrain", steps["mcp"]), steps["mcp"]}


def test_the_primitives_had_as_many_steps_of_imitation_as_it_says():
    card = builtin("mcp", "humanoid").with_suffix(".md").read_text()
    assert f"{demo.BUILTIN_STEPS:,} steps" in card


@pytest.mark.parametrize("override", ["nonsense=1", "seed", "evaluation.episodes=0"])
def test_a_wrong_setting_is_named_without_a_traceback(tmp_path, override):
    words = ["--output", str(tmp_path / "demo"), override]
    with pytest.raises(SystemExit, match=override.partition("=")[0]):
        demo.main(words)
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize("override", ["character=biped", "+pretrained=mine", "method=moe", "preset=fast"])
def test_what_the_demonstration_sets_itself_cannot_be_set(tmp_path, override):
    words = ["--output", str(tmp_path / "demo"), override]
    with pytest.raises(SystemExit, match=re.escape(f"use torchrl-mcp-train to set {override}")):
        demo.main(words)
    assert not (tmp_path / "demo").exists()


def test_where_nothing_can_be_drawn_the_demonstration_says_so_and_ends_well(finished, monkeypatch, capsys):
    def refuse(*arguments, **settings):
        raise RuntimeError("no OpenGL")

    monkeypatch.setattr(film, "save_films", refuse)
    (finished.folder / demo.FILM).unlink(missing_ok=True)
    runs = demo.configure(finished.folder, [], pretrain=False, **SMOKE)
    assert not demo.film(finished.folder, runs)
    assert capsys.readouterr().out == "no film: no OpenGL\n"
