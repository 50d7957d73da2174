"""Which folder may import which, and who may import Hydra."""

import ast
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ORDER = (
    {"adapters"},
    {"distributions"},
    {"modules"},
    {"methods"},
    {"objectives"},
    {"evaluation"},
    {"training"},
    {"runs"},
    {"analysis"},
    {"report", "viewer"},
    {"commands"},
)
"""Folders of ``torchrl_mcp``, of which each may import those before it."""
CONTRACT = "torchrl_mcp.adapters.contract"
"""Between environments and all that uses them."""
VALUES = "torchrl_mcp.values"
"""The types with rules, which every folder may import, and which imports none."""
RANKS = {folder: rank for rank, folders in enumerate(ORDER) for folder in folders}
ROOMS = (
    {"rotations"},
    {"physics"},
    {"characters"},
    {"rendering"},
    {"motions"},
    {"observations", "ideal", "curriculum", "initial_states", "steering"},
    {"base"},
    {"pd_character"},
    {"tasks"},
    {"registration", "gymnasium_env"},
)
"""Folders and modules of ``torchrl_mcp.envs``, of which each may import those before it."""
ROOM_RANKS = {room: rank for rank, rooms in enumerate(ROOMS) for room in rooms}
HYDRA = {f"torchrl_mcp.runs.{name}" for name in ("configuration", "provenance", "build", "benchmark")}
"""Modules beside those of ``commands`` that may import Hydra: composing, building, launching."""
WITHOUT_HYDRA = {folder for folders in ORDER[:7] for folder in folders} | {"analysis", "viewer", "envs"}
RESTORING = {"torchrl_mcp.analysis.checkpoints"}
"""Modules of theirs that restore runs, by way of ``runs.build``."""


def modules():
    """Every module by name, with its file."""
    for package, folder in (("torchrl_mcp", "torchrl_mcp"), ("torchrl_mcp.envs", "envs")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            inside = path.relative_to(ROOT / folder).with_suffix("").parts
            yield ".".join([package, *(part for part in inside if part != "__init__")]), path


MODULES = dict(modules())


def imports(name):
    """What a module imports: modules by name, as far as they are ours."""
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                member = f"{node.module}.{alias.name}"
                yield member if member in MODULES else node.module


def folder(name):
    return name.split(".")[1] if name.count(".") else None


IMPORTS = {name: set(imports(name)) for name in MODULES}


def test_every_folder_has_its_place():
    assert {folder(name) for name in MODULES if name != VALUES} - {None} == set(RANKS) | {"envs"}


def test_the_types_with_rules_need_the_standard_library_alone():
    assert {name.split(".")[0] for name in IMPORTS[VALUES]} <= sys.stdlib_module_names


@pytest.mark.parametrize("name", sorted(RANKS))
def test_a_folder_imports_none_that_builds_on_it(name):
    for module in MODULES:
        if folder(module) == name:
            ranked = {other for other in IMPORTS[module] if folder(other) in RANKS and folder(other) != name}
            above = {other for other in ranked if RANKS[folder(other)] >= RANKS[name]}
            assert not above, f"{module} imports {above}"


def test_environments_know_nothing_of_what_learns():
    for module in MODULES:
        if folder(module) == "envs":
            ours = {other for other in IMPORTS[module] if other.startswith("torchrl_mcp")} - {CONTRACT, VALUES}
            assert all(folder(other) == "envs" for other in ours), f"{module} imports {ours}"


@pytest.mark.parametrize("name", ["adapters", "evaluation", "objectives", "training"])
def test_what_learns_knows_nothing_of_the_library_own_environments(name):
    for module in MODULES:
        if folder(module) == name:
            assert not [name for name in IMPORTS[module] if name.startswith("torchrl_mcp.envs")], module


def room(name):
    return name.split(".")[2] if folder(name) == "envs" and name.count(".") > 1 else None


def test_a_room_of_the_environments_imports_none_that_builds_on_it():
    inside = [module for module in MODULES if room(module)]
    assert {room(module) for module in inside} == ROOM_RANKS.keys()
    for module in inside:
        others = {other for other in IMPORTS[module] if room(other) and room(other) != room(module)}
        above = {other for other in others if ROOM_RANKS[room(other)] >= ROOM_RANKS[room(module)]}
        assert not above, f"{module} imports {above}"


def test_no_modules_import_one_another_in_a_circle():
    done = set()

    def visit(module, path):
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module in done:
            return
        for other in sorted(IMPORTS[module] & MODULES.keys()):
            visit(other, [*path, module])
        done.add(module)

    for module in MODULES:
        visit(module, [])


def test_hydra_is_imported_at_the_door_alone_and_without_its_internals():
    using = {name for name in MODULES if any(other.split(".")[0] == "hydra" for other in IMPORTS[name])}
    assert {name for name in using if folder(name) != "commands"} == HYDRA
    assert not [other for name in using for other in IMPORTS[name] if "._" in other]


def test_only_training_changes_the_command_line_of_the_process():
    changing = set()
    for name, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del):
                changing |= {name} if ast.unparse(node).startswith("sys.argv") else set()
    assert changing == {"torchrl_mcp.commands.train"}  # because hydra.main reads nothing else


OF_EXTRAS = {"torchrl_mcp.envs.physics.warp"} if find_spec("mujoco_warp") is None else set()
"""What imports an extra that is not there."""


def test_the_library_imports_without_hydra_and_leaves_scipy_to_the_functions_that_need_it():
    library = [name for name in MODULES if folder(name) in WITHOUT_HYDRA and name not in RESTORING | OF_EXTRAS]
    code = (
        "import importlib, sys\n"
        "sys.modules['hydra'] = None\n"
        "for name in sys.argv[1:]: importlib.import_module(name)\n"
        "assert not {'scipy.interpolate', 'scipy.stats'} & set(sys.modules)\n"
        "print(len(sys.argv) - 1)"
    )
    run = subprocess.run([sys.executable, "-c", code, *library], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) == len(library) > 80


def test_the_distributions_need_torch_alone_and_come_with_the_package():
    code = (
        "import sys, torchrl_mcp\n"
        "assert 'torch' not in sys.modules\n"
        "from torchrl_mcp import MultiplicativeGaussian\n"
        "assert MultiplicativeGaussian is torchrl_mcp.distributions.MultiplicativeGaussian\n"
        "assert not {'gymnasium', 'hydra', 'mujoco', 'tensordict', 'torchrl'} & set(sys.modules)\n"
        "print(*dir(torchrl_mcp))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    names = run.stdout.split()
    assert {"MultiplicativeGaussian", "distributions", "envs"} <= set(names)
    assert not [name for name in names if name.startswith("_") and name != "__version__"]


def imports_of_mujoco():
    """Modules that import MuJoCo: of a folder that imports tensordict first, one."""
    using = [name for name in MODULES if any(other.split(".")[0] == "mujoco" for other in IMPORTS[name])]
    firsts = {f"torchrl_mcp.{folder(name)}": name for name in using if name not in OF_EXTRAS}
    guarded = {package for package in firsts if "tensordict" in IMPORTS[package]}
    return [name for name in using if f"torchrl_mcp.{folder(name)}" not in guarded] + [firsts[name] for name in guarded]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks a process that has imported torch")
def test_tensordict_and_with_it_triton_is_imported_before_mujoco():
    code = (
        "import importlib, os, sys, torch, torch._dynamo\n"
        "class Watch:\n"
        "    def find_spec(name, *_):\n"
        "        if name == 'mujoco':\n"
        "            print(module, 'tensordict' in sys.modules, flush=True)\n"
        "            os._exit(0)\n"
        "sys.meta_path.insert(0, Watch)\n"
        "for module in sys.argv[1:]:\n"
        "    if not os.fork():\n"
        "        importlib.import_module(module)\n"
        "    os.wait()"
    )
    names = imports_of_mujoco()
    run = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=True)
    assert dict(map(str.split, run.stdout.splitlines())) == dict.fromkeys(names, "True")
