"""Rollouts by MuJoCo Warp on the stand-in: ``warp_rehearsal.py SCENE...`` prints what crossed to the processor.

Warp's memory is the CPU's, and what an environment sees of it are tensors of the stand-in: whatever it does with them
counts as on a GPU. Seeds and actions are those of an environment on Warp's CPU device, with which it is compared.
"""

import json
import sys
from collections import Counter
from contextlib import redirect_stdout

import torch
from stand_in import NAME, Accelerator, PretendTensor, register

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, Location
from torchrl_mcp.envs.motions import generated_library
from torchrl_mcp.envs.physics import warp

NUM_ENVS, NUM_STEPS = 4, 12
TERMS = {name: {"weight": 0.1, "scale": 1.0} for name in ("pose", "velocity", "root_pose", "key_positions", "com")}


def main():
    """Rehearse the scenes of the command line."""
    kept, cpu = register(), warp.wp.get_device("cpu")
    plain_view, plain_device = warp._view, warp.wp.device_from_torch
    torch.Generator = lambda device="cpu", plain=torch.Generator: plain()  # the stand-in has none
    found = {}
    with redirect_stdout(sys.stderr):
        for scene in sys.argv[1:]:
            expected = rollout(make(scene, "cpu"))
            warp._view = lambda array: PretendTensor(plain_view(array))
            warp.wp.device_from_torch = lambda device: cpu
            with Accelerator():
                env = make(scene, NAME)
                waits = count()
                observed = rollout(env)
                PretendTensor.on_wait = staticmethod(lambda operation: None)
            warp._view, warp.wp.device_from_torch = plain_view, plain_device
            apart = max(float((one.cpu() - other).abs().max()) for one, other in zip(observed, expected, strict=True))
            found[scene] = {"waits": waits, "apart": apart}
    print(json.dumps(found))
    del kept


def make(scene, device):
    """Return environments of a scene, whose episodes end soon."""
    shared = {"physics": "warp", "device": device, "seed": 0, "max_episode_steps": 5}
    if scene == "holdout":
        return Holdout(NUM_ENVS, (0.0, 6.0), **shared)
    if scene == "imitation":
        library = generated_library("biped", seed=0)
        return Imitation("biped", library, NUM_ENVS, terms=TERMS, switch_interval=0.2, **shared)
    return {"heading": Heading, "location": Location, "carry": Carry, "dribble": Dribble}[scene](
        "biped", NUM_ENVS, **shared
    )


def rollout(env):
    """Step through episodes, and return observations, goals and rewards of all steps."""
    state, parts, shape = env.reset(), [], env.action_spec.shape
    script = torch.rand(NUM_STEPS, *shape, generator=torch.Generator("cpu").manual_seed(0))
    for action in (0.4 * script - 0.2).to(env.device):
        step, state = env.step_and_maybe_reset(state.set("action", action))
        parts.append(torch.cat([step["next", key] for key in ("observation", "goal", "reward")], -1))
    return parts


def count():
    """Return a counter of what the processor waits for from now on, by operation."""
    waits = Counter()
    PretendTensor.on_wait = staticmethod(lambda operation: waits.update([operation.overloadpacket.__name__]))
    return waits


if __name__ == "__main__":
    main()
