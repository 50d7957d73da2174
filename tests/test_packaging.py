import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]
SOURCES = {"torchrl_mcp": "torchrl_mcp", "envs": "torchrl_mcp/envs", "conf": "torchrl_mcp/conf"}


def source_files():
    """Files of the package folders, each with the name it has to have in the wheel."""
    for folder, target in SOURCES.items():
        for path in (ROOT / folder).rglob("*"):
            inside = path.relative_to(ROOT / folder)
            if path.is_file() and "__pycache__" not in inside.parts:
                yield path, PurePosixPath(target, inside.as_posix())


def run_python(*args, cwd, path=()):
    """Run this interpreter without ``site``: no editable install can lend it a module."""
    python_path = os.pathsep.join(map(str, [*path, sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]))
    environment = {**os.environ, "PYTHONPATH": python_path, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run([sys.executable, "-S", *args], cwd=cwd, env=environment, capture_output=True, text=True)


def run_code(code, **kwargs):
    return run_python("-c", code, **kwargs)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel that comes out of the source distribution, built from a copy: no stale ``build/`` leaks in."""
    checkout, dist = tmp_path_factory.mktemp("checkout"), tmp_path_factory.mktemp("dist")
    for folder in SOURCES:
        shutil.copytree(ROOT / folder, checkout / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ["pyproject.toml", "LICENSE", "README.md"]:
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, checkout)
    build = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", dist, checkout], capture_output=True, text=True
    )
    assert build.returncode == 0, build.stdout + build.stderr
    return next(dist.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Folder into which the wheel alone was installed."""
    target = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", target, wheel]
    install = subprocess.run(command, capture_output=True, text=True)
    assert install.returncode == 0, install.stderr
    return target


def test_package_list_equals_the_folders_on_disk():
    on_disk = {".".join(target.parent.parts) for _, target in source_files() if target.name == "__init__.py"}
    assert sorted(SETUPTOOLS["packages"]) == sorted(on_disk)


def test_every_folder_of_modules_is_a_package():
    for path, _ in source_files():
        if path.suffix == ".py":
            assert (path.parent / "__init__.py").exists(), f"{path.parent} holds modules but no __init__.py"


def test_wheel_has_one_top_level_name(wheel):
    names = {PurePosixPath(name).parts[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"torchrl_mcp"}


def test_wheel_holds_every_source_and_data_file(wheel):
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == {str(target) for _, target in source_files()}
    assert "torchrl_mcp/py.typed" in packed


def test_installed_wheel_imports_outside_the_checkout(installed, tmp_path):
    code = "import torchrl_mcp, torchrl_mcp.envs as envs, torchrl_mcp.conf as conf\n"
    code += "print(torchrl_mcp.__file__, envs.__file__, conf.__file__, sep='\\n')"
    result = run_code(code, cwd=tmp_path, path=[installed])
    assert result.returncode == 0, result.stderr
    assert [Path(line).is_relative_to(installed) for line in result.stdout.splitlines()] == [True] * 3


@pytest.mark.skipif(not (ROOT / "conf/train.yaml").exists(), reason="conf/train.yaml is not written yet")
def test_hydra_composes_the_training_config_outside_the_checkout(installed, tmp_path):
    code = (
        "from hydra import compose, initialize_config_module\n"
        "with initialize_config_module('torchrl_mcp.conf', version_base='1.3'):\n"
        "    print(len(compose('train')))"
    )
    result = run_code(code, cwd=tmp_path, path=[installed])
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 0


@pytest.mark.parametrize("name", ["envs", "conf"])
def test_short_import_from_the_root_fails_with_the_remedy(name):
    result = run_code(f"import {name}", cwd=ROOT)
    assert result.returncode != 0
    assert f"ImportError: import torchrl_mcp.{name}, not {name}" in result.stderr


@pytest.mark.parametrize("script", PROJECT["project"]["scripts"].values())
def test_console_scripts_point_at_modules(script):
    module, _, function = script.partition(":")
    assert function == "main"
    assert importlib.util.find_spec(module) is not None


@pytest.mark.parametrize(
    "requirement", PROJECT["project"]["dependencies"] + PROJECT["project"]["optional-dependencies"]["dev"]
)
def test_constraints_pin_each_dependency_inside_its_range(requirement):
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.lower().split("==") for line in lines if line and not line.startswith("#"))
    requirement = Requirement(requirement)
    assert requirement.specifier.contains(pins[requirement.name])
