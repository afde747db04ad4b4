"""SoccerTwos and StrikersVsGoalie: the rules of Unity's soccer scenes.

Facts: docs/scenes/SoccerTwos.md and docs/scenes/StrikersVsGoalie.md. Bodies: `physics.py`; what
agents see: `view.py`.
Legend: F fields (areas), A agents of a field, S = F * A slots; slot = field * A + agent.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter
from mappo_unity.scenes.soccer.physics import SoccerPhysics
from mappo_unity.scenes.soccer.view import AROUND, SoccerView, View

EPISODE_TICKS = 5000
RUN_SPEED = 2.0  # m/s: velocity change in a tick at factor 1
TURN_RAD = np.radians(2.0)  # in a tick
SPREAD_X = 5.0  # m: agents start within this of their place
BALL_SPREAD = 2.5  # m
TOUCH_REWARD = 0.2  # times ball_touch
BRANCHES = (3, 3, 3)  # forward: none, ahead, back; side: none, right, left; turn: none, left, right
BLUE, PURPLE = 0, 1


_STATE = ("yaw", "timer", "touch_reward")
_CODE = np.array([9, 3, 1], np.int32)  # of the 27 actions
_TICK, _LATE = np.array(1), np.array(EPISODE_TICKS)  # as arrays, which NumPy takes faster than numbers

_OWN_PURPLE = View(("ball", "purpleGoal", "blueGoal", "wall", "purpleAgent", "blueAgent"))
_OWN_BLUE = View(("ball", "blueGoal", "purpleGoal", "wall", "blueAgent", "purpleAgent"))
_STRIKER = View(("ball", "purpleGoal", "wall", "blueAgent", "purpleAgent"))
_GOALIE = View(("ball", "purpleGoal", "wall", "blueAgent"), (AROUND,))


def _behavior(name: str, view: View, *sensors: str) -> Behavior:
    """Return a behavior whose sensors, all stacked three times, show `view`."""
    rays = zip(view.sensors(), sensors, strict=True)
    return Behavior(name, tuple(eyes.sensor(sensor, stack=3) for eyes, sensor in rays), branches=BRANCHES)


class Role(NamedTuple):
    """What tells agents apart: team, place at the start, speeds, kick, reward of time."""

    team: int
    x: float
    """Middle of the start, m; y is 0.5, yaw towards the other goal."""
    z: float
    forward: float = 1.0
    """Share of the run speed, ahead and back."""
    side: float = 0.3
    always_kicks: bool = False
    """Kicks on every beginning contact, not only while its action is ahead."""
    tick_reward: float = 0.0


class SoccerScene(Scene):
    """Play soccer on F fields: what both scenes share."""

    DEFAULT_NUM_AREAS = 8
    PARAMETERS = {"ball_touch": Parameter(0.0), "gravity": Parameter(9.81, at_once=True)}
    ROLES: ClassVar[tuple[Role, ...]]
    """Roles of a field's agents, by ascending id."""
    VIEWS: ClassVar[tuple[View, ...]]
    """What the agents of each behavior see."""
    BLUE_CLOSED: ClassVar[bool] = False
    """Whether a block closes the blue goal."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        fields, agents = self.num_areas, self.agents_per_area
        self.physics = SoccerPhysics(fields, agents, self.BLUE_CLOSED)

        self.yaw = np.zeros((agents, fields))  # rad, clockwise from z seen from above
        self.timer = np.zeros(fields, np.int64)  # ticks since the field's last reset
        self.touch_reward = np.zeros(self.num_slots, np.float32)  # read at the start of an episode

        teams = np.array([role.team for role in self.ROLES])
        self._team = np.tile(teams, fields)  # [S]

        # a column for each of the 27 actions of every agent, so that a tick only looks them up
        self._motions = np.concatenate([_motions(role) for role in self.ROLES], axis=1)
        self._motion_offset = np.repeat(27 * np.arange(agents, dtype=np.int32)[:, None], fields, axis=1)
        self._slot = np.arange(self.num_slots).reshape(fields, agents).T.copy()  # [A, F]

        tick_reward = np.array([role.tick_reward for role in self.ROLES], np.float32)
        self._tick_reward = np.tile(tick_reward, fields) if tick_reward.any() else None

        self._kick_power = np.zeros((agents, fields))
        self._drive = np.zeros((2, agents, fields))

        agent_tags = [("blueAgent", "purpleAgent")[role.team] for role in self.ROLES]
        self._view = SoccerView(self.physics, self.yaw, self.VIEWS, agent_tags)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Read `ball_touch`; the field's own resets are the scene's, not the agent's."""
        if not self.started:
            self._reset_fields(np.arange(self.num_areas))
        self.touch_reward[slots] = TOUCH_REWARD * self.parameters.draw("ball_touch", len(slots))

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return what the agents' rays meet, one array a sensor."""
        rows = [slots[:0]] * len(self.BEHAVIORS)
        rows[behavior] = slots

        return self._view.frames(rows)[behavior]

    def observe_all(self, slots: list[np.ndarray]) -> list[list[np.ndarray]]:
        """Cast the rays of both behaviors at once."""
        return self._view.frames(slots)

    def act(self, slots: np.ndarray) -> None:
        """Turn the agents; keep their velocity changes and kicks for the physics; reward time."""
        # the three branches as one number, counted from the columns of the agent's role
        code = self.agents.discrete.dot(_CODE).take(self._slot) + self._motion_offset
        ahead, right, turn, self._kick_power = self._motions.take(code, 1)

        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        np.add(ahead * sin, right * cos, out=self._drive[0])
        np.subtract(ahead * cos, right * sin, out=self._drive[1])

        # after the drive: turns count from the next tick
        self.yaw += turn

        if self._tick_reward is not None:
            self.agents.reward += self._tick_reward

    def controllers(self) -> None:
        """Count the fields' time; interrupt episodes at its end, blue first."""
        self.timer += _TICK

        late = self.timer >= _LATE
        if np.count_nonzero(late):
            self._end(np.flatnonzero(late), (BLUE, PURPLE), interrupted=True)

    def simulate(self) -> None:
        """Move the bodies; reward touches of the ball; score."""
        begun, blue, purple = self.physics.step(self._drive, self._kick_power)

        if np.count_nonzero(self.touch_reward):
            self.agents.reward += begun.T.ravel() * self.touch_reward

        conceded = blue + purple
        if np.count_nonzero(conceded):
            for again in range(int(conceded.max())):
                self._score(np.flatnonzero(conceded > again), scorer=np.where(blue > 0, PURPLE, BLUE))

    def pass_time(self, share: np.ndarray) -> None:
        """Set the areas' timers."""
        self.timer[:] = share * EPISODE_TICKS

    def scene_state(self) -> dict[str, Any]:
        """Return bodies, headings, timers, and the touch rewards in force."""
        return {"physics": self.physics.get_state(), **{name: getattr(self, name).copy() for name in _STATE}}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`."""
        self.physics.set_state(state["physics"])
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _score(self, fields: np.ndarray, scorer: np.ndarray) -> None:
        """Reward a goal in `fields` and end their episodes, purple first.

        A ball that begins contact with two parts of a goal at once scores twice, as in Unity: the second
        reward, with the timer at 0 again, goes into the next decision record.
        """
        slots = self._slots(fields)
        field = slots // self.agents_per_area

        gain = 1 - self.timer[field] / EPISODE_TICKS
        self.add_group_reward(slots, np.where(self._team[slots] == scorer[field], gain, -1))

        self._end(fields, (PURPLE, BLUE))

    def _end(self, fields: np.ndarray, teams: tuple[int, int], interrupted: bool = False) -> None:
        slots = self._slots(fields)
        for team in teams:
            self.end_episode(slots[self._team[slots] == team], interrupted)

        self._reset_fields(fields)

    def _reset_fields(self, fields: np.ndarray) -> None:
        """Place ball and agents anew, at rest; draws for agents by their number, then for the ball."""
        num = len(fields)
        self.timer[fields] = 0

        for agent, role in enumerate(self.ROLES):
            x = role.x + self.rng.uniform(-SPREAD_X, SPREAD_X, num)
            self.physics.place(1 + agent, fields, x, role.z)
            yaw = np.radians(self.rng.uniform(80, 100, num))
            self.yaw[agent, fields] = yaw if role.team == BLUE else -yaw

        x, z = self.rng.uniform(-BALL_SPREAD, BALL_SPREAD, (2, num))
        self.physics.place(0, fields, x, z)

    def _slots(self, fields: np.ndarray) -> np.ndarray:
        """Return the slots of `fields`, ascending."""
        return (fields[:, None] * self.agents_per_area + np.arange(self.agents_per_area)).ravel()


class SoccerTwos(SoccerScene):
    """Run SoccerTwos; parameters `ball_touch` (0.2 of it a contact begun) and `gravity` (no effect)."""

    NAME = "SoccerTwos"
    BEHAVIORS = (
        _behavior(
            "SoccerTwos?team=1", _OWN_PURPLE, "PurpleRayPerceptionSensor", "PurpleRayPerceptionSensorReverse"
        ),
        _behavior(
            "SoccerTwos?team=0", _OWN_BLUE, "BlueRayPerceptionSensor", "BlueRayPerceptionSensorReverse"
        ),
    )
    AREA_BEHAVIORS = (0, 1, 0, 1)
    AREA_GROUPS = (1, 0, 1, 0)
    ROLES = (
        Role(PURPLE, 8.19, 1.2),
        Role(BLUE, -8.19, 1.2),
        Role(PURPLE, 8.19, -1.2),
        Role(BLUE, -8.19, -1.2),
    )
    VIEWS = (_OWN_PURPLE, _OWN_BLUE)


class StrikersVsGoalie(SoccerScene):
    """Run StrikersVsGoalie; parameters as SoccerTwos."""

    NAME = "StrikersVsGoalie"
    BEHAVIORS = (
        _behavior("Striker?team=0", _STRIKER, "BlueRayPerceptionSensor", "BlueRayPerceptionSensorReverse"),
        _behavior("Goalie?team=1", _GOALIE, "PurpleGoalieRayPerceptionSensor"),
    )
    AREA_BEHAVIORS = (0, 1, 0)
    AREA_GROUPS = (0, 1, 0)
    ROLES = (
        Role(BLUE, -8.19, 1.2, forward=1.3, tick_reward=-1 / EPISODE_TICKS),
        Role(PURPLE, 9.0, 0.0, side=1.0, always_kicks=True, tick_reward=1 / EPISODE_TICKS),
        Role(BLUE, -8.19, -1.2, forward=1.3, tick_reward=-1 / EPISODE_TICKS),
    )
    VIEWS = (_STRIKER, _GOALIE)
    BLUE_CLOSED = True


def _motions(role: Role) -> np.ndarray:
    """Return what every action does, float64 [4, 27]: ahead, right (m/s), turn (rad), kick power."""
    forward, side, turn = np.indices(BRANCHES).reshape(3, -1)
    ahead = np.array([0, role.forward, -role.forward])[forward] * RUN_SPEED
    right = np.array([0, role.side, -role.side])[side] * RUN_SPEED
    ahead[side > 0] = 0  # a side action replaces the forward direction, but not the kick

    kick = np.ones(27) if role.always_kicks else (forward == 1).astype(float)
    return np.stack([ahead, right, np.array([0, -TURN_RAD, TURN_RAD])[turn], kick])
