import os
import sys
from types import SimpleNamespace

import mujoco
import pytest

from torchrl_mcp.envs.rendering import opengl

linux = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere MuJoCo has one OpenGL to choose from")


@pytest.fixture
def tried(monkeypatch):
    """Platforms that have been tried, of which none works but what is added to ``tried.working``."""
    tried = SimpleNamespace(names=[], working=set())
    monkeypatch.setattr(opengl, "_works", lambda name: tried.names.append(name) or name in tried.working)
    monkeypatch.setattr(opengl, "import_module", lambda name: SimpleNamespace(GLContext=lambda width, height: name))
    monkeypatch.setenv("MUJOCO_GL", "")
    opengl._platform.cache_clear()
    yield tried
    opengl._platform.cache_clear()


@linux
def test_the_first_platform_that_works_is_taken_and_the_others_are_not_tried(tried):
    tried.working |= {"osmesa", "glfw"}
    assert opengl.new_context(8, 8) == "mujoco.osmesa"
    assert opengl.new_context(8, 8) == "mujoco.osmesa"
    assert tried.names == ["egl", "osmesa"]
    assert os.environ["MUJOCO_GL"] == "osmesa"  # from where MuJoCo loads OpenGL's functions


@linux
def test_a_platform_that_the_desktop_chose_for_other_programs_hinders_no_probe(monkeypatch):
    environments = []

    def probe(command, *, env, capture_output):
        environments.append(env)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(opengl.subprocess, "run", probe)
    monkeypatch.setattr(opengl, "import_module", lambda name: SimpleNamespace(GLContext=lambda width, height: name))
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "x11")
    opengl._platform.cache_clear()
    assert opengl.new_context(8, 8) == "mujoco.egl"
    opengl._platform.cache_clear()
    assert environments[0]["MUJOCO_GL"] == "egl"
    assert "PYOPENGL_PLATFORM" not in {**environments[0], **os.environ}


def test_what_the_environment_asks_for_is_the_only_one_tried(tried, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    tried.working.add("osmesa")
    assert opengl.new_context(8, 8) == "mujoco.osmesa"
    assert tried.names == ["osmesa"]


@linux
def test_without_any_the_error_names_the_packages_to_install(tried):
    with pytest.raises(RuntimeError, match=r"libegl1.*libosmesa6"):
        opengl.new_context(8, 8)
    assert os.environ["MUJOCO_GL"] == ""


def test_a_value_that_names_no_platform_is_left_to_mujoco(tried, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "on")
    monkeypatch.setattr(mujoco, "GLContext", lambda width, height: (width, height), raising=False)
    tried.working.add("on")
    assert opengl.new_context(8, 6) == (8, 6)


def test_without_the_one_asked_for_the_error_names_it(tried, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(RuntimeError, match="no OpenGL to draw with for MUJOCO_GL=egl"):
        opengl.new_context(8, 8)
