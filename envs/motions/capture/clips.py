"""A clip of one character as the source of another's."""

from pathlib import Path

import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.motions.capture.skeleton import SourceMotion
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.rotations import inverse, multiply, rotate


def as_source(clip: MotionClip, path: str | Path) -> SourceMotion:
    """Return a clip as the motion of a skeleton, whose joints are the character's bodies.

    Args:
        clip: The clip.
        path: Its file, for errors.
    """
    model = character_model(clip.character)
    states = body_states(clip.character, clip.qpos, clip.qvel)
    rest = body_states(clip.character, torch.from_numpy(model.qpos0)[None], torch.zeros(1, model.nv).double())
    turns = multiply(states.orientations, inverse(rest.orientations).expand_as(states.orientations))
    parents = torch.from_numpy(model.body_parentid[1:]).long() - 1
    others = slice(1, None)
    carriers = parents[1:]
    back = inverse(turns[:, carriers])
    arms = rotate(back, states.positions[:, others] - states.positions[:, carriers])
    return SourceMotion(
        Path(path),
        body_names(clip.character),
        parents.tolist(),
        translations=torch.cat([states.positions[:, :1], arms], dim=1),
        rotations=torch.cat([turns[:, :1], multiply(back, turns[:, others])], dim=1),
        fps=clip.fps,
        unit=1.0,
        up="z",
    )
