"""Recognising the joints of a skeleton, whose names differ between makers."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile

from torchrl_mcp.envs.motions.capture.skeleton import SourceMotion
from torchrl_mcp.envs.motions.errors import MotionFormatError

SIDES = ("right", "left")

LEG = ("hip", "knee", "ankle")
ARM = ("shoulder", "elbow", "wrist")
"""Joints of a limb, from the trunk outwards."""

# Names in BVH exporters, CMU, SMPL, game engines and animation programs, the less ambiguous names first:
# LeftShoulder is a collar bone if there is a LeftArm, and LeftHip the side of a pelvis if there is a LeftUpLeg.
NAMES = {
    "hip": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "knee": ("knee", "lowleg", "lowerleg", "shin", "calf", "tibia", "leg"),
    "ankle": ("ankle", "foot"),
    "shoulder": ("uparm", "upperarm", "humerus", "shldr", "arm", "shoulder"),
    "elbow": ("elbow", "forearm", "lowarm", "lowerarm", "radius"),
    "wrist": ("hand", "wrist"),
}
HEADS = ("head", "torsohead", "upperneck", "neck1", "neck")


def limb(side: str, joints: tuple[str, str, str]) -> tuple[str, str, str]:
    """Return the names of the parts of one limb, from the trunk outwards."""
    first, middle, last = joints
    return f"{side}_{first}", f"{side}_{middle}", f"{side}_{last}"


def bones(joints: tuple[str, str, str]) -> Iterator[tuple[str, str]]:
    """Yield the names of both ends of all bones of the legs or of the arms."""
    for side in SIDES:
        first, middle, last = limb(side, joints)
        yield first, middle
        yield middle, last


TRUNK = ("root", "chest")
LEGS = tuple(part for side in SIDES for part in limb(side, LEG))
HEAD_AND_ARMS = ("neck", *(part for side in SIDES for part in limb(side, ARM)))
"""Parts of a body by the names of the humanoid's bodies; each begins at its joint to the parent."""


def find_joints(
    source: SourceMotion, parts: Sequence[str], joint_map: Mapping[str, str] | None = None
) -> dict[str, int]:
    """Find the joints at which parts of the body begin.

    The root is the common ancestor of the legs, the chest of the arms; the others are found by name.

    Args:
        source: The motion with its skeleton.
        parts: Names of bodies of the humanoid: ``root``, ``chest``, ``neck`` (the head), ``left_hip``, ...
        joint_map: Names of joints by part, for parts that are not found, or found wrongly.

    Returns:
        Index of a joint for each part.

    Raises:
        MotionFormatError: If the skeleton lacks a joint of the map, a joint is not found, or a limb or the head is
            found on the root.
        ValueError: If the map has an unknown part.
    """
    given = joint_map or {}
    known = (*TRUNK, *LEGS, *HEAD_AND_ARMS)
    if wrong := sorted(given.keys() - set(known)):
        raise ValueError(f"joint_map has {', '.join(wrong)}: the parts of the body are {', '.join(known)}")
    if absent := [name for name in given.values() if name not in source.names]:
        raise MotionFormatError(source.path, f"has no joint {absent[0]!r}: its joints are {', '.join(source.names)}")
    plain = _plain(source.names)
    joints = {
        part: plain.index(spellings[0])
        for part in (*LEGS, *HEAD_AND_ARMS)
        if (spellings := [name for name in _spellings(part) if name in plain])
    }
    joints |= {part: source.names.index(name) for part, name in given.items()}
    for part, first in (("root", "hip"), ("chest", "shoulder")):
        ends = [joints[f"{side}_{first}"] for side in SIDES if f"{side}_{first}" in joints]
        if part not in joints and len(ends) == 2:
            joints[part] = next(joint for joint in source.ancestors(ends[0]) if joint in source.ancestors(ends[1]))
    if missing := [part for part in parts if part not in joints]:
        raise MotionFormatError(
            source.path,
            f"has no joint that is known as {', '.join(missing)}: name it with a map, such as "
            f"{missing[0]}={_suggestion(missing[0], source)}; its joints are {', '.join(source.names)}",
        )
    trunk = source.ancestors(joints["root"])
    if wrong := [part for part in parts if part not in TRUNK and joints[part] in trunk]:
        raise MotionFormatError(
            source.path,
            f"has its {wrong[0]} on {source.names[joints[wrong[0]]]}, which carries the whole body: name with a map "
            f"the right joint; its joints are {', '.join(source.names)}",
        )
    return {part: joints[part] for part in parts}


def _suggestion(part: str, source: SourceMotion) -> str:
    """Return a joint that may be the part, as an example for the user; JOINT if no name fits."""
    joints = [
        name
        for name, parent in zip(source.names, source.parents, strict=True)
        if parent < 0 or name != f"{source.names[parent]}_end"
    ]
    heads = [name for name in joints if part == "neck" and re.search("head|neck", name.lower())]
    return heads[-1] if heads else "JOINT"


def _plain(names: Sequence[str]) -> list[str]:
    """Names in lower case without their common prefix: ``mixamorig:LeftUpLeg`` becomes ``leftupleg``."""
    shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(min(names), max(names), strict=False)))
    return [re.sub(r"[^a-z0-9]", "", name[shared:].rpartition(":")[2].lower()) for name in names]


def _spellings(part: str) -> Iterator[str]:
    """Yield possible spellings of a part, the likeliest first."""
    if part == "neck":
        for head in HEADS:
            yield from (head, f"c{head}")  # VRM: J_Bip_C_Head
        return
    side, joint = part.split("_")
    for word in NAMES[joint]:
        yield from (f"{side}{word}", f"{side[0]}{word}", f"{word}{side}", f"{word}{side[0]}")
