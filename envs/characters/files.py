"""Reading bodies from MJCF and URDF files."""

from collections.abc import Callable
from pathlib import Path

import mujoco


def read_body(path: Path, *, floating: bool = False, trunk: str | None = None) -> mujoco.MjSpec:
    """Read an MJCF or URDF file.

    Args:
        path: The file.
        floating: Give the trunk a free joint, see :func:`float_trunk`.
        trunk: The trunk, or None for the body on the world with the most bodies.

    Raises:
        ValueError: If MuJoCo cannot read or compile the file, or the trunk cannot float.
    """
    return _compilable(mujoco.MjSpec.from_file, str(path), path, floating=floating, trunk=trunk)


def parse_body(text: str, source: str) -> mujoco.MjSpec:
    """Read a body from the text of an MJCF file; an error names its ``source``.

    Raises:
        ValueError: If MuJoCo cannot read or compile the text.
    """
    return _compilable(mujoco.MjSpec.from_string, text, source)


def _compilable(
    read: Callable[[str], mujoco.MjSpec], content: str, source: object, floating: bool = False, trunk: str | None = None
) -> mujoco.MjSpec:
    try:
        spec = read(content)
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {source}: {error}") from error
    if floating:
        float_trunk(spec, trunk)
    try:
        spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {source}: {error}") from error
    return spec


def float_trunk(spec: mujoco.MjSpec, name: str | None = None) -> None:
    """Give the trunk of a file a free joint, so that MuJoCo does not merge it into the world.

    Args:
        spec: The file, not compiled.
        name: The trunk, or None for the body on the world with the most bodies.

    Raises:
        ValueError: If no such body hangs on the world, or it has joints.
    """
    candidates = {body.name: body for body in spec.worldbody.bodies}
    if not candidates:
        raise ValueError("--floating needs a body, but the file has none: pass a file with bodies")
    if name is None:
        name = max(candidates, key=lambda candidate: len(candidates[candidate].find_all("body")))
    if name not in candidates:
        raise ValueError(
            f"--floating: {name} must be attached to the world: pass one of {', '.join(candidates)} (--root)"
        )
    if candidates[name].joints:
        raise ValueError(f"--floating: {name} already has a joint: leave the option out, or pass another --root")
    candidates[name].add_freejoint()
