"""Films of policies at work."""

from collections.abc import Iterator
from pathlib import Path

import torch
from PIL import Image
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.envs import CharacterEnv

EVERY = 2
"""Control steps per picture."""

COLOURS = 64
"""Of a picture: a GIF of this many is half as large as one of 256."""


def film(
    policy: TensorDictModuleBase, env: CharacterEnv, *, seconds: float, width: int = 320, height: int = 240
) -> Iterator[Image.Image]:
    """Draw the first of a batch of simulations while a policy plays its deterministic actions.

    Args:
        policy: From what the environment shows to ``action``, on the CPU.
        env: Environments; an episode that ends is followed by another.
        seconds: Duration.
        width: Pixels.
        height: Pixels.

    Yields:
        A picture of every other control step.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
    """
    state = env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in range(round(seconds / env.control_timestep)):
            decision = policy(state.select(*policy.in_keys))
            _, state = env.step_and_maybe_reset(state.update(decision))
            if step % EVERY == EVERY - 1:
                picture = env.render(width=width, height=height, distance=3.5)
                yield Image.fromarray(picture.numpy()).quantize(COLOURS)
    env.close()


def save_film(policy: TensorDictModuleBase, env: CharacterEnv, path: Path, *, seconds: float = 8.0) -> None:
    """Write :func:`film` as an animated GIF that plays at the speed of the simulation."""
    first, *others = film(policy, env, seconds=seconds)
    duration = 1000 * EVERY * env.control_timestep
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0)
