"""What a scene is written with: its declarations and hooks.

In: the stepping loop of `base.py` calls them. Out: a scene's own rules. Knows nothing of records.

How to write a scene (`ball3d.py` is the shortest example): subclass `Scene`, declare the class attributes,
and implement the hooks. All hooks work on *slots* (see `agents.py`): integer arrays that select agents of
all areas at once; slot // agents_per_area is the area. No Python loop over agents.

    class MyScene(Scene):
        NAME, DEFAULT_NUM_AREAS, MAX_STEP = "MyScene", 12, 5000
        BEHAVIORS = (Behavior("MyScene?team=0", (Sensor("VectorSensor_size8", (8,)),), continuous=2),)
        def __init__(self, **options):
            super().__init__(**options)      # then build arrays and physics; do not draw numbers yet
        def begin_episode(self, slots): ...  # OnEpisodeBegin
        def observe(self, behavior, slots): ...  # one new float32 array [n, *shape] a sensor, unstacked
        def act(self, slots): ...            # OnActionReceived; reads self.agents.continuous / .discrete
        def simulate(self): ...              # physics of one tick, then collision callbacks
        def scene_state(self), load_scene_state(self, state)

One tick, in Unity's order: `fixed_update` (agents' own FixedUpdate) -> [first tick only: `begin_episode` of
all] -> decisions asked, counters + 1, `observe` for those asked, exchange with Python if any record waits
-> `act` -> MaxStep -> `controllers` (scripts after the academy) -> `simulate`.
Hooks change rewards and episodes with `set_reward`, `add_reward`, `add_group_reward`, `end_episode`,
`disable`, `enable`, `switch_behavior`; all of them accept integer slots or a boolean mask over slots.
Use Unity's numbers and axes (x right, y up, z forward) everywhere, in MuJoCo too: gravity along -y, and
mirrored algebra is the same algebra (only MuJoCo's quaternions are w first).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from mappo_unity.scenes.core.specs import Behavior, Parameter


class SceneHooks:
    """Declare a scene; `Scene` adds what hooks work with: `agents`, `rng`, `parameters`, rewards and ends."""

    NAME: ClassVar[str]
    """Name of the scene."""
    DEFAULT_NUM_AREAS: ClassVar[int] = 1
    """Areas of the Unity scene."""
    BEHAVIORS: ClassVar[tuple[Behavior, ...]]
    """Behaviors, in the order in which Unity lists them."""
    AREA_BEHAVIORS: ClassVar[tuple[int, ...]] = (0,)
    """First behavior (index) of each agent of an area; the order gives the agent ids."""
    AREA_GROUPS: ClassVar[tuple[int, ...]] = (-1,)
    """Group of each agent of an area, from 0 in creation order; -1: none (group id 0)."""
    DECISION_PERIOD: ClassVar[int] = 5
    """Ticks between two decisions."""
    TAKE_ACTIONS_BETWEEN_DECISIONS: ClassVar[bool] = True
    """Whether `act` runs every tick, or only in ticks of a decision."""
    MAX_STEP: ClassVar[int] = 0
    """Ticks after which an agent's episode is interrupted; 0: never."""
    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {}
    """Environment parameters that the scene reads."""

    counter: int
    """Ticks of the academy since the start or the last env.reset()."""

    def begin_episode(self, slots: np.ndarray) -> None:
        """Begin new episodes of `slots` (OnEpisodeBegin); draw from `self.rng` here."""
        raise NotImplementedError

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return a new list: for each sensor a new array float32 ``[len(slots), *shape]``, not stacked."""
        raise NotImplementedError

    def observe_all(self, slots: list[np.ndarray]) -> list[list[np.ndarray]]:
        """Return what `observe` does for `slots` of every behavior; override to save work in common."""
        if len(slots) == 1:
            return [self.observe(0, slots[0])]
        return [self.observe(behavior, rows) if rows.size else [] for behavior, rows in enumerate(slots)]

    def act(self, slots: np.ndarray) -> None:
        """Execute the stored actions of `slots`; give rewards, end episodes (OnActionReceived)."""
        raise NotImplementedError

    def simulate(self) -> None:
        """Advance physics by one tick, then handle contacts; those may end episodes too."""

    def fixed_update(self) -> None:
        """Run the agents' own FixedUpdate, before the academy's step of this tick."""

    def controllers(self) -> None:
        """Run scripts that follow the academy's step (area timers), before physics."""

    def decides(self) -> bool | np.ndarray:
        """Return who asks for a decision this tick: all, none, or a mask bool over slots."""
        return self.counter % self.DECISION_PERIOD == 0

    def action_mask(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return one bool ``[len(slots), branch size]`` a discrete branch, True = forbidden."""
        return [np.zeros((len(slots), size), bool) for size in self.BEHAVIORS[behavior].branches]

    def parameter_changed(self, name: str) -> None:
        """Apply a parameter that acts at once (gravity); others are read at the next reset."""

    def scene_state(self) -> dict[str, Any]:
        """Return everything of the scene that a snapshot needs, as numpy arrays and plain values."""
        return {}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore what `scene_state` returned."""
