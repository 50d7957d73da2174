"""Motions of SMPL's bodies (``.npz``): AMASS, SMPL, SMPL-H and SMPL-X."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.mirror import twin
from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.skeleton import AXES, SourceMotion, frame_rate
from torchrl_mcp.envs.rotations import from_rotation_vector

SKELETON = {
    "pelvis": ("", (-0.0018, -0.2233, 0.0282)),
    "left_hip": ("pelvis", (0.0695, -0.0914, -0.0068)),
    "right_hip": ("pelvis", (-0.0677, -0.0905, -0.0043)),
    "spine1": ("pelvis", (-0.0025, 0.1090, -0.0267)),
    "left_knee": ("left_hip", (0.0343, -0.3752, -0.0045)),
    "right_knee": ("right_hip", (-0.0383, -0.3826, -0.0089)),
    "spine2": ("spine1", (0.0055, 0.1352, 0.0011)),
    "left_ankle": ("left_knee", (-0.0136, -0.3980, -0.0437)),
    "right_ankle": ("right_knee", (0.0158, -0.3984, -0.0423)),
    "spine3": ("spine2", (0.0015, 0.0529, 0.0254)),
    "left_foot": ("left_ankle", (0.0264, -0.0558, 0.1193)),
    "right_foot": ("right_ankle", (-0.0254, -0.0481, 0.1233)),
    "neck": ("spine3", (-0.0028, 0.2139, -0.0429)),
    "left_collar": ("spine3", (0.0788, 0.1217, -0.0341)),
    "right_collar": ("spine3", (-0.0818, 0.1188, -0.0386)),
    "head": ("neck", (0.0052, 0.0650, 0.0513)),
    "left_shoulder": ("left_collar", (0.0910, 0.0305, -0.0089)),
    "right_shoulder": ("right_collar", (-0.0960, 0.0326, -0.0091)),
    "left_elbow": ("left_shoulder", (0.2596, -0.0128, -0.0275)),
    "right_elbow": ("right_shoulder", (-0.2537, -0.0133, -0.0214)),
    "left_wrist": ("left_elbow", (0.2492, 0.0090, -0.0012)),
    "right_wrist": ("right_elbow", (-0.2553, 0.0078, -0.0056)),
}
"""The joints that SMPL, SMPL-H and SMPL-X share, in their order: parent, and position in metres relative to it in the
neutral body of mean shape (x left, y up, z forward), as in ``smpl_humanoid.xml`` of https://github.com/ZhengyiLuo/PHC."""

NUMBERS = (66, 72, 156, 165)
"""Numbers of ``poses`` in a frame: these joints alone, SMPL, SMPL-H and SMPL-X; the first 66 are these joints."""

AMASS_RATES = ("mocap_framerate", "mocap_frame_rate")
RATES = (*AMASS_RATES, "fps", "frame_rate", "framerate")


def is_smpl(archive: Archive) -> bool:
    """Whether an archive holds a motion of SMPL's bodies."""
    return not {"poses", "pose_body"}.isdisjoint(archive.names)


def read_smpl(path: str | Path, *, body_model: str | Path | None = None, fps: float | None = None) -> SourceMotion:
    """Read ``poses``, or ``root_orient`` and ``pose_body``, and ``trans``; hands and face are left out.

    In SMPL's zero pose the body is symmetric with straight limbs, but the regressed centres of knees, ankles, elbows
    and wrists are up to seven degrees off the line. They are put on it, legs straight down and arms to the sides, with
    the lengths of the bones.

    Args:
        path: The file.
        body_model: Archive of the body (``.npz`` with ``J_regressor``, ``v_template`` and ``shapedirs``), which gives
            the joints their positions for ``betas``; None for the mean body.
        fps: Frames per second, or None for the file's own.

    Raises:
        MotionFormatError: If a file lacks an array, or an array has another shape.

    Reference:
        Loper et al., SMPL: A Skinned Multi-Person Linear Model, 2015, https://smpl.is.tue.mpg.de;
        Mahmood et al., AMASS: Archive of Motion Capture as Surface Shapes, 2019, https://amass.is.tue.mpg.de
    """
    names = list(SKELETON)
    parents = [names.index(parent) if parent else -1 for parent, _ in SKELETON.values()]
    archive = Archive(path)
    vectors = _vectors(archive)
    root = archive.numbers("trans", 3)
    if len(root) != len(vectors):
        raise archive.error(f"has {len(vectors)} poses and {len(root)} positions in trans: both numbers must be equal")
    _require_radians(archive, vectors)
    rate = frame_rate(fps, archive.number(*RATES))
    if rate is None:
        raise archive.error(f"has no frame rate ({', '.join(RATES)}): pass it (--fps)")
    if body_model is None:
        offsets = torch.tensor([offset for _, offset in SKELETON.values()], dtype=torch.float64)
    else:
        offsets = _shaped(Archive(body_model), archive.numbers("betas"), parents)
    translations = _idealised(offsets).repeat(len(root), 1, 1)
    translations[:, 0] += root
    return SourceMotion(
        path=archive.path,
        names=names,
        parents=parents,
        translations=translations,
        rotations=from_rotation_vector(vectors.view(len(root), len(names), 3)),
        fps=rate,
        unit=1.0,
        up="y" if {*AMASS_RATES}.isdisjoint(archive.names) else "z",
    )


def _vectors(archive: Archive) -> Tensor:
    """Rotation vectors of the joints, one after the other, shape ``(T, 66)``."""
    if "poses" not in archive.names:
        root = archive.numbers("root_orient", 3)
        body = archive.numbers("pose_body", 63)
        if len(root) != len(body):
            raise archive.error(
                f"has {len(root)} rotations in root_orient and {len(body)} in pose_body: both numbers must be equal"
            )
        return torch.cat([root, body], dim=-1)
    poses = archive.numbers("poses")
    poses = poses.flatten(1) if poses.ndim > 1 else poses
    if poses.ndim != 2 or poses.shape[1] not in NUMBERS or len(poses) < 2:
        known = ", ".join(map(str, NUMBERS))
        raise archive.error(f"poses has shape {tuple(poses.shape)}, but should have (T, N), T >= 2, N one of {known}")
    return poses[:, : NUMBERS[0]]


def _require_radians(archive: Archive, vectors: Tensor) -> None:
    """Check that no joint turns by more than a whole turn; the root may, if its turns are counted."""
    largest = float(vectors[:, 3:].unflatten(-1, (-1, 3)).norm(dim=-1).max())
    if largest > 2 * math.pi:
        name = "poses" if "poses" in archive.names else "pose_body"
        raise archive.error(
            f"{name} turns a joint by {largest:.4g} radians, more than a whole turn, and seems to be in degrees: "
            "convert all rotations with numpy.radians"
        )


def _shaped(model: Archive, betas: Tensor, parents: Sequence[int]) -> Tensor:
    r"""Offsets of the joints of a shape, :math:`J (\bar T + \sum_n \beta_n S_n)`, shape ``(22, 3)``."""
    template, shapes, regressor = (model.numbers(name) for name in ("v_template", "shapedirs", "J_regressor"))
    if shapes.ndim != 3 or template.shape != shapes.shape[:2] or regressor.shape[-1] != len(template):
        raise model.error("v_template, shapedirs and J_regressor do not fit together: pass a body model of SMPL")
    used = betas.flatten()[: shapes.shape[-1]]
    positions = regressor[: len(parents)] @ (template + shapes[..., : len(used)] @ used)
    return torch.stack(
        [positions[joint] - (positions[parent] if parent >= 0 else 0) for joint, parent in enumerate(parents)]
    )


def _idealised(offsets: Tensor) -> Tensor:
    """Make the skeleton symmetric, and put the bones of limbs straight down or to the sides, shape ``(22, 3)``."""
    twins = [list(SKELETON).index(twin(name)) for name in SKELETON]
    offsets = (offsets + offsets[twins] * offsets.new_tensor([-1.0, 1.0, 1.0])) / 2
    for index, name in enumerate(SKELETON):
        side, _, joint = name.partition("_")
        if joint in ("knee", "ankle"):
            offsets[index] = offsets[index].norm() * -AXES[1]
        elif joint in ("elbow", "wrist"):
            offsets[index] = offsets[index].norm() * (AXES[0] if side == "left" else -AXES[0])
    return offsets
