"""Fetches the runtimes of the page: MuJoCo, ONNX Runtime and three.js for browsers, from pinned npm packages."""

import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, files
from importlib.resources import as_file
from importlib.resources import files as resources
from pathlib import Path
from types import MappingProxyType

FILES: Mapping[str, str] = MappingProxyType(
    {
        "mujoco.js": "@mujoco/mujoco/mujoco.js",
        "mujoco.wasm.gz": "@mujoco/mujoco/mujoco.wasm",
        "ort.js": "onnxruntime-web/dist/ort.wasm.bundle.min.mjs",
        "ort.wasm.gz": "onnxruntime-web/dist/ort-wasm-simd-threaded.wasm",
        "three.module.js": "three/build/three.module.js",
        "three.core.js": "three/build/three.core.js",
        "OrbitControls.js": "three/examples/jsm/controls/OrbitControls.js",
    }
)
"""Files of the packages by their names on the page; names with ``.gz`` stand for compressed files."""

LICENSES: Mapping[str, str] = MappingProxyType({"@mujoco/mujoco": "mujoco", "onnxruntime-web": "onnxruntime"})
"""npm packages without the text of their licence, and the Python packages of the same projects that contain it."""

NOTICES = "LICENSES.txt"
"""File with the licences of all packages."""


def runtimes() -> Path:
    """Return the folder of the runtimes in the user's cache, to which npm fetches them if necessary.

    Raises:
        ValueError: If npm is missing or cannot fetch the packages.
    """
    pins = (resources(__package__) / "package-lock.json").read_bytes()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl-mcp"
    folder = cache / f"page-{hashlib.sha256(pins).hexdigest()[:12]}"
    if not folder.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as temporary:
            packages = _fetch(Path(temporary))
            collected = Path(temporary) / folder.name
            _collect(packages, collected)
            collected.replace(folder)
    return folder


def require_npm() -> str:
    """Return the path of npm.

    Raises:
        ValueError: If npm or Node.js is not installed.
    """
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        raise ValueError(
            "writing a page needs npm, which fetches MuJoCo, ONNX Runtime and three.js for browsers: install Node.js "
            "18 or newer (Debian: apt install npm) and repeat the command"
        )
    return npm


def _fetch(folder: Path) -> Path:
    """Install the pinned packages below a folder, and return the folder of the packages.

    Raises:
        ValueError: If npm is missing or fails.
    """
    npm = require_npm()
    for name in ("package.json", "package-lock.json"):
        with as_file(resources(__package__) / name) as path:
            shutil.copy(path, folder)
    command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error", "--fetch-retries=1"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        reason = next(iter(done.stderr.strip().splitlines()), f"exit code {done.returncode}")
        raise ValueError(
            f"npm cannot fetch the packages of the page ({reason}): repeat the command with a connection to npm's "
            "registry, which only the first page needs"
        )
    return folder / "node_modules"


def _collect(packages: Path, folder: Path) -> None:
    """Copy the runtimes and their licences from the packages to a folder."""
    folder.mkdir()
    for name, source in FILES.items():
        if name.endswith(".gz"):
            (folder / name).write_bytes(gzip.compress((packages / source).read_bytes(), mtime=0))
        else:
            shutil.copy(packages / source, folder / name)
    shutil.copy(packages.parent / "package.json", folder)  # gives the versions, and tells node the kind of modules
    names = dict.fromkeys("/".join(source.split("/")[: 2 if source[0] == "@" else 1]) for source in FILES.values())
    (folder / NOTICES).write_text("\n\n".join(_license(packages / name, name) for name in names), encoding="utf-8")


def _license(package: Path, name: str) -> str:
    """Return the version, the licence and the notices of a package."""
    about = json.loads((package / "package.json").read_text(encoding="utf-8"))
    texts = [path.read_text(encoding="utf-8") for path in sorted(package.glob("LICENSE*"))]
    if not texts:
        texts = [path.read_text(encoding="utf-8") for path in _notices(LICENSES[name])]
    return "\n\n".join([f"{name} {about['version']}, {about['license']}", *texts])


def _notices(distribution: str) -> list[Path]:
    """Return the files with licences of an installed Python package, or none if it is not installed."""
    try:
        listed = files(distribution) or []
    except PackageNotFoundError:
        return []
    texts = [path for path in listed if path.suffix in ("", ".md", ".txt")]
    return [Path(str(path.locate())) for path in texts if re.search("license|notices", path.name.lower())]
