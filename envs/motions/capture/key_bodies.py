"""The bodies of any character that correspond to parts of a human body."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml  # type: ignore[import-untyped]

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.mirror import Sides
from torchrl_mcp.envs.motions.capture.anatomy import ARM, HEAD_AND_ARMS, LEG, LEGS, NAMES, SIDES, TRUNK, limb

PARTS = (*TRUNK, *LEGS, *HEAD_AND_ARMS)

CENTRAL = {"chest": ("chest", "torso", "thorax"), "neck": ("head", "neck")}
"""Words in the names of central bodies, the likeliest first."""


def key_map(character: str, given: Mapping[str, str] | None = None) -> dict[str, str]:
    """Find the bodies of a character that follow parts of a human body.

    The root is the character's root, and ankles are its feet if there are two. The others are found by words in their
    names: thighs, upper arms and forearms are the first that match from the trunk outwards.

    Args:
        character: Name of the character.
        given: Bodies by part, for parts that are not found, or found wrongly; see
            :func:`~torchrl_mcp.envs.motions.capture.anatomy.find_joints` for the names of the parts.

    Returns:
        Names of bodies by part, of root, legs and what else was found.

    Raises:
        ValueError: If the map has an unknown part or body, or no body is known for a part of the legs.
    """
    model = character_model(character)
    given = dict(given or {})
    bodies = [model.body(index).name for index in range(1, model.nbody)]
    if wrong := sorted(given.keys() - set(PARTS)):
        raise ValueError(f"the map of bodies has {', '.join(wrong)}: the parts are {', '.join(PARTS)}")
    if absent := [body for body in given.values() if body not in bodies]:
        raise ValueError(f"{character} has no body {', '.join(absent)}: its bodies are {', '.join(bodies)}")
    bodies_by_part = {"root": bodies[0], **_central(bodies), **_limbs(bodies, CHARACTERS[character].sides)}
    bodies_by_part |= _feet(character)
    bodies_by_part |= given
    if missing := [part for part in LEGS if part not in bodies_by_part]:
        raise ValueError(
            f"{character} has no body that is known as {', '.join(missing)}: write a file with lines such as "
            f"'{missing[0]}: BODY' (--bodies FILE.yaml); its bodies are {', '.join(bodies)}"
        )
    return {part: bodies_by_part[part] for part in PARTS if part in bodies_by_part}


def read_key_map(path: str | Path) -> dict[str, str]:
    """Read a map of bodies by part from a YAML file.

    Raises:
        ValueError: If the file is no such map.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must be YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict) or not all(isinstance(word, str) for pair in content.items() for word in pair):
        raise ValueError(f"{path} must have lines of the form 'PART: BODY', such as 'left_knee: left_knee_link'")
    return content


def _central(bodies: list[str]) -> dict[str, str]:
    """Find chest and head."""
    parts = {}
    for part, words in CENTRAL.items():
        named = [body for word in words for body in bodies[1:] if word in _plain(body)]
        if named:
            parts[part] = named[0]
    return parts


def _limbs(bodies: list[str], sides: Sides) -> dict[str, str]:
    """Find the bodies of legs and arms by side."""
    found: dict[str, str] = {}
    for index, side in enumerate(SIDES):
        affixes = [pair[index] for pair in sides]
        own = {
            body: _plain(body.removeprefix(affix).removesuffix(affix))
            for affix in affixes
            for body in bodies
            if body.startswith(affix) or body.endswith(affix)
        }
        for joints in (LEG, ARM):
            for place, (part, kind) in enumerate(zip(limb(side, joints), joints, strict=True), start=1):
                outer = [word for other in joints[place:] for word in NAMES[other]]
                free = [body for body in own if body not in found.values()]
                named = [body for word in NAMES[kind] for body in free if _has(own[body], word, outer)]
                if named:
                    found[part] = named[0]
    return found


def _has(name: str, word: str, outer: Sequence[str]) -> bool:
    """Whether a name has a word, but not inside a word for an outer part, as arm is inside forearm."""
    return word in name and not any(word in longer and longer in name for longer in outer)


def _feet(character: str) -> dict[str, str]:
    """The feet of a character with one on each side."""
    sides = CHARACTERS[character].sides
    feet = CHARACTERS[character].feet
    nearest = {}
    for index, side in enumerate(SIDES):
        affixes = tuple(pair[index] for pair in sides)
        candidates = [foot for foot in feet if foot.startswith(affixes) or foot.endswith(affixes)]
        if len(candidates) != 1:
            return {}
        nearest[f"{side}_ankle"] = candidates[0]
    return nearest


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
