import math
import sys

import numpy as np
import pytest
import torch
from PIL import Image, ImageColor
from tensordict.nn import TensorDictModule

from torchrl_mcp.analysis.figures import COLOURS
from torchrl_mcp.envs import Heading
from torchrl_mcp.viewer.film import LAG, followed, save_film

IDLE = TensorDictModule(lambda goal: torch.zeros(len(goal), 17), in_keys=["goal"], out_keys=["action"])
GATED = TensorDictModule(
    lambda goal: (torch.zeros(len(goal), 17), torch.tensor([[1.0, 0.5]])),
    in_keys=["goal"],
    out_keys=["action", "gates"],
)


def heading():
    return Heading("biped", num_envs=1, seed=0, num_threads=1)


def save(policy, path, **kwargs):
    """Write a film, where one can be drawn."""
    try:
        save_film(policy, heading(), path, **kwargs)
    except RuntimeError as error:
        pytest.skip(str(error))


def test_a_film_lasts_as_long_as_the_motion_and_moves(tmp_path):
    path = tmp_path / "film.gif"
    save(IDLE, path, seconds=0.8)
    with Image.open(path) as gif:
        assert gif.n_frames == 12  # 24 control steps
        assert gif.size == (320, 240)
        durations, pictures = [], []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            durations.append(gif.info["duration"])
            pictures.append(torch.frombuffer(bytearray(gif.convert("L").tobytes()), dtype=torch.uint8).float())
    assert math.isclose(sum(durations), 800, abs_tol=10)  # a GIF counts in hundredths of a second
    assert (pictures[0] - pictures[-1]).abs().mean() > 0.1


def test_an_mp4_has_every_control_step_and_the_size_asked_for(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    path = tmp_path / "film.mp4"
    save(IDLE, path, seconds=0.3, width=162, height=118)
    frames = ffmpeg.read_frames(str(path))
    facts = next(frames)
    assert facts["size"] == (162, 118)
    assert facts["fps"] == pytest.approx(30, rel=1e-3)
    assert facts["codec"] == "h264"
    pictures = [np.frombuffer(frame, np.uint8).astype(int) for frame in frames]
    assert len(pictures) == 9
    assert np.abs(pictures[0] - pictures[-1]).mean() > 0.1


def test_the_gates_of_a_policy_are_bars_in_its_film(tmp_path):
    save(GATED, tmp_path / "film.gif", seconds=0.1)
    with Image.open(tmp_path / "film.gif") as gif:
        corner = np.asarray(gif.convert("RGB")).astype(int)[:120, :120]
    # A GIF has few colours: those of the bars are met approximately.
    full, half = ((np.abs(corner - ImageColor.getrgb(colour)).max(-1) < 40).any(0).sum() for colour in COLOURS[:2])
    assert full > 50
    assert half == pytest.approx(full / 2, abs=2)


def test_the_camera_follows_at_a_distance_that_does_not_depend_on_how_often_it_is_moved():
    speed, behind = np.array([2.0, -1.0, 0.0]), []
    for steps in (30, 3000):
        place, seconds = np.zeros(3), 3.0 / steps
        for step in range(steps):
            place = followed(place, (step + 0.5) * seconds * speed, seconds)
        behind.append(3.0 * speed - place)
    np.testing.assert_allclose(behind[1], LAG * speed, rtol=1e-3)
    np.testing.assert_allclose(behind[0], behind[1], rtol=0.02)


def test_the_camera_comes_to_rest_at_a_target_that_stays():
    place = np.zeros(3)
    for _ in range(300):
        place = followed(place, np.array([1.0, 2.0, 3.0]), 1 / 30)
    np.testing.assert_allclose(place, [1.0, 2.0, 3.0])


def test_without_what_writes_mp4_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=r"torchrl-mcp\[video\]"):
        save_film(IDLE, heading(), tmp_path / "film.mp4", seconds=0.1)


def test_a_film_of_another_kind_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"film\.avi must be the name of a film: end it with \.gif or \.mp4"):
        save_film(IDLE, heading(), tmp_path / "film.avi")


@pytest.mark.parametrize(("argument", "value"), [("seconds", 0.01), ("width", 0), ("height", -3), ("width", 20_000)])
def test_a_film_of_nothing_or_too_large_to_draw_is_refused_by_the_argument(tmp_path, argument, value):
    with pytest.raises(ValueError, match=f"{argument}={value}"):
        save_film(IDLE, heading(), tmp_path / "film.gif", **{argument: value})
