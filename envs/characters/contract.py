"""Checks of the contract of a :class:`~torchrl_mcp.envs.characters.Character`, with remedies."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np

from torchrl_mcp.envs.characters.mirror import APART, SIDES, Sides, twin, without_mirror_image, without_twin
from torchrl_mcp.envs.characters.stance import collapse

SOLE = 0.005
"""Largest distance in metres of the lowest point from the ground."""

CONTROL_TIMESTEP = 1 / 30
"""Seconds per action."""

FREE, BALL, HINGE = (
    int(kind) for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE)
)
LIMB_HEIGHT = 0.1
"""Largest height of the lowest point of a leg above that of the rest pose, in heights of the root above that point."""

FOOT_HEIGHT = 0.03
"""Largest height of a foot above the lowest point of its leg, in the same unit."""

LIMB_FEET = 2
"""Largest number of feet on a line of bodies, such as heel and toes."""

SHAPES = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)


NAME_SIDES = "pass how names begin or end on each side, such as --sides FR_:FL_ RR_:RL_, or rename bodies"


class Violation(NamedTuple):
    """A violation of the contract.

    Args:
        finding: Description of the violation.
        remedy: Instruction for the user.
    """

    finding: str
    remedy: str

    def __str__(self) -> str:
        """Return both in one line."""
        return f"{self.finding}: {self.remedy}"


def violations(
    spec: mujoco.MjSpec,
    *,
    feet: Sequence[str],
    key_bodies: Sequence[str] = (),
    carrier: str | None = None,
    sides: Sides = SIDES,
) -> list[Violation]:
    """Return the violations of a body; empty if it is a character.

    A body with no other violation has to hold its rest pose for two seconds.

    Args:
        spec: The body alone.
        feet: Bodies that may touch the ground.
        key_bodies: Bodies whose positions best describe a pose.
        carrier: Body that can carry a box, or None.
        sides: Beginnings or ends of bodies' names, right and left.
    """
    model = spec.compile()
    if model.nbody == 1:
        return [Violation("has no body", "give it a root with a free joint, and links that the root carries")]
    named = {"feet": feet, "key_bodies": key_bodies, "carrier": [carrier] if carrier else []}
    faults = [
        *_scenery(model),
        *_defaults(spec),
        *_root(model),
        *_joints(model),
        *_actuators(model, sides),
        *_shapes(model),
        *_rest(model),
        *_names(model, named, sides),
        *_symmetry(model, sides),
        *_facing(model, sides),
        *_timestep(model),
    ]
    if not faults and (failure := collapse(spec, tuple(feet))):
        remedy = "give it larger torques and gains, another pose, or feet on which it can stand"
        return [Violation(f"does not hold its rest pose: {failure}", remedy)]
    return faults


def lowest_points(model: mujoco.MjModel) -> dict[str, float]:
    """Return the height of the lowest point of each body that collides, in the rest pose, in metres."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    heights: dict[str, float] = {}
    for geom in colliding(model):
        name = model.body(model.geom_bodyid[geom]).name
        heights[name] = min(_lowest(model, data, geom), heights.get(name, math.inf))
    return heights


def lowest_bodies(model: mujoco.MjModel) -> tuple[float, list[str]]:
    """Return the height of the lowest point in the rest pose, in metres, and the bodies close to it.

    A body is close if its height above the lowest point is at most :data:`FOOT_HEIGHT` times that of the root.
    """
    heights = lowest_points(model)
    if not heights:
        return 0.0, []
    lowest = min(heights.values())
    highest = lowest + FOOT_HEIGHT * _root_height(model, lowest)
    return lowest, [name for name, height in heights.items() if height <= highest]


def guessed_feet(model: mujoco.MjModel, sides: Sides = ()) -> list[str]:
    """Return the bodies that are probably feet: the lowest of each leg, at its end.

    A leg is a line of bodies that comes close to the ground in the rest pose, see :data:`LIMB_HEIGHT`. Its feet are
    the outermost :data:`LIMB_FEET` of its lowest bodies, see :data:`FOOT_HEIGHT`. If some feet have a twin on the other
    side, the others, such as a tail, are not feet.

    Args:
        model: The body.
        sides: Beginnings or ends of bodies' names, right and left.
    """
    heights = lowest_points(model)
    lowest = min(heights.values(), default=0.0)
    unit = _root_height(model, lowest)
    lines = {
        name: [model.body(body).name for body in line_of(model, model.body(name).id)]
        for name, height in heights.items()
        if height <= lowest + LIMB_HEIGHT * unit
    }
    inner = {name for line in lines.values() for name in line[1:]}
    ends: set[str] = set()
    for line in (line for name, line in lines.items() if name not in inner):
        leg = [name for name in line if name in lines]
        highest = min(heights[name] for name in leg) + FOOT_HEIGHT * unit
        ends |= {*[name for name in leg if heights[name] <= highest][:LIMB_FEET]}
    feet = [name for name in heights if name in ends]
    return [name for name in feet if twin(name, sides) != name and twin(name, sides) in feet] or feet


def colliding(model: mujoco.MjModel) -> list[int]:
    """Return the shapes of moving bodies that can collide."""
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    return np.flatnonzero(collides & (model.geom_bodyid > 0)).tolist()


def colliding_bodies(model: mujoco.MjModel) -> set[str]:
    """Return the moving bodies with shapes that can collide."""
    return {model.body(model.geom_bodyid[geom]).name for geom in colliding(model)}


def joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the joints of a body."""
    first = model.body_jntadr[body]
    return list(range(first, first + model.body_jntnum[body]))


def line_of(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and those on which it hangs, up to the world."""
    line = [body]
    while line[-1]:
        line.append(int(model.body_parentid[line[-1]]))
    return line


def kinds_of(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the kinds of the joints of a body."""
    return [int(model.jnt_type[joint]) for joint in joints_of(model, body)]


def _scenery(model: mujoco.MjModel) -> Iterator[Violation]:
    if fixed := [model.geom(geom).name or "unnamed" for geom in np.flatnonzero(model.geom_bodyid == 0)]:
        yield Violation(
            f"contains a floor or other scenery ({', '.join(fixed)})", "remove it, because tasks add a floor"
        )
    if model.nlight:
        yield Violation(f"contains {model.nlight} light(s)", "remove them, because tasks add lights")


def _defaults(spec: mujoco.MjSpec) -> Iterator[Violation]:
    if fixed := [
        part.tag for part in ElementTree.fromstring(spec.to_xml()).findall("default/*") if part.tag != "default"
    ]:
        yield Violation(
            f"has defaults of {', '.join(fixed)} outside a class, which also change the scenes of tasks",
            "put them into a named class, the childclass of the root",
        )


def _root(model: mujoco.MjModel) -> Iterator[Violation]:
    roots = np.flatnonzero(model.body_parentid[1:] == 0) + 1
    if len(roots) != 1:
        yield Violation(f"has {len(roots)} bodies that are attached to the world", "let one root carry all others")
    if kinds_of(model, 1) != [FREE]:
        yield Violation(f"the root {model.body(1).name} must have a free joint and no other", "give it one freejoint")


def _joints(model: mujoco.MjModel) -> Iterator[Violation]:
    for body in range(2, model.nbody):
        name = model.body(body).name
        joints = joints_of(model, body)
        kinds = kinds_of(model, body)
        if not name:
            parent = model.body(model.body_parentid[body]).name
            yield Violation(f"body {body}, on {parent or model.body_parentid[body]}, has no name", "name it")
            continue
        if len(joints) > 1 and all(kind == HINGE for kind in kinds):
            names = ", ".join(model.joint(joint).name for joint in joints)
            yield Violation(f"{name} has several hinges ({names}), but may have one joint", "make them a ball joint")
        elif len(joints) > 1 or any(kind not in (BALL, HINGE) for kind in kinds):
            yield Violation(
                f"{name} has joints that are neither a hinge nor a ball", "give it one of these, or weld it"
            )
        elif joints and model.joint(joints[0]).name != name:
            yield Violation(f"the joint of {name} is called {model.joint(joints[0]).name}", f"call it {name}")
        if any(kind == HINGE and not _holds_rest(model, joint) for joint, kind in zip(joints, kinds, strict=True)):
            yield Violation(
                f"{name} rests beyond the limits of its joint", "widen the range until it has the rest pose"
            )


def _holds_rest(model: mujoco.MjModel, hinge: int) -> bool:
    """Whether the rest pose is within the limits of a hinge."""
    low, high = model.jnt_range[hinge]
    return not model.jnt_limited[hinge] or bool(low <= model.qpos0[model.jnt_qposadr[hinge]] <= high)


def passive_bodies(model: mujoco.MjModel) -> list[str]:
    """Return the bodies whose joints have no actuator."""
    driven = set(model.actuator_trnid[:, 0].tolist())
    jointed = [body for body in range(2, model.nbody) if joints_of(model, body)]
    return [model.body(body).name for body in jointed if driven.isdisjoint(joints_of(model, body))]


def _actuators(model: mujoco.MjModel, sides: Sides) -> Iterator[Violation]:
    expected = [name for body in range(2, model.nbody) for name in _controls(model, body)]
    there = [model.actuator(index).name for index in range(model.nu)]
    passive = passive_bodies(model)
    same_on_both_sides = {body for body in passive if body and model.nu and twin(body, sides) in passive}
    spared = {name for body in same_on_both_sides for name in _controls(model, model.body(body).id)}
    if missing := [name for name in expected if name not in there and name not in spared]:
        yield Violation(
            f"lacks the actuators {', '.join(missing)}",
            "give each hinge one of its name, a ball _x, _y, _z; only joints of both sides, or of the middle, may be "
            "passive",
        )
    if spare := [name or "unnamed" for name in there if name not in expected]:
        yield Violation(
            f"has actuators of other names ({', '.join(spare)})", "name them after their bodies, or remove them"
        )
    servo = model.actuator_biasprm[:, 1] == -model.actuator_gainprm[:, 0]
    servo &= (model.actuator_gainprm[:, 0] > 0) & (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
    if torques := [model.actuator(index).name for index in np.flatnonzero(~servo)]:
        finding = f"{len(torques)} actuators are not position servos ({', '.join(torques)})"
        yield Violation(finding, "make them <position>, because others would take targets for torques")
    if free := [model.actuator(index).name for index in np.flatnonzero(model.actuator_ctrllimited == 0)]:
        yield Violation(
            f"actuators have no ctrlrange ({', '.join(free)})", "give them one, because actions are scaled to it"
        )


def _controls(model: mujoco.MjModel, body: int) -> list[str]:
    """Names of the required actuators of a body."""
    name = model.body(body).name
    kinds = kinds_of(model, body)
    if not kinds:
        return []
    several = BALL in kinds or len(kinds) > 1
    return [f"{name}_{axis}" for axis in "xyz"] if several else [name]


def _shapes(model: mujoco.MjModel) -> Iterator[Violation]:
    geoms = colliding(model)
    other = {mujoco.mjtGeom(model.geom_type[geom]).name for geom in geoms} - {shape.name for shape in SHAPES}
    if other:
        yield Violation(f"collides with shapes of kind {', '.join(sorted(other))}", "use spheres, capsules and boxes")
    if any((model.geom_contype[geom], model.geom_conaffinity[geom]) != (0, 1) for geom in geoms):
        yield Violation("its shapes collide with one another", 'give them contype="0" conaffinity="1"')


def _rest(model: mujoco.MjModel) -> Iterator[Violation]:
    lowest, _ = lowest_bodies(model)
    if abs(lowest) > SOLE:
        yield Violation(
            f"rests {lowest:+.3f} m above the ground",
            f"{'lower' if lowest > 0 else 'raise'} the root by {abs(lowest):.3f} m: soles are on z = 0",
        )


def _names(model: mujoco.MjModel, named: dict[str, Sequence[str]], sides: Sides) -> Iterator[Violation]:
    bodies = [model.body(body).name for body in range(1, model.nbody)]
    if not named["feet"]:
        yield Violation("no feet are named", f"name the bodies that may touch the ground, of {', '.join(bodies)}")
    for kind, names in named.items():
        if unknown := [name for name in names if name not in bodies]:
            yield Violation(
                f"{kind} names {', '.join(unknown)}, which the file lacks", f"name some of {', '.join(bodies)}"
            )
    pairs = " ".join(f"{right}:{left}" for right, left in sides)
    sided = [name for name in bodies if name and twin(name, sides) != name]
    if alone := [name for name in sided if twin(name, sides) not in bodies]:
        yield Violation(f"{', '.join(alone)} has no twin on the other side ({pairs})", NAME_SIDES)
    elif not sided:
        yield Violation(f"no name of a body begins or ends with a side ({pairs or 'none are known'})", NAME_SIDES)
    elif unlike := list(without_twin(model, sides)):
        yield Violation(f"the twin of {', '.join(unlike)} has other joints", "give both sides the same joints")
    touching = colliding_bodies(model)
    if bare := [name for name in named["feet"] if name in bodies and name not in touching]:
        yield Violation(f"the feet {', '.join(bare)} have no shape that collides", "draw one, or name other feet")


def _symmetry(model: mujoco.MjModel, sides: Sides) -> Iterator[Violation]:
    names = [model.body(body).name for body in range(1, model.nbody)]
    if all(twin(name, sides) == name for name in names):
        return  # a violation of the names
    if crooked := list(without_mirror_image(model, sides)):
        yield Violation(
            f"the frames of {', '.join(crooked)} must mirror the frames on the other side in the rest pose",
            "turn them, with x forward and y to the left, or name all sides (--sides): mirrored motions would be wrong",
        )


def _facing(model: mujoco.MjModel, sides: Sides) -> Iterator[Violation]:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    places = {model.body(body).name: float(data.xipos[body, 1]) for body in range(1, model.nbody)}
    for right, left in sides:
        on_right = [name for name in places if name.startswith(right) or name.endswith(right)]
        if sum(places[name] - places.get(twin(name, sides), places[name]) for name in on_right) > APART:
            remedy = f"turn the root, with x forward and y to the left, or exchange the sides ({left}:{right})"
            yield Violation(f"{', '.join(on_right)} belong to the right side, but are on the left", remedy)


def _timestep(model: mujoco.MjModel) -> Iterator[Violation]:
    steps = CONTROL_TIMESTEP / model.opt.timestep
    if not math.isclose(steps, round(steps), rel_tol=1e-6):
        yield Violation(f"its timestep of {model.opt.timestep:g} s does not divide 1/30 s", "take 1/120 s, for example")


def _root_height(model: mujoco.MjModel, lowest: float) -> float:
    """Height of the root above the lowest point in the rest pose, in metres."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return max(float(data.xpos[1, 2]) - lowest, 0.0)


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Height of the lowest point of a sphere, capsule or box, or of the bounding box of any other shape."""
    height = data.geom_xpos[geom, 2]
    vertical = abs(data.geom_xmat[geom, 6:])
    size = model.geom_size[geom]
    match int(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return float(height - size[0])
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return float(height - size[0] - vertical[2] * size[1])
        case _:
            centre = model.geom_aabb[geom, :3]
            half_sizes = model.geom_aabb[geom, 3:]
            return float(height + data.geom_xmat[geom, 6:] @ centre - vertical @ half_sizes)
