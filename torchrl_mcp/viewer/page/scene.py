"""Scenes for the browser's MuJoCo, which is older than Python's."""

import json
import subprocess
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

TOLERANCE = 1e-5
"""Largest relative difference of a model's numbers: MJCF has six digits."""


def for_browser(scene: str) -> str:
    """Return the MJCF of a scene without what MuJoCo 3.17 writes and 3.14 refuses: ``input="pos"``, its default."""
    root = ElementTree.fromstring(scene)
    for actuator in root.iter("general"):
        if actuator.get("input") == "pos":
            del actuator.attrib["input"]
    return ElementTree.tostring(root, encoding="unicode")


def require_same_model(scene: str, model: mujoco.MjModel, runtimes: Path) -> str:
    """Check that the browser's MuJoCo compiles a scene to the model of Python's, and return its version.

    Args:
        scene: MJCF for the browser.
        model: Python's model of the scene.
        runtimes: The runtimes of the page.

    Raises:
        ValueError: If the scene does not compile, with MuJoCo's reason, or the models differ, with the fields.
    """
    report = _report(scene, runtimes)
    names = f"MuJoCo {report['version']} of the browser"
    if "error" in report:
        raise ValueError(f"{names} does not compile the scene: {' '.join(report['error'].split())}")
    if different := [name for name, values in report["fields"].items() if not _same(values, getattr(model, name))]:
        raise ValueError(
            f"{names} compiles the scene to another model than Python's {mujoco.__version__}: {', '.join(different)} "
            "differ"
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
