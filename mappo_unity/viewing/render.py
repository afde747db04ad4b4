"""Pictures of shapes, by MuJoCo's renderer, offscreen or in a window.

Shapes go straight into the renderer's list, so nothing has to be simulated by MuJoCo to be drawn.

MuJoCo's world is right-handed with z up, Unity's left-handed with y up; swapping y and z turns one into the
other. With P the swap: positions p -> P p, rotations R -> P R P, sizes in the order x, z, y.
"""

from __future__ import annotations

import ctypes.util
import os
import sys
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.shapes import Camera, Kind, Shape
from mappo_unity.viewing.antialias import smooth_edges

PACKAGES = (
    "on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri (EGL), or libosmesa6 with MUJOCO_GL=osmesa"
)
MAX_SHAPES = 4000
_KINDS = {
    Kind.box: mujoco.mjtGeom.mjGEOM_BOX,
    Kind.ellipsoid: mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    Kind.capsule: mujoco.mjtGeom.mjGEOM_CAPSULE,
    Kind.cylinder: mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_SWAP = np.array([0, 2, 1])
_LIGHT = np.array([0.35, 0.45, -1.0]) / np.linalg.norm([0.35, 0.45, -1.0])  # the way it shines
_STAGE = """
<mujoco>
  <visual>
    <global fovy="{fovy}" offwidth="{width}" offheight="{height}"/>
    <headlight ambient="0.32 0.32 0.34" diffuse="0.28 0.28 0.28" specular="0 0 0"/>
    <quality shadowsize="1024" offsamples="0" numslices="20" numstacks="10"/>
    <map znear="0.02" zfar="20" shadowclip="1.1"/>
  </visual>
  <statistic extent="{extent}" center="{center}"/>
  <asset>
    <texture type="skybox" builtin="gradient" width="64" height="384"
             rgb1="0.86 0.91 0.97" rgb2="0.55 0.66 0.80"/>
  </asset>
  <worldbody>
    <light directional="true" castshadow="true" dir="{light}"
           diffuse="0.55 0.55 0.53" specular="0.12 0.12 0.12"/>
  </worldbody>
</mujoco>
"""


class Renderer:
    """Draw shapes offscreen.

    Arguments: `camera` (its distance sets the reach of the shadows; later frames may look elsewhere),
    `width` and `height` in pixels. Raises ConfigError: no OpenGL works here (names the packages).
    """

    def __init__(self, camera: Camera, width: int, height: int) -> None:
        self._stage = Stage(camera, width, height)
        self._context: Any = _offscreen_context(width, height)
        self._context.make_current()
        self._gl = mujoco.MjrContext(self._stage.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gl)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), np.uint8)

    def frame(self, shapes: Sequence[Shape], camera: Camera) -> np.ndarray:
        """Return a new picture uint8 [height, width, 3]."""
        self._context.make_current()
        mujoco.mjr_render(self._rectangle, self._stage.fill(shapes, camera), self._gl)
        mujoco.mjr_readPixels(self._pixels, None, self._rectangle, self._gl)

        # OpenGL's first row is the lowest one.
        frame = np.ascontiguousarray(self._pixels[::-1])
        smooth_edges(frame)
        return frame

    def close(self) -> None:
        """Free the graphics memory."""
        self._gl.free()
        self._context.free()


class Stage:
    """Light, sky and the list of shapes, as MuJoCo's renderer wants them."""

    def __init__(self, camera: Camera, width: int, height: int) -> None:
        center = " ".join(f"{part:g}" for part in np.array(camera.target)[_SWAP])
        # MuJoCo measures shadows and clip planes by the extent of its model; this one is empty.
        self._reach = 0.6 * camera.distance  # of the shadows, m
        text = _STAGE.format(
            fovy=camera.field_of_view,
            width=width,
            height=height,
            extent=self._reach,
            center=center,
            light=" ".join(f"{part:g}" for part in _LIGHT),
        )

        self.model: mujoco.MjModel = mujoco.MjModel.from_xml_string(text)
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)

        self._scene = mujoco.MjvScene(self.model, MAX_SHAPES)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()

    def fill(self, shapes: Sequence[Shape], camera: Camera) -> mujoco.MjvScene:
        """Put the shapes into the renderer's list and point the camera."""
        if len(shapes) > MAX_SHAPES:
            raise ValueError(f"{len(shapes)} shapes are more than the renderer's {MAX_SHAPES}")

        # Unity's yaw is clockwise from forward, which is MuJoCo's y; azimuth is the other way round from x.
        self._camera.lookat[:] = np.array(camera.target)[_SWAP]
        self._camera.distance = camera.distance
        self._camera.azimuth = 90.0 - camera.yaw
        self._camera.elevation = -camera.pitch

        # This empties the list of shapes and sets the lights anew: ours come afterwards.
        scene = self._scene
        mujoco.mjv_updateScene(
            self.model,
            self._data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            scene,
        )

        self._place_light()
        for shape in shapes:
            _put(scene.geoms[scene.ngeom], shape)
            scene.ngeom += 1

        return scene

    def _place_light(self) -> None:
        """Put the light that throws shadows above what the camera looks at: behind it there are none.

        In large steps, because with every step the edges of all shadows change a little.
        """
        step = self._reach / 4
        above = np.round(self._camera.lookat / step) * step - self._reach * _LIGHT
        for light in self._scene.lights[: self._scene.nlight]:
            if light.castshadow:
                light.pos[:] = above


def _put(geom: Any, shape: Shape) -> None:
    size = np.ones(3)
    if shape.kind in (Kind.box, Kind.ellipsoid):
        size[:] = np.array(shape.size)[_SWAP]
    else:
        size[:2] = shape.size  # radius and half-length; Unity's y and MuJoCo's z are the axis

    mujoco.mjv_initGeom(
        geom,
        int(_KINDS[shape.kind]),
        size,
        shape.position[_SWAP],
        shape.rotation[_SWAP][:, _SWAP].reshape(-1),
        np.array(shape.color, np.float32),
    )

    category = mujoco.mjtCatBit.mjCAT_DYNAMIC if shape.shadow else mujoco.mjtCatBit.mjCAT_DECOR
    geom.category = int(category)
    geom.specular, geom.shininess = 0.2, 0.4


def check_opengl() -> None:
    """Raise ConfigError if nothing can be drawn offscreen here (names the packages)."""
    _offscreen_context(64, 64).free()


def _offscreen_context(width: int, height: int) -> Any:
    """Return a GL context without a window: what MUJOCO_GL names, else EGL, else OSMesa."""
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip() or _installed()
    if wanted not in ("egl", "osmesa"):
        wanted = "glfw"  # the only one left, whatever name MuJoCo takes it by

    try:
        if wanted == "egl":
            from mujoco.egl import GLContext
        elif wanted == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            _start_glfw()
            from mujoco.glfw import GLContext

        return GLContext(width, height)
    except Exception as error:  # PyOpenGL and the drivers raise many kinds
        raise ConfigError(
            f"no picture can be drawn offscreen here by OpenGL with {wanted} "
            f"({error or type(error).__name__}); install what is missing: {PACKAGES}; the environment "
            "variable MUJOCO_GL chooses between egl, osmesa and glfw"
        ) from error


def _start_glfw() -> None:
    import glfw

    glfw.ERROR_REPORTING = "ignore"  # no warnings beside our message
    if not glfw.init():
        raise RuntimeError("it needs a display")


def _installed() -> str:
    if sys.platform != "linux":
        return "glfw"

    for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            return name

    # Neither was found: if EGL does not work either, the error names the packages.
    return "egl"
