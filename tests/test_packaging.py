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
HOOK = """
import importlib.util, sys
from pathlib import Path

class Hook:
    def find_spec(name, path=None, target=None):
        folder = Path("{clone}", name.removeprefix("torchrl_mcp."))
        return importlib.util.spec_from_file_location(name, folder / "__init__.py") if folder.is_dir() else None

sys.meta_path.append(Hook)
"""
"""What an editable install of earlier versions put into the environment."""


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


def clone(folder):
    """Copy what a clone has of the packages, without what builds and runs left there."""
    for name in SOURCES:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ["pyproject.toml", "LICENSE", "README.md"]:
        shutil.copy(ROOT / name, folder)
    return folder


def build(folder, *options):
    """Build in a folder as ``python -m build`` does; return the wheel."""
    command = [sys.executable, "-m", "build", "--no-isolation", *options, "--outdir", folder / "dist", folder]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next((folder / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel that comes out of the source distribution."""
    return build(clone(tmp_path_factory.mktemp("clone")))


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


def test_a_wheel_from_the_source_distribution_equals_one_from_the_clone(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as first, zipfile.ZipFile(build(clone(tmp_path), "--wheel")) as second:
        assert sorted(first.namelist()) == sorted(second.namelist())
        assert all(first.read(name) == second.read(name) for name in first.namelist())


@pytest.fixture(scope="module")
def clones(tmp_path_factory):
    """Two clones, of which the first is installed editable, and the folder that this wrote into an environment.

    They differ in a setting and in a version of the environments.
    """
    clones = [clone(tmp_path_factory.mktemp(name)) for name in ("a", "b")]
    for folder in clones:
        with (folder / "conf" / "preset" / "smoke.yaml").open("a") as file:
            file.write(f"clone: {folder.name}\n")
    site = tmp_path_factory.mktemp("site")
    code = "import sys; from setuptools.build_meta import build_editable; build_editable(sys.argv[1])"
    done = run_python("-c", code, site, cwd=clones[0])
    assert done.returncode == 0, done.stderr
    zipfile.ZipFile(next(site.glob("*.whl"))).extractall(site)
    return *clones, site


def test_an_editable_install_is_a_path_that_editors_and_type_checkers_read(clones):
    installed, _, site = clones
    assert [path.read_text().split() for path in site.glob("*.pth")] == [[str(installed)]]
    assert not list(site.glob("*.py"))


def test_a_clone_uses_its_own_folders_while_another_is_installed(clones):
    _, other, site = clones
    code = (
        f"import runpy, site, sys; site.addsitedir({str(site)!r})\n"
        "sys.argv = ['train', '--cfg', 'job', 'preset=smoke', 'task=heading', 'method=scratch']\n"
        "runpy.run_module('torchrl_mcp.commands.train', run_name='__main__')\n"
        "import torchrl_mcp.envs\n"
        "print(*[m.__file__ for n, m in sys.modules.items() if n.startswith('torchrl_mcp')])"
    )
    done = run_code(code, cwd=other)
    assert done.returncode == 0, done.stderr
    *settings, files = done.stdout.splitlines()
    assert f"clone: {other.name}" in settings
    assert {Path(file).is_relative_to(other) for file in files.split()} == {True}
    assert {"envs", "conf"} <= {Path(file).parent.name for file in files.split()}


def test_a_clone_without_links_is_refused_instead_of_taking_the_folders_of_another(clones, tmp_path):
    installed, other, _ = clones
    shutil.copytree(other / "torchrl_mcp", tmp_path / "torchrl_mcp", symlinks=True)
    for link in (tmp_path / "torchrl_mcp" / name for name in ("conf", "envs")):
        link.unlink()
        link.write_text(f"../{link.name}")  # as Git does where it may not write links
    done = run_code(HOOK.format(clone=installed) + "import torchrl_mcp.envs, torchrl_mcp.conf", cwd=tmp_path)
    assert done.returncode != 0
    assert f"ImportError: {tmp_path / 'torchrl_mcp'}" in done.stderr


@pytest.mark.parametrize("name", ["envs", "conf"])
def test_a_module_of_the_users_comes_before_a_folder_of_the_clone(name, tmp_path):
    (tmp_path / f"{name}.py").write_text("MINE = True")
    code = (
        f"import sys; sys.path.remove(''); sys.path.append({str(ROOT)!r})\n"
        "from torchrl_mcp.commands import parsing; parsing.find_own_modules()\n"
        f"import {name}; print({name}.MINE)"
    )
    done = run_code(code, cwd=tmp_path)
    assert done.stdout.split() == ["True"], done.stderr


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
