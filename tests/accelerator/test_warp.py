"""Rollouts by MuJoCo Warp on the stand-in: what crosses to the processor, see ``warp_rehearsal.py``."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

REHEARSAL = Path(__file__).with_name("warp_rehearsal.py")
NUM_STEPS = 12
WHOM = {"heading": 2, "location": 2, "dribble": 2, "holdout": 2, "carry": 6, "imitation": 3}
"""How often a step asks who: who faulted, whose episodes end, who takes the box or lets it go, whose clips change."""
WHETHER = {"imitation": 2}
"""How often a step asks whether anyone does something: whether a clip begins anew."""
SCENES = ["heading", *(pytest.param(name, marks=pytest.mark.slow) for name in WHOM if name != "heading")]


@pytest.fixture(scope="module", params=SCENES)
def rehearsal(request):
    """What a rehearsal found, in a process of its own: an accelerator is there for good."""
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    command = [sys.executable, "-W", "ignore", str(REHEARSAL), request.param]
    run = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert run.returncode == 0, run.stderr
    return request.param, json.loads(run.stdout.splitlines()[-1])[request.param]


def test_nothing_crosses_to_the_processor_in_a_rollout_but_who_and_whether(rehearsal):
    scene, found = rehearsal
    # TorchRL's reset checks once that all has been reset.
    assert set(found["waits"]) <= {"nonzero", "_local_scalar_dense"}
    assert found["waits"]["nonzero"] <= WHOM[scene] * NUM_STEPS
    assert found["waits"].get("_local_scalar_dense", 0) <= 3 + WHETHER.get(scene, 0) * NUM_STEPS


def test_what_is_observed_and_rewarded_on_a_device_is_the_cpus(rehearsal):
    assert rehearsal[1]["apart"] < 1e-4
