import mujoco
import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.inspection.pictures import contact_sheet, pictures, save_film, save_picture


def turned(yaw, *, x=0.0, frames=2, fps=1.0):
    """A humanoid with its right arm stretched forward, facing a direction."""
    model = character_model("humanoid")
    qpos = torch.from_numpy(model.qpos0).repeat(frames, 1)
    qpos[:, 0] = x
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    shoulder = model.joint("right_shoulder").qposadr[0]
    qpos[:, shoulder : shoulder + 4] = torch.tensor([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0])
    return MotionClip("humanoid", qpos, fps)


@pytest.fixture(scope="module", autouse=True)
def _drawing():
    try:
        next(pictures(turned(0.0), torch.zeros(1), size=16, follow_heading=True))
    except (RuntimeError, mujoco.FatalError) as error:
        pytest.skip(str(error))


def orange(picture):
    """Columns of the right limbs' pixels, from the middle of the picture in units of its width."""
    red, _, blue = picture.long().unbind(-1)
    return (red - blue > 60).nonzero()[:, 1] / picture.shape[1] - 0.5


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_the_character_faces_to_the_right_with_its_right_side_to_the_camera(yaw):
    [picture] = pictures(turned(yaw), torch.zeros(1), size=100, follow_heading=True)
    columns = orange(picture)
    assert len(columns) > 50
    assert columns.max() > 0.1 > -columns.min()


def test_the_camera_goes_along():
    near, far = (next(pictures(turned(0.0, x=x), torch.zeros(1), size=100, follow_heading=True)) for x in (0.0, 40.0))
    torch.testing.assert_close(orange(near).mean(), orange(far).mean(), rtol=0, atol=0.01)


def test_a_film_shows_turns():
    about_face = MotionClip("humanoid", torch.cat([turned(0.0).qpos[:1], turned(3.0).qpos[:1]]), 1.0)
    first, last = pictures(about_face, torch.tensor([0.0, 1.0]), size=100, follow_heading=False)
    assert orange(first).max() > 0.1
    assert orange(last).numel() == 0 or orange(last).min() < -0.1


def test_a_contact_sheet_has_its_pictures_in_rows(tmp_path):
    clip = MotionClip("humanoid", torch.cat([turned(0.0).qpos[:1], turned(0.0, x=5.0).qpos[:1]]), 1.0)
    sheet = contact_sheet(clip, columns=3, rows=2, size=30)
    assert sheet.shape == (60, 90, 3)
    single = list(pictures(clip, torch.linspace(0, 1, 6, dtype=torch.float64), size=30, follow_heading=True))
    assert torch.equal(sheet[30:, 30:60], single[4])
    save_picture(sheet, tmp_path / "sheet.png")
    assert torch.equal(torch.from_numpy(np.array(Image.open(tmp_path / "sheet.png"))), sheet)


def test_a_film_plays_at_the_speed_of_the_motion(tmp_path):
    save_film(turned(0.0, frames=31, fps=10.0), tmp_path / "film.gif", seconds=0.2, size=40)
    with Image.open(tmp_path / "film.gif") as film:
        durations = []
        for frame in range(film.n_frames):  # equal pictures are merged
            film.seek(frame)
            durations.append(film.info["duration"])
        assert (film.size, sum(durations), film.info["loop"]) == ((40, 40), 200, 0)
