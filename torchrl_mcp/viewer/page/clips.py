"""Writes reference motions as arrays, which the page plays."""

from itertools import islice
from pathlib import Path
from typing import Any

import torch

from torchrl_mcp.envs import Imitation
from torchrl_mcp.envs.tasks.imitation import NUM_TARGETS
from torchrl_mcp.training.run_folder import replacing

MOST = 16
"""Largest number of clips on a page."""

SECONDS = 10.0
"""Longest part of a clip on a page, which is as long as an episode of imitation."""


def write_clips(env: Imitation, folder: Path, prefix: str) -> list[dict[str, Any]]:
    """Write the first clips of an environment, and return the name of each clip and its description for JavaScript.

    A file contains float32 numbers, ``(T, L, 13)``: at each of T control steps, position, orientation, linear and
    angular velocity of the character's L bodies in the world.

    Args:
        env: The environment.
        folder: The folder to write.
        prefix: Prefix of the names of the files.
    """
    library = env.library
    described = []
    for index, name in enumerate(islice(library.names, MOST)):
        loops = bool(library.loops[index])
        duration = float(library.durations[index])
        num_steps = round((SECONDS if loops else min(SECONDS, duration)) / env.control_timestep) + NUM_TARGETS
        times = env.control_timestep * torch.arange(num_steps, dtype=torch.float64)
        motion = library.at(torch.full((num_steps,), index), times)
        rows = torch.cat(list(motion.bodies), dim=-1)
        file = f"{prefix}-{index}.bin"
        with replacing(folder / file) as partial:
            partial.write_bytes(rows.float().numpy().tobytes())
        start = {"qpos": motion.qpos[0].tolist(), "qvel": motion.qvel[0].tolist()}
        described.append({"name": name.replace("_", " "), "clip": {"file": file, "num_bodies": rows.shape[1], **start}})
    return described
