"""The Walker's body: its 16 parts and 13 driven joints as tables, and the MuJoCo area made from them.

Facts: docs/scenes/Walker.md. Unity's numbers and axes (x right, y up, z forward, metres, kg, degrees).
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

TICK_S = 0.01333
GROUND_Y = 0.125  # m: top of the ground
HIPS_START = (0.0, 0.953, 0.0)  # m
TARGET_HALF = 0.125  # m
CONTACT_GAP = 0.02  # m: contacts begin at this distance
STIFFNESS, DAMPING = 40000.0, 5000.0  # N m/rad and N m s/rad of every drive, before a joint's share


@dataclass(frozen=True)
class Part:
    """Describe one part: where it hangs at rest, its collider and its mass."""

    name: str
    parent: str
    """Part that it hangs on; empty for the hips."""
    offset: tuple[float, float, float]
    """Origin in the parent's frame at rest, m."""
    collider: tuple[str, float, float]
    """("x" or "y", radius, height with caps) of a capsule, ("sphere", radius, 0), or ("foot", 0, 0)."""
    mass: float
    ends: bool = True
    """Whether the episode ends when it touches the ground."""


@dataclass(frozen=True)
class Joint:
    """Describe the joint between a part and its parent; angles in degrees.

    The joint angle is Unity's limit and target angle: the part turns by minus the angle about each axis.
    """

    anchor: tuple[float, float, float]
    """In the part's frame, m."""
    axes: tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]
    """Unity's X (twist), Y and Z axis in the part's frame at rest."""
    x: tuple[float, float]
    y: float = 0.0
    """Half-width of the Y range; 0: locked."""
    z: float = 0.0
    share: float = 1.0
    """Share of the drive's stiffness and damping that the joint gets (docs/scenes/Walker.md, drives)."""


FOOT_CENTRE = (0.0, -0.00022, 0.03283)  # m
FOOT_HALF = (0.12785 / 2, 0.04305 / 2, 0.23003 / 2)  # m

PARTS = (
    Part("hips", "", HIPS_START, ("x", 0.10, 0.42), 15),
    Part("chest", "spine", (0, 0.26565, 0), ("x", 0.13, 0.45), 8),
    Part("spine", "hips", (0, 0.22539, 0), ("x", 0.08, 0.36), 10),
    Part("head", "chest", (0, 0.44946, 0), ("sphere", 0.22, 0), 6),
    Part("thighL", "hips", (-0.132, -0.264, 0), ("y", 0.09, 0.30), 14),
    Part("shinL", "thighL", (0, -0.33, 0), ("y", 0.06, 0.32), 7, ends=False),
    Part("footL", "shinL", (0, -0.198, 0), ("foot", 0, 0), 5, ends=False),
    Part("thighR", "hips", (0.132, -0.264, 0), ("y", 0.09, 0.30), 14),
    Part("shinR", "thighR", (0, -0.33, 0), ("y", 0.06, 0.32), 7, ends=False),
    Part("footR", "shinR", (0, -0.198, 0), ("foot", 0, 0), 5, ends=False),
    Part("armL", "chest", (-0.4125, 0, 0), ("x", 0.08, 0.33), 4),
    Part("forearmL", "armL", (-0.33, 0, 0), ("x", 0.08, 0.30), 3),
    Part("handL", "forearmL", (-0.231, 0, 0), ("sphere", 0.08, 0), 2),
    Part("armR", "chest", (0.4125, 0, 0), ("x", 0.08, 0.33), 4),
    Part("forearmR", "armR", (0.33, 0, 0), ("x", 0.08, 0.30), 3),
    Part("handR", "forearmR", (0.231, 0, 0), ("sphere", 0.08, 0), 2),
)
"""Parts in the order of the observation."""

ENDS = np.array([part.ends for part in PARTS])
"""Whether a part's touch of the ground ends the episode, bool ``[16]``."""

_TORSO = ((1, 0, 0), (0, 0, -1), (0, 1, 0))
_LEG = ((-1, 0, 0), (0, 0, -1), (0, -1, 0))
_FOOT = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_ARM_L = ((0, -1, 0), (0, 0, 1), (-1, 0, 0))
_ARM_R = ((0, 1, 0), (0, 0, 1), (1, 0, 0))

JOINTS = {
    "chest": Joint((0, -0.16, 0), _TORSO, (-20, 20), 20, 15, share=0.05),
    "spine": Joint((0, -0.10, 0), _TORSO, (-20, 20), 20, 15, share=0.05),
    "head": Joint((0, -0.28, 0), _TORSO, (-30, 10), 20, share=0.125),
    "thighL": Joint((0, 0.16, 0), _LEG, (-90, 60), 40, share=0.0163),
    "shinL": Joint((0, 0.17, 0), _LEG, (0, 120), share=0.018),
    "footL": Joint((0, 0.03, 0), _FOOT, (-20, 20), 20, 20, share=0.025),
    "thighR": Joint((0, 0.16, 0), _LEG, (-90, 60), 40, share=0.0163),
    "shinR": Joint((0, 0.17, 0), _LEG, (0, 120), share=0.018),
    "footR": Joint((0, 0.03, 0), _FOOT, (-20, 20), 20, 20, share=0.025),
    "armL": Joint((0.18, 0, 0), _ARM_L, (-60, 120), 100, share=0.0054),
    "forearmL": Joint((0.16, 0, 0), _ARM_L, (0, 160), share=0.127),
    "armR": Joint((-0.18, 0, 0), _ARM_R, (-60, 120), 100, share=0.0054),
    "forearmR": Joint((-0.16, 0, 0), _ARM_R, (0, 160), share=0.127),
}
"""Driven joints by the part they turn, in the order of the observation and of the strength actions' parts."""


def joint_axes(name: str) -> list[tuple[str, tuple[int, int, int], float, float]]:
    """Return a joint's free axes as (letter, Unity's axis, low, high in degrees), nearest the parent first.

    Unity turns by Euler angles Z, then X, then Y; a locked axis is left out.
    """
    joint = JOINTS[name]
    free = [("X", joint.axes[0], *joint.x)]

    if joint.z:
        free.insert(0, ("Z", joint.axes[2], -joint.z, joint.z))
    if joint.y:
        free.append(("Y", joint.axes[1], -joint.y, joint.y))

    return free


def depth_first() -> list[Part]:
    """Return the parts in the order in which MuJoCo numbers bodies and joints."""

    def below(parent: str) -> list[Part]:
        return [q for part in PARTS if part.parent == parent for q in (part, *below(part.name))]

    return below("")


HINGES = tuple(
    (part.name, letter)
    for part in depth_first()
    if part.name in JOINTS
    for letter, *_ in joint_axes(part.name)
)
"""(part, axis letter) of every hinge, in MuJoCo's order."""


def area(kinematic: bool = False) -> mujoco.MjSpec:
    """Return the description of one area: figure, ground, walls and target.

    `kinematic`: only the figure, without forces, with sensors of every part's pose and motion: positions,
    rotations (w first), velocities of the centres of mass, spins, each in the order of `PARTS`, world axes.
    Positions in `qpos`: hips [0:7], hinges [7:33] rad, target [33:40]; in `qvel` [0:6], [6:32], [32:38].
    """
    spec = mujoco.MjSpec.from_string(_OPTIONS)
    bodies = {"": spec.worldbody}

    for part in depth_first():
        bodies[part.name] = _add_part(bodies[part.parent], part)

    if kinematic:
        for flag in ("CONTACT", "CONSTRAINT", "GRAVITY", "SPRING", "DAMPER"):
            spec.option.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
        _add_sensors(spec)
    else:
        _add_surroundings(spec)

    return spec


# A constraint acts as stiffly as one tick allows (time constant two ticks).
_OPTIONS = f"""
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="{TICK_S}" gravity="0 -14.715 0" solver="Newton" iterations="50" cone="pyramidal">
    <flag eulerdamp="disable"/>
  </option>
</mujoco>
"""
_SOLREF, _SOLIMP = [2 * TICK_S, 1.0], [0.9, 0.95, 0.001, 0.5, 2.0]
_FRICTION = [0.6, 0.0, 0.0]


def _add_part(parent: mujoco.MjsBody, part: Part) -> mujoco.MjsBody:
    body = parent.add_body(name=part.name, pos=part.offset)
    if not part.parent:
        body.add_freejoint(name=part.name)

    for letter, axis, low, high in joint_axes(part.name) if part.name in JOINTS else ():
        share = JOINTS[part.name].share
        body.add_joint(
            name=f"{part.name}{letter}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            pos=JOINTS[part.name].anchor,
            axis=[-value for value in axis],
            range=[low, high],
            # of a drive in full force; `physics` sets it in every tick
            armature=TICK_S * share * (DAMPING + TICK_S * STIFFNESS),
            solref_limit=_SOLREF,
            solimp_limit=_SOLIMP,
        )

    body.add_geom(name=part.name, mass=part.mass, **_SURFACE, **_shape(*part.collider))
    return body


_SURFACE = {"friction": _FRICTION, "solref": _SOLREF, "solimp": _SOLIMP, "condim": 3}


def _shape(kind: str, radius: float, height: float) -> dict:
    if kind == "foot":
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": FOOT_HALF, "pos": FOOT_CENTRE}
    if kind == "sphere":
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0, 0]}

    along = np.array([kind == "x", kind == "y", 0]) * (height / 2 - radius)
    return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [radius, 0, 0], "fromto": [*-along, *along]}


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
    plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [13, 13, 1], "quat": [0.5**0.5, -(0.5**0.5), 0, 0]}
    world.add_geom(name="ground", pos=[0, GROUND_Y, 0], **plane, **_SURFACE)

    for side in (-12.5, 12.5):
        world.add_geom(type=box, pos=[side, 0.5, 0], size=[0.125, 0.625, 12.625], **_SURFACE)
        world.add_geom(type=box, pos=[0, 0.5, side], size=[12.625, 0.625, 0.125], **_SURFACE)

    target = world.add_body(name="target", pos=[0, 1, 1])
    target.add_freejoint(name="target")
    target.add_geom(name="target", type=box, size=[TARGET_HALF] * 3, mass=1, gap=CONTACT_GAP, **_SURFACE)

    # in a contact sensor an XBODY stands for all below it: any part of the figure may touch
    spec.add_sensor(
        name="touched",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_XBODY,
        objname="hips",
        reftype=mujoco.mjtObj.mjOBJ_BODY,
        refname="target",
        intprm=[1, 0, 1],
    )


def _add_sensors(spec: mujoco.MjSpec) -> None:
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    # XBODY is a part's own origin, BODY its centre of mass; `physics` relies on the order
    for kind, frame in (
        (kinds.mjSENS_FRAMEPOS, objects.mjOBJ_XBODY),
        (kinds.mjSENS_FRAMEQUAT, objects.mjOBJ_XBODY),
        (kinds.mjSENS_FRAMELINVEL, objects.mjOBJ_BODY),
        (kinds.mjSENS_FRAMEANGVEL, objects.mjOBJ_BODY),
    ):
        for part in PARTS:
            spec.add_sensor(type=kind, objtype=frame, objname=part.name)
