"""3DBall: keep a ball on a cube that tilts about two axes.

Facts: docs/scenes/3DBall.md. One agent an area; the cube is a mocap body, the ball a free sphere.
Legend: N areas = slots (one agent an area).
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mappo_unity.scenes.core.physics import AreaPhysics
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor

TICK_S = 0.02
TURN_RAD = np.radians(2.0)  # turn about one axis in a tick, at |action| = 1
TILT_LIMIT = 0.25  # of the quaternion's component; about 29 degrees
BALL_RADIUS = 0.5  # m, at scale 1
MAX_SPIN = 7.0  # rad/s: the engine's limit for bodies that set none
SPIN_KEPT = 1.0 - 0.01 * TICK_S  # angular drag 0.01/s
CUBE_HALF = 2.5  # m
PUSH_OUT = 0.8  # share of a penetration that the engine removes in a tick
MAX_PUSH_OUT = 10.0 * TICK_S  # m: at most 10 m/s
ROLLING_SHARE = 2 / 7  # of a displacement of the contact point, for a rolling solid sphere
TOUCH_GAP = 0.01  # m
CONTACT_SLACK = 1e-4  # m of penetration left, so that a resting ball stays in contact
AREAS_PER_MODEL = 16  # measured: 0.8 us an area and tick, against 2.4 us with one area a model

# The contact only stops the approach within one tick (damping 1 / tick, no stiffness); penetration is
# removed by `Ball3D._move_with_cube`, which leaves no velocity behind.
AREA = """
<mujoco>
  <option timestep="0.02" gravity="0 -9.81 0" solver="CG" cone="elliptic">
    <flag sensor="disable" limit="disable" equality="disable" frictionloss="disable" actuation="disable"/>
  </option>
  <worldbody>
    <body name="cube" mocap="true">
      <geom name="cube" type="box" size="2.5 2.5 2.5" contype="0" conaffinity="0"/>
    </body>
    <body name="ball" pos="0 3 0">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size="0.5" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="cube" geom2="ball" condim="3" friction="0.6 0.6 0 0 0"
          solref="-1e-9 -50" solimp="0.999 0.999 0.01"/>
  </contact>
</mujoco>
"""


class Ball3D(Scene):
    """Run 3DBall; parameters `mass` (kg) and `scale` of the ball, `gravity` (m/s^2, downward)."""

    NAME = "3DBall"
    DEFAULT_NUM_AREAS = 12
    BEHAVIORS = (Behavior("3DBall?team=0", (Sensor("VectorSensor_size8", (8,)),), continuous=2),)
    MAX_STEP = 5000
    PARAMETERS = {
        "mass": Parameter(1.0, above=0.0),
        "scale": Parameter(1.0, above=0.0),
        "gravity": Parameter(9.81, at_once=True),
    }

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.physics = AreaPhysics(
            mujoco.MjSpec.from_string(AREA),
            self.num_areas,
            num_threads=self.num_threads,
            areas_per_model=AREAS_PER_MODEL,
        )
        self.physics.set_gravity(self.parameters["gravity"])

        # Views of the physics' arrays: what is written here moves the ball.
        self.ball_position = self.physics.qpos[:, 0:3]  # relative to the cube, which stands at the origin
        self.ball_velocity = self.physics.qvel[:, 0:3]
        self.ball_spin = self.physics.qvel[:, 3:6]
        self.cube_rotation = self.physics.mocap_quat[:, 0]  # w, x, y, z; written by set_cubes

        self._matrix = matrices(self.cube_rotation.T)  # [3, 3, N], after this tick's turn
        self._before = np.zeros((3, self.num_areas))  # the ball in the cube's frame before the turn
        self._turned = np.zeros(self.num_areas, bool)  # whether `_before` belongs to this episode

        self.mass = np.ones(self.num_areas)  # kg, in force since the area's last reset
        self.scale = np.ones(self.num_areas)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Tilt the cube by up to 10 degrees about x, then z; drop the ball from 4 m above its centre."""
        tilt = np.radians(self.rng.uniform(-10, 10, (len(slots), 2)))
        flat = np.zeros((4, len(slots)))
        flat[0] = 1
        self.set_cubes(slots, turned(turned(flat, "x", tilt[:, 0]), "z", tilt[:, 1]))

        self.ball_position[slots, 1] = 4
        self.ball_position[slots[:, None], [0, 2]] = self.rng.uniform(-1.5, 1.5, (len(slots), 2))
        self.ball_velocity[slots] = 0  # the spin is kept

        self._turned[slots] = False
        self._read_parameters(slots)

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the cube's quaternion z and x, the ball's position from the cube, and its velocity."""
        obs = np.empty((len(slots), 8), np.float32)
        rotation = self.cube_rotation[slots]
        obs[:, 0] = rotation[:, 3]
        obs[:, 1] = rotation[:, 1]
        obs[:, 2:5] = self.ball_position[slots]
        obs[:, 5:8] = self.ball_velocity[slots]
        return [obs]

    def act(self, slots: np.ndarray) -> None:
        """Turn the cubes; 0.1 replaces the reward of the window, or -1 and the end if the ball has fallen."""
        angle = np.minimum(np.maximum(self.agents.continuous.T, -1.0), 1.0) * TURN_RAD
        self._before = in_cube(self._matrix, self.ball_position.T)
        self._turned[:] = True

        # Its own axes: the second turn is about an axis that the first one has moved.
        rotation = limited_turn(self.cube_rotation.T, "z", angle[0])
        rotation = limited_turn(rotation, "x", angle[1])
        self.cube_rotation[...] = rotation.T
        self._matrix = matrices(rotation)

        x, y, z = self.ball_position.T
        fallen = (y < -2) | (np.abs(x) > 3) | (np.abs(z) > 3)

        self.agents.reward[:] = 0.1
        if fallen.any():
            self.set_reward(fallen, -1.0)
            self.end_episode(fallen)

    def simulate(self) -> None:
        """Advance one tick; before it move, damp and limit the balls as the engine does."""
        spin = self.ball_spin
        spin *= SPIN_KEPT
        fast = np.einsum("ni,ni->n", spin, spin) > MAX_SPIN**2
        if fast.any():
            spin[fast] *= MAX_SPIN / np.linalg.norm(spin[fast], axis=1, keepdims=True)

        self._move_with_cube()
        self.physics.step()

    def parameter_changed(self, name: str) -> None:
        """Apply gravity at once; mass and scale wait for each area's next reset."""
        if name == "gravity":
            self.physics.set_gravity(self.parameters["gravity"])

    def set_cubes(self, slots: np.ndarray, rotation: np.ndarray) -> None:
        """Put cubes into rotations [4, n] (w, x, y, z); the only way besides `act` to turn them."""
        self.cube_rotation[slots] = rotation.T
        self._matrix[:, :, slots] = matrices(rotation)

    def scene_state(self) -> dict[str, Any]:
        """Return the physics and the parameters in force in every area."""
        return {"physics": self.physics.get_state(), "mass": self.mass.copy(), "scale": self.scale.copy()}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`, the balls' masses and sizes included."""
        self.physics.set_gravity(self.parameters["gravity"])
        self.physics.set_state(state["physics"])
        self._matrix = matrices(self.cube_rotation.T)

        # Masses and sizes are the engine's constants: only what differs is written.
        changed = np.flatnonzero((self.mass != state["mass"]) | (self.scale != state["scale"]))
        self.mass[:], self.scale[:] = state["mass"], state["scale"]
        self._set_balls(changed)

    def _move_with_cube(self) -> None:
        """Move balls with the surface that has turned under them, as the engine does, without velocity.

        Unity's engine (PhysX) corrects positions apart from velocities: a penetration is pushed out along
        the contact normal, and the friction anchors pull the contact point after the surface, which takes
        a rolling solid sphere 2 / 7 of the way. A soft contact alone throws the ball up instead, at the
        surface's speed of up to 3.5 m/s.
        """
        local = in_cube(self._matrix, self.ball_position.T)
        offset = local - np.minimum(np.maximum(local, -CUBE_HALF), CUBE_HALF)  # from its nearest point
        distance = np.sqrt(np.einsum("in,in->n", offset, offset))
        depth = BALL_RADIUS * self.scale - distance

        touching = depth > -TOUCH_GAP
        if not touching.any():
            return

        normal = offset / np.maximum(distance, CONTACT_SLACK)  # zero inside the cube: no direction out
        push = np.minimum(np.maximum(PUSH_OUT * (depth - CONTACT_SLACK), 0), MAX_PUSH_OUT)
        slip = (self._before - local) * (ROLLING_SHARE * (touching & self._turned & (distance > 0)))
        # Along the normal only the push counts, so the slip's part along it is taken out.
        shift = slip + normal * (push - np.einsum("in,in->n", slip, normal))

        self.ball_position += np.einsum("ijn,jn->ni", self._matrix, shift)

    def _read_parameters(self, slots: np.ndarray) -> None:
        mass, scale = (self.parameters.draw(name, len(slots)) for name in ("mass", "scale"))
        changed = (self.mass[slots] != mass) | (self.scale[slots] != scale)
        if changed.any():
            areas = slots[changed]
            self.mass[areas], self.scale[areas] = mass[changed], scale[changed]
            self._set_balls(areas)

    def _set_balls(self, areas: np.ndarray) -> None:
        for area in areas.tolist():
            model, prefix = self.physics.own_model(area)
            body, geom = model.body(f"{prefix}ball"), model.geom(f"{prefix}ball")
            radius = BALL_RADIUS * self.scale[area]

            # The engine keeps three sizes of a geom: its own, its bounding sphere and its box.
            geom.size[0] = radius
            geom.rbound[0] = radius
            model.geom_aabb[geom.id, 3:] = radius

            body.mass[0] = self.mass[area]
            body.inertia[:] = 0.4 * self.mass[area] * radius**2  # solid sphere

            self.physics.constants_changed(area)


def turned(rotation: np.ndarray, axis: str, angle: np.ndarray) -> np.ndarray:
    """Return quaternions [4, N] (w, x, y, z) turned by `angle` [N] rad about their own x or z axis.

    q * (cos(angle / 2), sin(angle / 2) e_axis), the Hamilton product.
    """
    w, x, y, z = rotation
    half = 0.5 * angle
    s, c = np.sin(half), np.cos(half)
    out = np.empty(rotation.shape)

    if axis == "x":
        out[0], out[1], out[2], out[3] = w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s
    else:
        assert axis == "z"
        out[0], out[1], out[2], out[3] = w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s

    return out


def matrices(rotation: np.ndarray) -> np.ndarray:
    """Return rotation matrices [3, 3, N] of unit quaternions [4, N] (w, x, y, z)."""
    w, x, y, z = rotation
    xx, yy, zz = 2 * rotation[1:] * rotation[1:]
    wx, wy, wz = 2 * w * rotation[1:]
    xy, xz, yz = 2 * x * y, 2 * x * z, 2 * y * z

    out = np.empty((3, 3, rotation.shape[1]))
    out[0, 0], out[0, 1], out[0, 2] = 1 - yy - zz, xy - wz, xz + wy
    out[1, 0], out[1, 1], out[1, 2] = xy + wz, 1 - xx - zz, yz - wx
    out[2, 0], out[2, 1], out[2, 2] = xz - wy, yz + wx, 1 - xx - yy

    return out


def in_cube(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors [3, N] in the frames whose rotation matrices are [3, 3, N]."""
    return np.einsum("ijn,in->jn", matrix, vector)


def limited_turn(rotation: np.ndarray, axis: str, angle: np.ndarray) -> np.ndarray:
    """Turn as `turned`, but not further where the axis' component has passed +-0.25 already."""
    tilt = rotation[1 if axis == "x" else 3]
    allowed = ((tilt < TILT_LIMIT) & (angle > 0)) | ((tilt > -TILT_LIMIT) & (angle < 0))
    return turned(rotation, axis, angle * allowed)
