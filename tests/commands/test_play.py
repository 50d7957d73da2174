import sys

import pytest
from PIL import Image

from torchrl_mcp.commands import play
from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.rendering import opengl


def call(*words):
    play.main([*map(str, words)])


BIPED = "builtin:biped"
REFUSED = [
    ([BIPED, "--seconds", "inf"], "'inf'"),
    ([BIPED, "--seconds", "nan"], "'nan'"),
    ([BIPED, "--seconds", "-1"], "'-1'"),
    ([BIPED, "--seconds", "0"], "'0'"),
    (["empty"], "empty"),
    (["notes.txt"], "notes.txt"),
    ([BIPED, "--task", "colour=red"], "colour"),
    ([BIPED, "--task", "clips=DIR"], "motions.path=FOLDER"),
    ([BIPED, "--task", "clip_end=sleep"], "clip_end=sleep"),
    ([BIPED, "--task", "seed=3"], "--task seed"),  # which the command gives itself
    ([BIPED, "--task", "num_envs=3"], "--task num_envs"),
    ([BIPED, "--task", "device=3"], "--task device"),
    ([], "CHECKPOINT"),
    (["--agent", "zero", "task=nope"], "task=nope"),
    (["--agent", "zero", "tsk=heading"], "task"),
    (["--agent", "zero", "--config-dir", "nowhere", "task=heading"], "--config-dir"),
    (["--watch", BIPED, "--viewer", "web"], "--watch"),
    (["--watch", "."], "--watch"),
    (["--watch", "--agent", "zero", "--viewer", "web"], "--watch"),
    ([BIPED, "--viewer", "web"], "MuJoCo"),  # which has no studio here
]
ON_LINUX = [  # where there need be neither OpenGL nor a display
    ([BIPED, "--output", "film.gif"], "libegl1"),
    ([BIPED, "--viewer", "window"], "--viewer web"),
]


@pytest.mark.parametrize(("words", "name"), REFUSED + ON_LINUX * (sys.platform == "linux"), ids=str)
def test_what_cannot_be_played_is_refused_without_a_traceback(monkeypatch, tmp_path, capsys, words, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no checkpoint")
    monkeypatch.setitem(sys.modules, "torchrl_mcp.viewer.web", None)
    monkeypatch.setattr(opengl, "_works", lambda name: False)
    opengl._platform.cache_clear()
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    with pytest.raises(SystemExit) as stopped:
        call(*words)
    opengl._platform.cache_clear()
    said = f"{stopped.value}{capsys.readouterr().err}"
    assert name in said.replace("usage: torchrl-mcp-play", "")
    assert "Traceback" not in said
    assert {path.name for path in tmp_path.iterdir()} == {"empty", "notes.txt"}


def test_networks_that_come_with_the_library_play_in_a_film_of_the_size_asked_for(tmp_path, capsys):
    path = tmp_path / "films" / "film.gif"
    try:
        call("builtin:biped", "--output", path, "--seconds", 0.2, "--width", 160, "--height", 120)
    except SystemExit as error:
        if "no OpenGL" not in str(error):
            raise
        pytest.skip(str(error))
    assert capsys.readouterr().out.strip() == str(path)
    with Image.open(path) as gif:
        assert gif.size == (160, 120)
        assert gif.n_frames == 3


def test_without_what_writes_mp4_a_film_is_refused_before_anything_is_simulated(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(play, "trained", lambda *arguments: pytest.fail("the policy is restored"))
    with pytest.raises(SystemExit, match=r"torchrl-mcp\[video\]"):
        call("builtin:biped", "--output", tmp_path / "films" / "film.mp4")
    assert not (tmp_path / "films").exists()


@pytest.mark.parametrize(("agent", "moves"), [("zero", False), ("random", True)])
def test_an_agent_that_has_learnt_nothing_shows_an_environment(monkeypatch, agent, moves):
    shown = []
    monkeypatch.setattr(play, "show", lambda player, arguments: shown.append(player))
    call("--agent", agent, "task=heading", "character=trex", "--seed", 3)
    [player] = shown
    assert isinstance(player.env, Heading)
    for _ in range(3):
        player.step()
        assert player.action.shape[-1] == 49
        assert bool(player.action.any()) == moves
        assert (player.action.abs() <= 1).all()
