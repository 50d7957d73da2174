"""An exported policy walks in a program without torch and without this library."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.commands import export
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.runs.policies import restore

onnx = pytest.importorskip("onnx", reason="needs pip install 'torchrl-mcp[onnx]'")
pytest.importorskip("onnxruntime", reason="needs pip install 'torchrl-mcp[onnx]'")
pytest.importorskip("onnxscript", reason="needs pip install 'torchrl-mcp[onnx]'")

WALK = Path(__file__).parents[2] / "docs" / "guide" / "walk.py"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The file of the humanoid's heading policy, and its metadata."""
    path = tmp_path_factory.mktemp("exported") / "humanoid.onnx"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["torchrl-mcp-export", "builtin:humanoid-heading", "--onnx", str(path)])
        export.main()
    return path, {entry.key: json.loads(entry.value) for entry in onnx.load(path).metadata_props}


@pytest.fixture(scope="module")
def env():
    """Four simulations of the task, after some random actions."""
    _, _, env = restore(locate("builtin:humanoid-heading"), num_envs=4, seed=3)
    env.rollout(6, break_when_any_done=False)
    return env


def test_the_batch_dimension_is_called_batch(exported):
    graph = onnx.load(exported[0]).graph
    names = {value.name: value.type.tensor_type.shape.dim[0].dim_param for value in (*graph.input, *graph.output)}
    assert names == {"observation": "batch", "goal": "batch", "action": "batch"}


def test_the_metadata_name_every_value_with_its_unit(exported, env):
    metadata = exported[1]
    reset = env.reset()
    for key in ("observation", "goal"):
        assert sum(entry["size"] for entry in metadata[key]) == reset[key].shape[-1]
        assert all(entry["name"] and entry["unit"] for entry in metadata[key])
    model = mujoco.MjModel.from_xml_string(metadata["scene"])
    assert [entry["name"] for entry in metadata["action"]] == [model.actuator(index).name for index in range(model.nu)]
    assert metadata["physics_timestep"] == pytest.approx(model.opt.timestep)
    assert metadata["control_timestep"] == pytest.approx(1 / 30)


def test_the_program_observes_and_controls_what_the_environment_does(exported, env):
    program, metadata = runpy.run_path(str(WALK)), exported[1]
    model = mujoco.MjModel.from_xml_string(metadata["scene"])
    data = mujoco.MjData(model)
    action = torch.rand(4, model.nu, generator=torch.Generator().manual_seed(0)) * 2 - 1
    step = env.step(env.reset().set("action", action))
    states = env.simulation.state
    for index in range(4):
        data.qpos[:], data.qvel[:] = states["qpos"][index].numpy(), states["qvel"][index].numpy()
        mujoco.mj_forward(model, data)
        observed = step["next", "observation"][index].numpy()
        np.testing.assert_allclose(program["observe"](model, data), observed, atol=1e-6, rtol=1e-6)
        ctrl = program["controls"](metadata["action"], action[index].numpy())
        np.testing.assert_allclose(ctrl, states["ctrl"][index].numpy(), atol=1e-6)


def test_the_program_runs_without_torch_and_without_the_library(exported):
    code = (
        "import runpy, sys; sys.modules['torch'] = sys.modules['torchrl_mcp'] = None; "
        "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code, WALK, exported[0]], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert " m in 20 s" in done.stdout
