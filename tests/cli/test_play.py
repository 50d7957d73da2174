import sys

import pytest
from PIL import Image

from torchrl_mcp.cli import play
from torchrl_mcp.commands import play as playing
from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.rendering import opengl


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-play", *map(str, arguments)])
    play.main()


def refused(monkeypatch, *arguments):
    """What the program says instead of doing something."""
    with pytest.raises(SystemExit) as stopped:
        call(monkeypatch, *arguments)
    return str(stopped.value)


def test_networks_that_come_with_the_library_play_in_a_film_of_the_size_asked_for(monkeypatch, tmp_path, capsys):
    path = tmp_path / "films" / "film.gif"
    try:
        call(monkeypatch, "builtin:biped", "--output", path, "--seconds", 0.2, "--width", 160, "--height", 120)
    except SystemExit as error:
        if "no OpenGL" not in str(error):
            raise
        pytest.skip(str(error))
    assert capsys.readouterr().out.strip() == str(path)
    with Image.open(path) as gif:
        assert gif.size == (160, 120)
        assert gif.n_frames == 3


@pytest.mark.parametrize("seconds", ["inf", "nan", "-1", "0"])
def test_a_film_has_an_end(monkeypatch, capsys, seconds):
    with pytest.raises(SystemExit):
        call(monkeypatch, "builtin:biped", "--seconds", seconds)
    assert f"{seconds!r} is no duration: pass more than 0 seconds" in capsys.readouterr().err


@pytest.mark.skipif(opengl._platform() is None, reason="no OpenGL to draw with")
def test_a_film_that_is_too_large_to_draw_is_refused(monkeypatch, tmp_path):
    said = refused(monkeypatch, "builtin:biped", "--output", tmp_path / "film.gif", "--width", 100_000)
    assert "OpenGL cannot draw width=100000, height=360: pass less" in said


def test_unknown_networks_are_refused_by_those_that_there_are(monkeypatch):
    said = refused(monkeypatch, "builtin:horse")
    assert "no builtin:horse comes with the library" in said
    assert all(f"builtin:{name}" in said for name in ("biped", "humanoid", "trex"))


def test_a_folder_without_checkpoint_is_refused(monkeypatch, tmp_path):
    assert "neither a checkpoint file nor a run folder" in refused(monkeypatch, tmp_path)


def test_a_file_that_is_no_checkpoint_is_refused(monkeypatch, tmp_path):
    (tmp_path / "notes.txt").write_text("no checkpoint")
    assert "notes.txt is damaged, or is not a checkpoint" in refused(monkeypatch, tmp_path / "notes.txt")


def test_an_unknown_argument_of_the_task_is_refused_by_name(monkeypatch):
    said = refused(monkeypatch, "builtin:biped", "--task", "colour=red")
    assert "the task has no argument colour: it takes clip_end, clips, " in said


def test_a_folder_of_clips_is_refused_with_the_setting_that_takes_one(monkeypatch):
    assert "motions.path=FOLDER" in refused(monkeypatch, "builtin:biped", "--task", "clips=DIR")


def test_a_wrong_argument_of_the_task_is_refused(monkeypatch):
    assert "--task clip_end=sleep must be " in refused(monkeypatch, "builtin:biped", "--task", "clip_end=sleep")


@pytest.mark.parametrize("name", ["seed", "num_envs", "device"])
def test_an_argument_that_the_command_gives_itself_is_refused(monkeypatch, name):
    assert f"--task {name} would not be read" in refused(monkeypatch, "builtin:biped", "--task", f"{name}=3")


def test_without_opengl_the_packages_to_install_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr(opengl, "_works", lambda name: False)
    opengl._platform.cache_clear()
    said = refused(monkeypatch, "builtin:biped", "--output", tmp_path / "film.gif")
    opengl._platform.cache_clear()
    assert "libegl1" in said
    assert "libosmesa6" in said


def test_without_what_writes_mp4_a_film_is_refused_before_anything_is_simulated(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(playing, "play", lambda arguments: pytest.fail("the policy is restored"))
    said = refused(monkeypatch, "builtin:biped", "--output", tmp_path / "films" / "film.mp4")
    assert "pip install 'torchrl-mcp[video]'" in said
    assert not (tmp_path / "films").exists()


def test_without_studio_the_web_viewer_says_which_mujoco_has_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchrl_mcp.viewer.web", None)
    assert "install that" in refused(monkeypatch, "builtin:biped", "--viewer", "web")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_a_display_a_window_is_refused_with_what_to_do_instead(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "--viewer web" in refused(monkeypatch, "builtin:biped", "--viewer", "window")


@pytest.mark.parametrize(("agent", "moves"), [("zero", False), ("random", True)])
def test_an_agent_that_has_learnt_nothing_shows_an_environment(monkeypatch, agent, moves):
    shown = []
    monkeypatch.setattr(playing, "show", lambda policy, env, options, arguments: shown.append((policy, env)))
    call(monkeypatch, "--agent", agent, "task=heading", "character=trex", "--seed", 3)
    [(policy, env)] = shown
    assert isinstance(env, Heading)
    actions = env.rollout(3, policy)["action"]
    assert actions.shape[-1] == 49
    assert bool(actions.any()) == moves
    assert (actions.abs() <= 1).all()


def test_without_an_agent_one_checkpoint_is_asked_for(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        call(monkeypatch)
    assert "give one CHECKPOINT, not 0; or --agent" in capsys.readouterr().err


def test_an_unknown_setting_of_an_agents_environment_is_refused_without_a_traceback(monkeypatch):
    assert refused(monkeypatch, "--agent", "zero", "task=nope").startswith("torchrl-mcp-play: there is no task=nope: ")
    assert "the nearest are: task" in refused(monkeypatch, "--agent", "zero", "tsk=heading")


@pytest.mark.parametrize("words", [["builtin:biped", "--viewer", "web"], ["."], ["--agent", "zero", "--viewer", "web"]])
def test_watching_needs_a_run_folder_and_a_viewer(monkeypatch, capsys, words):
    with pytest.raises(SystemExit):
        call(monkeypatch, "--watch", *words)
    assert "--watch takes a run folder, and --viewer web or --viewer window" in capsys.readouterr().err


def test_a_folder_of_settings_that_is_not_there_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(
        "sys.argv", ["play", "--agent", "zero", "--config-dir", str(tmp_path / "nowhere"), "task=heading"]
    )
    with pytest.raises(SystemExit, match=r"there is no folder .*nowhere: correct --config-dir"):
        play.main()
