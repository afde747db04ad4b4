"""MuJoCo's description of an area of Pyramids: what the brick pyramid and the agent beside it can meet."""

from __future__ import annotations

import mujoco

from mappo_unity.scenes.core.ground import TICK_S
from mappo_unity.scenes.pyramids.layout import BRICKS, INNER_WALLS, INSIDE_X, INSIDE_Z, STONE_LAYERS

_SOLVER = 'solver="Newton" cone="pyramidal" jacobian="sparse" tolerance="1e-4"'


def area_spec(substeps: int) -> mujoco.MjSpec:
    """Return the MuJoCo description of one area: still walls, switch and stones (mocap), agent, pile.

    The agent slides without friction on the floor and meets only the pile: all its other contacts are
    rules of `bodies.py`. Its yaw is set, not pushed. The outer walls have no top, so that nothing
    leaves the area.

    Args:
        substeps: MuJoCo's steps in a tick.
    """
    walls = "".join(_box("", *wall) for wall in INNER_WALLS)
    layers = "".join(_box("", x, rest_y, z, hx, hy, hz) for x, _, z, hx, hy, hz, rest_y in STONE_LAYERS)
    stones = "".join(f'<body mocap="true" pos="0 -50 0">{layers}</body>' for i in range(6))

    cubes = "".join(
        f'<body><freejoint/><geom class="loose" type="box" size="{h} {h} {h}" mass="2" name="{name}"/></body>'
        for name, h in [*((f"brick{i}", 0.5) for i in range(len(BRICKS))), ("goal", 1.0)]
    )

    return mujoco.MjSpec.from_string(f"""
<mujoco>
  <option timestep="{TICK_S / substeps}" gravity="0 -9.81 0" {_SOLVER}/>
  <default>
    <geom friction="0.6 0.005 0.0001" solref="0.01 2" solimp="0.95 0.99 0.001"/>
    <default class="still"><geom contype="1" conaffinity="0"/></default>
    <default class="loose"><geom contype="1" conaffinity="1"/></default>
  </default>

  <worldbody>
    <geom type="plane" size="0 0 1" zaxis="0 1 0" class="still"/>
    {_outer_planes()}{walls}
    <body name="switch" mocap="true" pos="0 -50 0">{_box("switch", 0, 0, 0, 2, 2, 2)}</body>
    {stones}

    <body name="agent" pos="0 0.5 0" sleep="never">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0" armature="1e6"/>
      <geom name="agent" class="still" type="box" size="0.5 0.5 0.5" mass="25"/>
    </body>

    {cubes}
  </worldbody>

  <sensor><distance geom1="agent" geom2="goal" cutoff="1"/></sensor>
</mujoco>
""")


def _outer_planes() -> str:
    faces = (
        (INSIDE_X[0], 0, "1 0 0"),
        (INSIDE_X[1], 0, "-1 0 0"),
        (0, INSIDE_Z[0], "0 0 1"),
        (0, INSIDE_Z[1], "0 0 -1"),
    )
    return "".join(
        f'<geom type="plane" size="0 0 1" pos="{x} 0 {z}" zaxis="{axis}" class="still"/>'
        for x, z, axis in faces
    )


def _box(name: str, x: float, y: float, z: float, half_x: float, half_y: float, half_z: float) -> str:
    named = f'name="{name}" ' if name else ""
    return f'<geom {named}class="still" type="box" pos="{x} {y} {z}" size="{half_x} {half_y} {half_z}"/>'
