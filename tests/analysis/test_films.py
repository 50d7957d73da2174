import math

import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule

from torchrl_mcp.analysis.films import save_film
from torchrl_mcp.envs import Heading

IDLE = TensorDictModule(lambda goal: torch.zeros(len(goal), 17), in_keys=["goal"], out_keys=["action"])


def test_a_film_lasts_as_long_as_the_motion_and_moves(tmp_path):
    path = tmp_path / "film.gif"
    try:
        save_film(IDLE, Heading("biped", num_envs=1, seed=0), path, seconds=0.8)
    except RuntimeError as error:
        pytest.skip(str(error))
    with Image.open(path) as gif:
        assert gif.n_frames == 12  # 24 control steps
        assert gif.size == (320, 240)
        durations, pictures = [], []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            durations.append(gif.info["duration"])
            pictures.append(torch.frombuffer(bytearray(gif.convert("L").tobytes()), dtype=torch.uint8).float())
    assert math.isclose(sum(durations), 800, rel_tol=0.15)  # a GIF counts in hundredths of a second
    assert (pictures[0] - pictures[-1]).abs().mean() > 0.1
