"""Training with the networks on an accelerator, rehearsed where there is none: see ``stand_in.py``."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

REHEARSAL = Path(__file__).with_name("rehearsal.py")
METHODS = [
    "mcp",
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in ("scratch", "finetune", "hierarchical", "option_critic", "moe", "latent_space")
    ),
]
WAITS_PER_UPDATE = 5
"""Means of the actor's gradient steps, of its last epoch's and of the critic's, the policy's spread, and dead units."""
WAITS_OF_CRITIC = 3
"""The same where the critic alone learns."""
WAITS_BESIDES = 35
"""What else an iteration records or selects by a mask, and what a run begins with: up to 26 so far.

How many episodes and options end differs between processors. A wait in each of the 32 steps would add as many.
"""
GRADIENT_STEPS = 6


@pytest.fixture(scope="module", params=METHODS)
def rehearsal(request):
    """What a rehearsal found, in a process of its own: an accelerator is there for good."""
    command = [sys.executable, "-W", "ignore", str(REHEARSAL), request.param]
    run = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    return request.param, found[request.param], found["planted"]


def test_a_method_learns_what_it_learns_on_the_cpu_and_resumes_to_the_same_numbers(rehearsal):
    method, found, _ = rehearsal
    if method != "scratch":
        assert found["pretrain"] == [pytest.approx(row, rel=1e-3, abs=1e-6, nan_ok=True) for row in found["cpu"]]
    assert len(found["transfer"]) == 2
    assert str(found["resumed"]) == str(found["transfer"])  # NaN where no episode has ended
    for numbers in (found["evaluation"][mode] for mode in ("deterministic", "stochastic")):
        assert 0 < numbers["return"] == pytest.approx(numbers["return"])


def test_gradient_steps_do_not_wait_for_the_accelerator(rehearsal):
    method, found, _ = rehearsal
    # Separate options split their samples by the option that acts, whose numbers the processor must know.
    splits = GRADIENT_STEPS + 1 if method == "hierarchical" else 0
    if method != "scratch":
        # MOE's imitation has an entropy bonus, and TorchRL's loss checks that it is finite.
        entropies = GRADIENT_STEPS if method == "moe" else 0
        assert found["waits of pretrain"]["update"] == WAITS_PER_UPDATE + splits + entropies
        assert found["waits of pretrain"]["other"] <= WAITS_BESIDES
    waits = WAITS_OF_CRITIC if method == "option_critic" else WAITS_PER_UPDATE  # its options are frozen at transfer
    assert found["waits of transfer"]["update"] == 2 * waits


def test_a_tensor_left_on_the_cpu_is_found(rehearsal):
    assert "mixes a tensor (3,) of the CPU with tensors of pretend" in rehearsal[2]
