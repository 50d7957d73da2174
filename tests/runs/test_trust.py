"""What configurations of files may name, and how they are read."""

import re
import sys
import time
from pathlib import Path

import pytest
from refusals import refused

from torchrl_mcp import conf
from torchrl_mcp.runs.imports import require_known
from torchrl_mcp.runs.trust import GET_CLASS, library_names, read_config, require_trusted, trusting

FILE = Path("stranger/config.yaml")


def makes(name, **arguments):
    return {"seed": 0, "parts": [{"network": {"_target_": name, **arguments}}]}


def test_what_may_be_built_is_what_the_files_of_the_library_name():
    lines = [line for path in Path(conf.__file__).parent.rglob("*.yaml") for line in path.read_text().splitlines()]
    named = {name for line in lines for name in re.findall(r"_target_: ([\w.]+)", line)}
    classes = {name for line in lines for name in re.findall(rf"{GET_CLASS}, path: ([\w.]+)", line)}
    assert library_names() == (named | classes) - {"torchrl_mcp.commands.sweep.Sweep"}  # of Hydra, which no run has
    assert {"torch.optim.Adam", "torchrl_mcp.envs.Heading", "torch.nn.Sigmoid"} < library_names()


@pytest.mark.parametrize(
    "config",
    [
        makes("torch.utils.collect_env.run", command="touch here"),
        makes("builtins.eval"),
        makes("torchrl_mcp.runs.provenance.subprocess.run"),
        makes("torchrl_mcp.training.run_folder.write_json"),
        makes(GET_CLASS, path="subprocess.Popen"),
        makes("torch.nn.Sigmoid.__init__.__globals__"),
        makes("own.tasks.Juggle"),
    ],
)
def test_nothing_else_may_be_built_and_the_remedy_is_named(config):
    refused(lambda: require_trusted(config, FILE), str(FILE), "--trust")


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A package of the user's own."""
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package" / "__init__.py").write_text("import subprocess\nfrom .tasks import Juggle\n")
    (tmp_path / "own_package" / "tasks.py").write_text("import os\nclass Juggle: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in ("own_package", "own_package.tasks"):
        sys.modules.pop(name, None)


def test_what_a_trusted_module_defines_may_be_built_but_not_what_it_imports(own):
    with trusting({"own_package"}):
        for name in ("own_package.tasks.Juggle", "own_package.Juggle", "torch.nn.Sigmoid"):
            require_trusted(makes(name), FILE)
        for name in ("own_package.subprocess.run", "own_package.tasks.os.system", "own_package_2.Juggle"):
            refused(lambda name=name: require_trusted(makes(name), FILE), name)
    with trusting({"own_package.tasks.Juggle"}):
        require_trusted(makes("own_package.tasks.Juggle"), FILE)
    refused(lambda: require_trusted(makes("own_package.tasks.Juggle"), FILE), "own_package.tasks.Juggle")


def test_what_is_not_trusted_is_not_even_imported(tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    refused(lambda: require_trusted(makes("trap.run"), FILE), "trap.run")
    refused(lambda: require_known(makes("trap.run"), FILE), "trap.run", "--trust")


def test_an_interpolation_is_neither_followed_nor_accepted(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "swordfish")
    file = tmp_path / "config.yaml"
    file.write_text("task: {name: '${oc.env:SECRET}'}\n")
    config = read_config(file)
    assert config == {"task": {"name": "${oc.env:SECRET}"}}
    assert "swordfish" not in refused(lambda: require_trusted(config, file), str(file))


BOMB = "\n".join(["a0: &a0 [x]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)])


DEEP = ["a: " + "[" * 150 + "]" * 150, "[" * 500_000, "- " * 500_000, "? " * 500_000]


@pytest.mark.parametrize("content", [*DEEP, BOMB, "a: " + "x" * 2**21, "a: [", "- 1", "a: 1\na: 2"], ids=range(9))
def test_what_is_no_configuration_is_refused_within_seconds(tmp_path, content):
    file = tmp_path / "config.yaml"
    file.write_text(content)
    began = time.process_time()
    refused(lambda: read_config(file), str(file))
    assert time.process_time() - began < 10


def test_a_configuration_in_another_encoding_is_refused(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_bytes("a: é".encode("latin-1"))
    refused(lambda: read_config(file), str(file))
