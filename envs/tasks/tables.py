"""The scene of carrying: two tables, a box, and a joint between the box and the body that carries it."""

import mujoco

MASS = 5.0
"""Mass of the box, in kg. Paper: 5."""

# The paper states no sizes. The tops end just inside the box, so that a character at a table touches the box first.
HALF_SIZE = 0.15
TOP_HALF_SIZE = 0.14
TOP_THICKNESS = 0.03
CLEARANCE = 0.1
"""Metres by which the target's top is lower than the source's, and by which the source sinks once the box is taken.

While its carrier walks, a box dips by as much below its initial height, and would catch on the tops.
"""

JOINT = "box_joint"
"""Name of the joint between the box and its carrier."""

GAP = "box_gap"
"""Beginning of the names of the sensors of the gap between them."""

TOP_CONTACT = 2
"""MuJoCo's contact bit of the tops, which only the box shares: for characters, tops would be walls."""


def height_of(spec: mujoco.MjSpec, body: str) -> float:
    """Height of a body's centre of mass in the rest pose, in metres."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return float(data.body(body).xipos[2])


def add_table(spec: mujoco.MjSpec, name: str, height: float, rgba: tuple[float, float, float, float]) -> None:
    """Add a table; its position is the middle of its top, ``height`` above the ground."""
    table = spec.worldbody.add_body(name=name, mocap=True, pos=[0, 0, height])
    box = mujoco.mjtGeom.mjGEOM_BOX
    top = TOP_THICKNESS / 2
    leg = (height - TOP_THICKNESS) / 2
    size = [TOP_HALF_SIZE, TOP_HALF_SIZE, top]
    table.add_geom(type=box, size=size, pos=[0, 0, -top], rgba=rgba, contype=TOP_CONTACT, conaffinity=0)
    place = [0, 0, leg - height]
    table.add_geom(type=box, size=[0.02, 0.02, leg], pos=place, rgba=rgba, contype=0, conaffinity=0)


def add_box(spec: mujoco.MjSpec, height: float) -> None:
    """Add the box, whose centre is ``height`` above the ground."""
    box = spec.worldbody.add_body(name="box", pos=[0, 0, height])
    box.add_freejoint(name="box")
    box.add_geom(
        name="box",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[HALF_SIZE] * 3,
        mass=MASS,
        rgba=[0.76, 0.6, 0.38, 1],
        contype=1,
        conaffinity=1 | TOP_CONTACT,
    )


def add_joint(spec: mujoco.MjSpec, carrier: str) -> None:
    """Add a switchable joint between ``carrier`` and box, exclude their contact, and sense the gap between them."""
    body = mujoco.mjtObj.mjOBJ_BODY
    weld = spec.add_equality(
        name=JOINT, type=mujoco.mjtEq.mjEQ_WELD, objtype=body, name1=carrier, name2="box", active=False
    )
    weld.data[:3] = 0  # the anchor: the origin of the box
    weld.solimp[:2] = 0.999  # with MuJoCo's default of 0.9 the box sags
    spec.add_exclude(bodyname1=carrier, bodyname2="box")
    for index, geom in enumerate(spec.body(carrier).geoms):
        if geom.conaffinity:
            geom.name = geom.name or f"{carrier}_{index}"
            spec.add_sensor(
                name=f"{GAP}_{index}",
                type=mujoco.mjtSensor.mjSENS_GEOMDIST,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=geom.name,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname="box",
                cutoff=0.01,  # wider gaps are all reported as the cutoff
            )
