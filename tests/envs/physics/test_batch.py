import os
import signal

import mujoco
import pytest
import torch
from refusals import refused

from torchrl_mcp.envs.characters import ant
from torchrl_mcp.envs.physics.batch import BatchSimulation

# With so small an arena MuJoCo raises an error as soon as the box touches the floor.
FRAGILE = """
<mujoco>
  <size memory="4K"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 1"><joint name="root" type="free"/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
  <actuator><motor joint="root"/></actuator>
</mujoco>
"""


@pytest.fixture
def ants():
    simulation = BatchSimulation(ant().compile(), 4, substeps=5, outputs=["xpos"], num_threads=1)
    simulation.reset(torch.arange(4), {})
    return simulation


def copied(fields):
    return {name: field.clone() for name, field in fields.items()}


def test_a_step_is_that_of_plain_mujoco(ants):
    model = ant().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for ctrl in torch.rand(20, 8, dtype=torch.float64) * 2 - 1:
        data.ctrl = ctrl
        mujoco.mj_step(model, data, nstep=5)
        faults = ants.step(ctrl.expand(4, 8))
        assert len(faults) == 0
        for name, field in {**ants.state, **ants.outputs}.items():
            assert torch.equal(field[2], torch.as_tensor(getattr(data, name), dtype=torch.float64)), name


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_controls_may_have_any_precision(ants, dtype):
    controls = (torch.rand(4, 8) * 2 - 1).to(dtype)
    before = ants.state["qpos"].clone()
    assert len(ants.step(controls)) == 0
    assert torch.equal(ants.state["ctrl"], controls.double())
    assert not torch.equal(ants.state["qpos"], before)


def test_outputs_are_current_after_a_reset(ants):
    qpos = ants.state["qpos"][:2].clone()
    qpos[:, 0] = torch.tensor([3.0, 4.0])
    ants.reset(torch.tensor([1, 3]), {"qpos": qpos})
    assert ants.outputs["xpos"][:, 1, 0].tolist() == [0.0, 3.0, 0.0, 4.0]


def test_a_reset_leaves_the_neighbours_alone(ants):
    ants.step(torch.rand(4, 8))
    before = copied(ants.state)
    ants.reset(torch.tensor([2]), {"qvel": torch.ones(1, 14)})
    for name, field in ants.state.items():
        assert torch.equal(field[[0, 1, 3]], before[name][[0, 1, 3]]), name
    assert (ants.state["qvel"][2] == 1).all()
    assert ants.state["time"][2] == 0


@pytest.mark.parametrize("speed", [1e4, 1e8, 9e9])
def test_a_diverging_simulation_keeps_its_state_and_harms_no_other(ants, speed):
    twin = BatchSimulation(ant().compile(), 4, substeps=5, outputs=["xpos"], num_threads=1)
    twin.reset(torch.arange(4), {})
    ants.state["qvel"][1] = speed
    before, ctrl = copied(ants.state), torch.rand(4, 8)
    assert ants.step(ctrl).tolist() == [1]
    twin.step(ctrl)
    for name, field in {**ants.state, **ants.outputs}.items():
        assert torch.equal(field[[0, 2, 3]], {**twin.state, **twin.outputs}[name][[0, 2, 3]]), name
        assert field.isfinite().all(), name
    for name, field in ants.state.items():
        assert torch.equal(field[1], before[name][1]), name


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -1e30])
def test_a_control_without_meaning_is_a_fault(ants, number):
    ctrl = torch.zeros(4, 8)
    ctrl[3, 5] = number
    assert ants.step(ctrl).tolist() == [3]
    assert ants.state["time"].tolist() == [0.05, 0.05, 0.05, 0.0]


def test_an_error_inside_mujoco_is_a_fault_of_that_simulation():
    model = mujoco.MjModel.from_xml_string(FRAGILE)
    simulation = BatchSimulation(model, 3, substeps=2, outputs=["xpos"], num_threads=1)
    simulation.reset(torch.arange(3), {})
    simulation.state["qpos"][1, 2] = 0.05
    assert simulation.step(torch.zeros(3, 1)).tolist() == [1]
    assert simulation.state["qpos"][1, 2] == 0.05
    assert (simulation.state["time"] > 0).tolist() == [True, False, True]
    assert simulation.outputs["xpos"].isfinite().all()


def test_a_state_that_mujoco_cannot_compute_is_refused():
    simulation = BatchSimulation(mujoco.MjModel.from_xml_string(FRAGILE), 3, substeps=2, num_threads=1)
    touching = torch.tensor([[0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0]])
    refused(lambda: simulation.reset(torch.tensor([2]), {"qpos": touching}), "simulation 2")


def test_the_given_model_is_left_as_it_is():
    model = ant().compile()
    BatchSimulation(model, 1, substeps=1, num_threads=1)
    assert model.opt.disableflags == ant().compile().opt.disableflags


def test_the_time_spent_in_physics_is_counted(ants):
    before = ants.physics_seconds
    ants.step(torch.zeros(4, 8))
    assert 0 < ants.physics_seconds - before < 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a fork")
def test_simulations_that_a_fork_inherits_say_so_instead_of_waiting_for_threads_that_are_not_there(ants):
    try:
        child = os.fork()
    except OSError as error:  # MuJoCo Warp, once imported, reserves more memory than some systems let a process fork
        pytest.skip(f"this process cannot fork: {error}")
    if not child:
        signal.alarm(120)  # a busy machine may leave the child waiting
        try:
            ants.step(torch.zeros(len(ants.state["qpos"]), 8))
        except RuntimeError as error:
            os._exit(0 if "inherited this environment by a fork" in str(error) else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
