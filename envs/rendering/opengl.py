"""OpenGL contexts for drawing without a display, and the search for a library that works."""

import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Protocol

import mujoco

PLATFORMS = ("egl", "osmesa", "glfw")
"""Values of ``MUJOCO_GL`` on Linux in the order of trial: a GPU's driver, the processor, a display."""

PYOPENGL = "PYOPENGL_PLATFORM"
"""Variable that a desktop session may set for other programs, and that MuJoCo sets where it is not set."""

PROBE = """
import mujoco
context = mujoco.GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


class GLContext(Protocol):
    """The interface of MuJoCo's OpenGL contexts on all platforms."""

    def make_current(self) -> None:
        """Make this the target of drawing."""

    def free(self) -> None:
        """Free the context."""


def new_context(width: int, height: int) -> GLContext:
    """Open an OpenGL context for pictures up to a size in pixels.

    Raises:
        RuntimeError: If no platform works, or the one in the environment variable ``MUJOCO_GL`` does not.
    """
    if (platform := _platform()) is None:
        asked = os.environ.get("MUJOCO_GL")
        raise RuntimeError(
            f"MuJoCo found no OpenGL to draw with{f' for MUJOCO_GL={asked}' if asked else ''}. Without a display it "
            "needs EGL (Debian: apt install libegl1, and a GPU's driver) or OSMesa (Debian: apt install libosmesa6). "
            "Leave the environment variable MUJOCO_GL unset to take the one that works, or set it to insist on one"
        )
    return platform(width, height)


@cache
def _platform() -> Callable[[int, int], GLContext] | None:
    """Return the class of contexts that works: the one in ``MUJOCO_GL`` if set, else the first of ``PLATFORMS``."""
    asked = os.environ.get("MUJOCO_GL", "")
    platform = next(filter(_works, PLATFORMS if sys.platform == "linux" and not asked else (asked,)), None)
    if platform not in PLATFORMS:
        return None if platform is None else mujoco.GLContext
    # MuJoCo chose its own class on import, but looks up OpenGL's functions when it first draws.
    os.environ["MUJOCO_GL"] = platform
    os.environ.pop(PYOPENGL, None)  # MuJoCo refuses another value than its own
    return import_module(f"mujoco.{platform}").GLContext


def _works(platform: str) -> bool:
    """Try a platform in a separate process: a failure may end the process, and PyOpenGL keeps its first platform."""
    environment = {name: value for name, value in os.environ.items() if name != PYOPENGL} | {"MUJOCO_GL": platform}
    return subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True).returncode == 0
