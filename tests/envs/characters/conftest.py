import mujoco
import numpy as np
import pytest

from torchrl_mcp.envs.characters import CHARACTERS


@pytest.fixture(scope="session", params=CHARACTERS.values(), ids=lambda character: character.name)
def character(request):
    """Every character."""
    return request.param


@pytest.fixture(scope="session")
def scene():
    """The character with a floor at z = 0 and a ceiling, which it cannot reach, at z = 9."""

    def scene(character):
        spec, plane = character.spec(), mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(name="floor", type=plane, size=[0, 0, 1], contype=1)
        spec.worldbody.add_geom(name="ceiling", type=plane, size=[0, 0, 1], pos=[0, 0, 9], zaxis=[0, 0, -1], contype=1)
        return spec.compile()

    return scene


@pytest.fixture(scope="session")
def joints():
    """Joints of a model but the root's."""

    def joints(model):
        free = mujoco.mjtJoint.mjJNT_FREE
        return [model.joint(index) for index in range(model.njnt) if model.jnt_type[index] != free]

    return joints


@pytest.fixture(scope="session")
def actuators():
    """Indices of the actuators of a joint."""

    def actuators(model, joint):
        return np.flatnonzero(model.actuator_trnid[:, 0] == joint.id)

    return actuators
