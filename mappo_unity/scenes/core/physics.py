"""MuJoCo physics of N equal areas: states as arrays by area, stepped together, exact to the bit.

Every step starts from the state alone: warm starts are switched off and `mujoco.rollout` sets all inputs
anew, so results depend neither on an MjData's history nor on the number of threads, and `get_state` is
the whole truth between two steps.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from mujoco.rollout import Rollout

_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_INPUTS = (
    ("ctrl", mujoco.mjtState.mjSTATE_CTRL),
    ("qfrc_applied", mujoco.mjtState.mjSTATE_QFRC_APPLIED),
    ("mocap_pos", mujoco.mjtState.mjSTATE_MOCAP_POS),
    ("mocap_quat", mujoco.mjtState.mjSTATE_MOCAP_QUAT),
)  # in the order of MuJoCo's state vector


class AreaPhysics:
    """Step N copies of an area.

    Arguments: `area`, the description of one area; `num_areas`; `num_threads`, 1: the calling thread;
    `areas_per_model` > 1 puts several areas into one MuJoCo model, which is up to 3 times faster for
    tiny areas: then every contact must be an explicit <pair> (contype = conaffinity = 0), because the
    areas of a model lie in the same place; constraint islands keep them independent.

    Attributes, all float64, to be read and written in place (N areas): `qpos` [N, nq], `qvel` [N, nv],
    inputs `ctrl` [N, nu], `qfrc_applied` [N, nv] (kept until changed), `mocap_pos` [N, nmocap, 3],
    `mocap_quat` [N, nmocap, 4] (w first), and `sensordata` [N, nsensordata], of the last substep. A
    <contact> sensor reports contacts and forces without touching MjData. `model` is one area's model, for
    names and addresses; to change an area's constants use `own_model`.
    """

    def __init__(
        self, area: mujoco.MjSpec, num_areas: int, *, num_threads: int = 1, areas_per_model: int = 1
    ) -> None:
        area = area.copy()

        # Nothing may be carried over that a snapshot lacks, and a state that is not finite must be seen.
        area.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
        area.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.model: mujoco.MjModel = area.compile()

        num_models = -(-num_areas // areas_per_model)
        self._per_model = -(-num_areas // num_models)  # evenly; the last model may hold idle areas
        shared = self.model if self._per_model == 1 else _repeated(area, self.model, self._per_model)
        self._models = [shared] * num_models
        self._shared = shared

        self._data = [mujoco.MjData(shared) for _ in range(num_threads)]
        self._scratch = mujoco.MjData(shared)
        self._rollout = Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._num_areas = num_areas
        self._allocate()

    def step(self, num_substeps: int = 1) -> None:
        """Advance all areas by `num_substeps` MuJoCo steps with constant inputs.

        Raises:
            FloatingPointError: an area's state has become infinite or NaN (names the first).
        """
        num_models, per_area = len(self._models), (len(self._models) * self._per_model, -1)

        # Positions, velocities and inputs into MuJoCo's own rows: clock, positions, velocities, the rest.
        self._state[:, 1 : 1 + self._nq] = self._qpos.reshape(num_models, -1)
        self._state[:, 1 + self._nq : 1 + self._nq + self._nv] = self._qvel.reshape(num_models, -1)
        control, out, sensors = self._buffers(num_substeps)
        for columns, values in self._inputs:
            control[:, :, columns] = values.reshape(num_models, 1, -1)

        self._rollout.rollout(
            self._models,
            self._data,
            self._state,
            control,
            skip_checks=True,
            nstep=num_substeps,
            control_spec=self._control_spec,
            state=out,
            sensordata=sensors,
        )

        last = out[:, -1]
        self._state[:, 1:] = last[:, 1:]  # the clock stays 0: nothing may depend on it
        self._qpos[:] = last[:, 1 : 1 + self._nq].reshape(per_area)
        self._qvel[:] = last[:, 1 + self._nq : 1 + self._nq + self._nv].reshape(per_area)
        if sensors.shape[2]:
            self._sensordata[:] = sensors[:, -1].reshape(per_area)

        check_finite(self._qvel, np.arange(len(self._qvel)))

    def own_model(self, area: int) -> tuple[mujoco.MjModel, str]:
        """Return the model of an area, not shared with other models, and the prefix of the area's names.

        Change constants (masses, sizes) in place, then call `constants_changed`. Constants are not part
        of `get_state`: the scene sets them again from its own state.
        """
        number = area // self._per_model
        # Copied on the first request: models whose constants nobody changes stay one object.
        if self._models[number] is self._shared:
            self._models[number] = copy.copy(self._shared)
        prefix = "" if self._per_model == 1 else f"{area % self._per_model}/"
        return self._models[number], prefix

    def constants_changed(self, area: int) -> None:
        """Recompute what MuJoCo derives from the constants of the area's model."""
        mujoco.mj_setConst(self._models[area // self._per_model], self._scratch)

    def set_gravity(self, gravity: float) -> None:
        """Set the downward (-y) acceleration of all areas, m/s^2."""
        for model in {id(m): m for m in self._models}.values():
            model.opt.gravity[:] = (0.0, -gravity, 0.0)

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of positions, velocities, inputs, and the rest of MuJoCo's state."""
        arrays = {"qpos": self._qpos, "qvel": self._qvel, "sensordata": self._sensordata, "rest": self._state}
        return {name: array.copy() for name, array in {**arrays, **self._input_arrays}.items()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        arrays = {"qpos": self._qpos, "qvel": self._qvel, "sensordata": self._sensordata, "rest": self._state}
        for name, array in {**arrays, **self._input_arrays}.items():
            array[...] = state[name]

    def _allocate(self) -> None:
        """Create the arrays by area; idle areas of the last model stand at the end, out of sight."""
        model, count = self.model, len(self._models) * self._per_model
        self._nq, self._nv = self._per_model * model.nq, self._per_model * model.nv
        self._qpos = np.tile(model.qpos0, (count, 1))
        self._qvel = np.zeros((count, model.nv))
        self._sensordata = np.zeros((count, model.nsensordata))
        self._state = np.zeros((len(self._models), mujoco.mj_stateSize(self._shared, _STATE)))

        # MuJoCo keeps mocap poses in the order of their own ids, not of the bodies.
        mocap = model.body_mocapid >= 0
        order = np.argsort(model.body_mocapid[mocap])
        self._input_arrays = {
            "ctrl": np.zeros((count, model.nu)),
            "qfrc_applied": np.zeros((count, model.nv)),
            "mocap_pos": np.tile(model.body_pos[mocap][order], (count, 1, 1)),
            "mocap_quat": np.tile(model.body_quat[mocap][order], (count, 1, 1)),
        }

        # What scenes see: views without the idle areas.
        self.qpos, self.qvel = self._qpos[: self._num_areas], self._qvel[: self._num_areas]
        self.sensordata = self._sensordata[: self._num_areas]
        self.ctrl = self._input_arrays["ctrl"][: self._num_areas]
        self.qfrc_applied = self._input_arrays["qfrc_applied"][: self._num_areas]
        self.mocap_pos = self._input_arrays["mocap_pos"][: self._num_areas]
        self.mocap_quat = self._input_arrays["mocap_quat"][: self._num_areas]

        # Only inputs that the model has are handed over, side by side in one row.
        self._inputs: list[tuple[slice, np.ndarray]] = []
        self._control_spec, start = 0, 0
        for name, bit in _INPUTS:
            size = self._input_arrays[name].size // len(self._models)
            if size:
                self._control_spec |= int(bit)
                self._inputs.append((slice(start, start + size), self._input_arrays[name]))
                start += size

        self._by_substeps: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def _buffers(self, num_substeps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if num_substeps not in self._by_substeps:
            num_models = len(self._models)
            self._by_substeps[num_substeps] = (
                np.zeros((num_models, num_substeps, mujoco.mj_stateSize(self._shared, self._control_spec))),
                np.zeros((num_models, num_substeps, self._state.shape[1])),
                np.zeros((num_models, num_substeps, self._shared.nsensordata)),
            )
        return self._by_substeps[num_substeps]


def check_finite(velocity: np.ndarray, areas: np.ndarray) -> None:
    """Raise FloatingPointError where a velocity [n, nv] of `areas` [n] is not finite; name the first."""
    # One sum is enough to find a bad number: NaN and infinity never vanish from it.
    if not np.isfinite(velocity.sum()):
        area = int(areas[np.flatnonzero(~np.isfinite(velocity).all(axis=1))[0]])
        raise FloatingPointError(f"physics of area {area} is not finite any more")


def _repeated(area: mujoco.MjSpec, one: mujoco.MjModel, count: int) -> mujoco.MjModel:
    """Compile `count` copies of an area into one model, named "0/...", "1/..." and so on."""
    assert not (one.geom_contype | one.geom_conaffinity).any(), "several areas a model need explicit pairs"
    parent = mujoco.MjSpec()
    # Attached areas do not bring their options along.
    for option in (name for name in dir(area.option) if not name.startswith("_")):
        setattr(parent.option, option, getattr(area.option, option))
    for number in range(count):
        parent.attach(area.copy(), prefix=f"{number}/", frame=parent.worldbody.add_frame())
    return parent.compile()
