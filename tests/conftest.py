import ctypes
import gc
import os
import runpy
import sys
import traceback
from contextlib import chdir, redirect_stderr, redirect_stdout
from copy import deepcopy
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from subprocess import CompletedProcess

import pytest
import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py
import torch
from hydra.core.hydra_config import HydraConfig
from hypothesis import settings
from omegaconf import OmegaConf
from torchrl.envs import EnvBase

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions import generated_library

# An example's time says nothing here (first calls compile and allocate); in CI the same examples run every time.
settings.register_profile("default", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "default")


def pytest_addoption(parser):
    group = parser.getgroup("other processors", "for tests of trajectories, see tests/support/processors.py")
    group.addoption("--threads", type=int, default=1, help="threads of networks")
    group.addoption("--bfloat16", action="store_true", help="compute networks in bfloat16")
    group.addoption("--shift-seeds", type=int, default=0, metavar="N", help="add N to all seeds")
    group.addoption("--perturbations", type=int, default=0, metavar="N", help="repeat with N changes of the last bit")


def pytest_configure(config):
    # Small tensors: a thread pool costs more than it gives, and results must not depend on the machine's cores.
    torch.set_num_threads(config.getoption("threads"))


LONGEST = (
    *("test_page_browser.py", "test_collectors.py", "test_benchmarks.py", "test_workers.py", "test_ray_workers.py"),
    *("test_demo.py", "test_failures.py", "test_table_2.py", "test_simulation.py", "test_camera.py"),
)
"""Files whose tests start processes, and last longest."""


def pytest_collection_modifyitems(items):
    """Begin with the longest files, so that at the end no worker waits long for the last file of another."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_generate_tests(metafunc):
    """Repeat tests of trajectories as on as many other processors as asked for."""
    repetitions = metafunc.config.getoption("perturbations")
    if repetitions and metafunc.definition.get_closest_marker("trajectories"):
        metafunc.fixturenames.append("perturbation")
        metafunc.parametrize("perturbation", range(repetitions))


@pytest.fixture(autouse=True)
def _another_processor(request, monkeypatch):
    """Change tests of trajectories as options say: seeds, the precision, or the first observation of an episode."""
    if not request.node.get_closest_marker("trajectories"):
        yield
        return
    if shift := request.config.getoption("shift_seeds"):
        set_seed, manual_seed = EnvBase.set_seed, torch.manual_seed
        monkeypatch.setattr(torch, "manual_seed", lambda seed: manual_seed(seed + shift))
        monkeypatch.setattr(
            EnvBase,
            "set_seed",
            lambda env, seed=None, **kwargs: set_seed(env, None if seed is None else seed + shift, **kwargs),
        )
    if "perturbation" in request.fixturenames:
        generator = torch.Generator().manual_seed(request.getfixturevalue("perturbation"))
        reset = EnvBase.reset

        def perturbed(env, *arguments, **settings):
            state = reset(env, *arguments, **settings)
            observation = state["observation"]
            observation *= 1 + 1e-7 * torch.randn(observation.shape, generator=generator)
            return state

        monkeypatch.setattr(EnvBase, "reset", perturbed)
    # Without the cache, which would keep copies of the weights from before training or loading.
    with torch.autocast("cpu", torch.bfloat16, enabled=request.config.getoption("bfloat16"), cache_enabled=False):
        yield


def pytest_runtest_teardown(item, nextitem):
    """Return the memory of a file's tests to the system: the collector passes seldom, and the allocator keeps pages."""
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)


def pytest_collection_finish():
    """Let the garbage collector pass seldom, and over what tests leave alone: imports live to the end."""
    gc.freeze()
    gc.set_threshold(100_000)


@pytest.fixture(scope="session", autouse=True)
def _corpora_generated_once():
    """Give the environments of all tests the same corpora, which nobody changes and which take a third of a second."""
    once = cache(generated_library)
    with pytest.MonkeyPatch.context() as patch:
        for module in ("motions", "initial_states"):
            patch.setattr(f"torchrl_mcp.envs.{module}.generated_library", once)
        yield


@pytest.fixture(scope="session", autouse=True)
def _settings_parsed_once():
    """Parse the same text once: a quarter of the time in which Hydra composes a run."""
    load = OmegaConf.load
    once = cache(lambda text: load(StringIO(text)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", lambda f: deepcopy(once(f.read())) if hasattr(f, "read") else load(f))
        yield


@pytest.fixture(scope="session")
def mocap() -> Path:
    """Folder of third-party motion capture, which is no part of the project."""
    folder = os.environ.get("TORCHRL_MCP_MOCAP")
    if not folder:
        pytest.skip("needs motion-capture files: set TORCHRL_MCP_MOCAP to their folder")
    if not Path(folder).is_dir():
        pytest.fail(f"TORCHRL_MCP_MOCAP={folder!r} is not a folder: correct it, or unset it to skip these tests")
    return Path(folder)


@pytest.fixture(scope="session")
def command():
    """Call a command as a shell would, but in this process, which has imported PyTorch: ``command("train", "seed=1")``.

    What it leaves in Python's global state is undone.
    """

    def call(name, *arguments, cwd="."):
        words = [f"torchrl-mcp-{name}", *map(str, arguments)]
        output, errors = StringIO(), StringIO()
        threads = torch.get_num_threads()
        with pytest.MonkeyPatch.context() as patch, chdir(cwd), redirect_stdout(output), redirect_stderr(errors):
            patch.setattr(sys, "argv", words)
            patch.setattr(HydraConfig.instance(), "cfg", None)
            code = _exit_code(import_module(f"torchrl_mcp.commands.{name}").main)
        torch.set_num_threads(threads)
        return CompletedProcess(words, code, output.getvalue(), errors.getvalue())

    return call


@pytest.fixture(scope="session")
def robot_file():
    """Find a robot's file of the package mjlab, which is no part of the project, without importing that."""

    def find(name) -> Path:
        found = find_spec("mjlab")
        if found is None:
            pytest.skip("needs robots' files: pip install --no-deps mjlab==1.6.0")
        return Path(found.origin).parent / "asset_zoo" / "robots" / f"unitree_{name}" / "xmls" / f"{name}.xml"

    return find


@pytest.fixture(scope="module")
def robot(robot_file, command, tmp_path_factory):
    """Adapt a robot by one command, and register it until the module's tests end; return what the command printed."""
    folder, names = tmp_path_factory.mktemp("robots"), []

    def adapt(name, *options):
        if name not in CHARACTERS:
            done = command("character", "adapt", robot_file(name), "--name", name, *options, cwd=folder)
            assert done.returncode == 0, done.stderr
            runpy.run_path(str(folder / f"{name}.py"))
            names.append(name)
            outputs[name] = done.stdout
        return outputs[name]

    outputs: dict[str, str] = {}
    yield adapt
    for name in names:
        del CHARACTERS[name]


def _exit_code(main):
    """Return what a process that ran the function would end with, after printing what Python would print."""
    try:
        main()
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
            return 1
        return stop.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    return 0
