"""Biped and humanoid are the published characters, of which the files are third-party data."""

import json
import re
from itertools import product

import mujoco
import numpy as np
import pytest

from torchrl_mcp.envs.characters import CHARACTERS

SOURCES = {"biped": "biped/biped3d_mocap_character.txt", "humanoid": "deepmimic/humanoid3d_character.txt"}


def character_file(mocap, name):
    """The published character's joints and bodies by name; the file has commas that JSON does not allow."""
    text = re.sub(r",(\s*[}\]])", r"\1", (mocap / SOURCES[name]).read_text())
    content = json.loads(text)
    skeleton = {joint["Name"]: joint for joint in content["Skeleton"]["Joints"]}
    return skeleton, {body["Name"]: body for body in content["BodyDefs"]}


def our_axes(x, y, z):
    """From x forward, y up, z right to x forward, y left, z up."""
    return [x, -z, y]


@pytest.mark.parametrize("name", SOURCES)
def test_masses_offsets_and_torques_are_those_of_the_published_character(mocap, name, joints, actuators):
    skeleton, bodies = character_file(mocap, name)
    model = CHARACTERS[name].spec().compile()
    for body, published in bodies.items():
        assert model.body(body).mass[0] == published["Mass"]
    for index in range(2, model.nbody):
        body = model.body(index)
        offset = our_axes(*(skeleton[body.name][f"Attach{axis}"] for axis in "XYZ"))
        np.testing.assert_allclose(body.pos, offset, atol=1e-9)
    for joint in joints(model):
        torques = model.actuator_forcerange[actuators(model, joint)]
        np.testing.assert_array_equal(np.abs(torques), skeleton[joint.name]["TorqueLim"])


@pytest.mark.parametrize("name", SOURCES)
def test_limits_are_those_of_the_published_character(mocap, name, joints):
    skeleton, _ = character_file(mocap, name)
    model = CHARACTERS[name].spec().compile()
    for joint in joints(model):
        published = skeleton[joint.name]
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            assert joint.range.tolist() == [published["LimLow0"], published["LimHigh0"]]
        else:
            largest = max(abs(published[f"Lim{end}{axis}"]) for end, axis in product(("Low", "High"), range(3)))
            # The shoulders keep away from pi, where rotation vectors jump.
            assert joint.range[1] == (2.8 if "shoulder" in joint.name else largest)
