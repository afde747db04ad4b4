"""MuJoCo physics of N equal areas whose bodies fall asleep: what is at rest costs next to nothing.

As in Unity's engine, bodies that were slow for a while, with all that they touch, stop and are left out until
something awake touches them. `mujoco.rollout`, with which `AreaPhysics` steps, does not keep who sleeps. As
there, every step starts from the state alone, who sleeps included: results depend neither on an MjData's
history nor on the number of threads, and `get_state` is the whole truth between two steps.
"""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from mappo_unity.scenes.core.physics import check_finite

AWAKE = -11  # MuJoCo counts from here to -1, slow step by slow step; numbers from 0 on are of those asleep


class Sleepers:
    """Who sleeps in an MjData, and all that MuJoCo derives from it for a model.

    Its own function for this (mj_updateSleep in engine_sleep.c, since MuJoCo 3.4) is not public.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        states = mujoco.mjtSleepState
        assert (int(states.mjS_ASLEEP), int(states.mjS_AWAKE)) == (0, 1)  # so that a bool is a state
        # the tree of a body that no joint moves is -1
        self._tree, self._dof_tree = model.body_treeid.copy(), model.dof_treeid.copy()
        self._parent = model.body_parentid[1:].copy()

        self._jointless = self._tree < 0
        is_mocap = model.body_mocapid[model.body_rootid] >= 0
        self._states = np.where(is_mocap, int(states.mjS_AWAKE), int(states.mjS_STATIC)).astype(np.int32)
        self.everyone = np.full(model.ntree, AWAKE, np.int32)

    def enter(self, data: mujoco.MjData, asleep: np.ndarray) -> None:
        """Tell `data` who sleeps: `asleep` int [trees], as MuJoCo's `tree_asleep`."""
        tree_awake = asleep < 0
        is_computed = tree_awake[self._tree] | self._jointless
        bodies, parents = is_computed.nonzero()[0], is_computed[self._parent].nonzero()[0] + 1
        dofs = tree_awake[self._dof_tree].nonzero()[0]

        data.tree_asleep[:], data.tree_awake[:] = asleep, tree_awake
        data.body_awake[:] = np.where(self._jointless, self._states, is_computed)
        data.body_awake_ind[: len(bodies)] = bodies
        data.parent_awake_ind[: len(parents)] = parents
        data.dof_awake_ind[: len(dofs)] = dofs

        data.ntree_awake, data.nbody_awake = int(np.count_nonzero(tree_awake)), len(bodies)
        data.nparent_awake, data.nv_awake = len(parents), len(dofs)


class SleepingPhysics:
    """Step those of N copies of an area that are named.

    Arguments: `area`, the description of one area; `tolerance`, the speed below which a body may fall asleep
    (m/s; rad/s times its size), after ten steps; `num_areas`; `num_threads`, 1: the calling thread.

    Attributes, to be read and written in place (N areas), float64: `qpos` [N, nq], `qvel` [N, nv], inputs
    `mocap_pos` [N, nmocap, 3] and `mocap_quat` [N, nmocap, 4] (w first). Whoever moves a body that sleeps, or
    lets a mocap body push one, calls `wake`. `model` is the areas' model.
    """

    def __init__(
        self, area: mujoco.MjSpec, num_areas: int, *, tolerance: float, num_threads: int = 1
    ) -> None:
        area = area.copy()
        area.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        area.option.sleep_tolerance = tolerance

        # Nothing may be carried over that a snapshot lacks, and a state that is not finite must be seen.
        area.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
        area.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.model: mujoco.MjModel = area.compile()

        model = self.model
        self.qpos = np.tile(model.qpos0, (num_areas, 1))
        self.qvel = np.zeros((num_areas, model.nv))
        mocap = np.argsort(model.body_mocapid)[model.nbody - model.nmocap :]  # in the order of their own ids
        self.mocap_pos = np.tile(model.body_pos[mocap], (num_areas, 1, 1))
        self.mocap_quat = np.tile([1.0, 0.0, 0.0, 0.0], (num_areas, model.nmocap, 1))
        self._asleep = np.full((num_areas, model.ntree), AWAKE, np.int32)

        self._sleepers = Sleepers(model)

        self._data = [mujoco.MjData(model) for _ in range(num_threads)]
        self._pool = ThreadPoolExecutor(num_threads) if num_threads > 1 else None
        self._by_timestep = {model.opt.timestep: model}

    def step(self, num_substeps: int, areas: np.ndarray, timestep: float) -> np.ndarray:
        """Advance areas, integers [n], by steps of `timestep` s with constant inputs.

        Returns the sensors in every substep, float64 [n, substeps, nsensordata]: each as MuJoCo has it, of
        the poses before the substep's motion.

        Raises:
            FloatingPointError: an area's state has become infinite or NaN (names the first).
        """
        if timestep not in self._by_timestep:
            model = self._by_timestep[timestep] = copy.copy(self.model)
            model.opt.timestep = timestep
        model = self._by_timestep[timestep]
        sensors = np.empty((len(areas), num_substeps, model.nsensordata))

        # Each thread has every so manieth area, and an MjData of its own.
        def play(thread: int) -> None:
            for row in range(thread, len(areas), len(self._data)):
                self._step_one(model, self._data[thread], int(areas[row]), sensors[row])

        threads = range(len(self._data))
        list(map(play, threads) if self._pool is None else self._pool.map(play, threads))

        check_finite(self.qvel[areas], areas)
        return sensors

    def wake(self, areas: np.ndarray) -> None:
        """Wake all bodies of areas, integers [n]."""
        self._asleep[areas] = AWAKE

    @property
    def asleep(self) -> np.ndarray:
        """Return which of the model's kinematic trees sleep, bool [N, trees]."""
        return self._asleep >= 0

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of everything that changes."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _step_one(self, model: mujoco.MjModel, data: mujoco.MjData, area: int, sensors: np.ndarray) -> None:
        """Advance one area, and fill in its sensors [substeps, nsensordata]."""
        data.qpos[:], data.qvel[:] = self.qpos[area], self.qvel[area]
        data.mocap_pos[:], data.mocap_quat[:] = self.mocap_pos[area], self.mocap_quat[area]
        data.time = 0.0  # nothing may depend on it

        # MuJoCo computes nothing for those asleep, and another area's are still in there. But one that is
        # woken is moved by what stands there: its pose, inertia and forces at rest.
        self._sleepers.enter(data, self._sleepers.everyone)
        mujoco.mj_fwdKinematics(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_factorM(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_passive(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        mujoco.mj_fwdAcceleration(model, data)
        self._sleepers.enter(data, self._asleep[area])

        for row in sensors:
            mujoco.mj_step(model, data)
            row[:] = data.sensordata

        self.qpos[area], self.qvel[area], self._asleep[area] = data.qpos, data.qvel, data.tree_asleep


_STATE = ("qpos", "qvel", "mocap_pos", "mocap_quat", "_asleep")
