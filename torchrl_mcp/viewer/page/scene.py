"""Prepares scenes for the browser's MuJoCo, which is older than Python's MuJoCo, and checks them."""

import json
import subprocess
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

TOLERANCE = 1e-5
"""Largest absolute or relative difference between numbers of two models, because MJCF has six digits."""


def for_browser(scene: str) -> str:
    """Return the MJCF of a scene without ``input="pos"``, the default that MuJoCo 3.17 writes and 3.14 refuses."""
    root = ElementTree.fromstring(scene)
    for actuator in root.iter("general"):
        if actuator.get("input") == "pos":
            del actuator.attrib["input"]
    return ElementTree.tostring(root, encoding="unicode")


def require_same_model(scene: str, model: mujoco.MjModel, runtimes: Path) -> str:
    """Check that the browser's MuJoCo compiles a scene to the same model as Python's, and return its version.

    Args:
        scene: MJCF for the browser.
        model: The model that Python's MuJoCo compiles from the scene.
        runtimes: The folder of the page's runtimes.

    Raises:
        ValueError: If the scene does not compile or the models differ; the message names the reason or the fields.
    """
    report = _report(scene, runtimes)
    browser = f"the browser's MuJoCo {report['version']}"
    if "error" in report:
        raise ValueError(f"{browser} cannot compile the scene: {' '.join(report['error'].split())}")
    if different := [name for name, values in report["fields"].items() if not _same(values, getattr(model, name))]:
        raise ValueError(
            f"{browser} and Python's MuJoCo {mujoco.__version__} compile the scene to different models: "
            f"{', '.join(different)} differ"
        )
    return str(report["version"])


def _report(scene: str, runtimes: Path) -> dict[str, Any]:
    with as_file(files(__package__) / "check.mjs") as program:
        done = subprocess.run(["node", str(program), str(runtimes)], input=scene, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"node cannot check the scene: {done.stderr.strip().splitlines()[-1]}")
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def _same(values: list[float], expected: np.ndarray) -> bool:
    return len(values) == expected.size and np.allclose(values, expected.ravel(), rtol=TOLERANCE, atol=TOLERANCE)
