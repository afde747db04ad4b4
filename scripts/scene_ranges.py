"""The stated ranges of every scene: where an episode begins, and where bodies may be at all times.

In: a scene, whose hooks are watched while somebody plays it. Out: the lowest and highest values seen, and
faults. Constants are those of Unity's scenes (docs/scenes/), typed here once more and not read from the
scenes' modules, so that a slip there is found here. `soak_scenes.py` finds a scene's class by its
record (`mappo_unity/scenes/registry.py`).

Coordinates as in the scenes: x right, y up, z forward, metres. Legend: n begun episodes, N areas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

SLACK = 1e-6  # of a stated range, for rounding


@dataclass
class Seen:
    """A range and the extreme values seen."""

    low: float
    high: float
    lowest: float = np.inf
    highest: float = -np.inf
    count: int = 0


class Ranges:
    """Watch one scene.

    `resets` counts checked resets: of agents, or of whole fields and areas where a scene resets these.
    `seen` holds the range and the extremes of every quantity, `faults` how often a rule was broken, with
    the first case. A scene's class states what `begun` and `tick` check.
    """

    RESET_HOOK = "begin_episode"

    def __init__(self, scene: Any) -> None:
        self.scene = scene
        self.resets = 0
        self.seen: dict[str, Seen] = {}
        self.faults: dict[str, list[Any]] = {}
        self.watch(scene, self.RESET_HOOK, self._begun, self.before)
        scene.after_tick = self.tick

    def before(self) -> Any:
        """Return what `begun` needs to know of the moment before the reset."""

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check a reset of slots or areas `rows` [n]."""
        raise NotImplementedError

    def tick(self) -> None:
        """Check where bodies are at the end of a tick."""

    def within(self, what: str, values: Any, low: float, high: float) -> None:
        """Check that all values lie in a range, and keep their extremes."""
        values = np.asarray(values)
        if not values.size:
            return
        seen = self.seen.setdefault(what, Seen(low, high))
        lowest, highest = float(values.min()), float(values.max())
        seen.lowest, seen.highest = min(seen.lowest, lowest), max(seen.highest, highest)
        seen.count += values.size
        if not (lowest >= low - SLACK and highest <= high + SLACK):
            self.fault(f"{what} not in {low:g} .. {high:g}", f"{lowest!r} .. {highest!r}")

    def holds(self, rule: str, condition: Any) -> None:
        """Check that a rule holds everywhere."""
        if not np.all(condition):
            self.fault(f"not so: {rule}", f"rows {np.flatnonzero(~np.asarray(condition)).tolist()}")

    def fault(self, rule: str, case: str) -> None:
        """Count a broken rule; keep its first case."""
        self.faults.setdefault(rule, [0, f"tick {self.scene.counter}: {case}"])[0] += 1

    def watch(
        self,
        owner: Any,
        name: str,
        check: Callable[[np.ndarray, Any], None],
        before: Callable[[], Any] | None = None,
    ) -> None:
        """Call `check(rows, before())` after every call of the method `name` of `owner`."""
        method = getattr(owner, name)

        def watched(rows: np.ndarray, *others: Any) -> Any:
            remembered = before() if before else None
            result = method(rows, *others)
            check(rows, remembered)
            return result

        setattr(owner, name, watched)

    def _begun(self, rows: np.ndarray, before: Any) -> None:
        self.resets += len(rows)
        self.begun(rows, before)


class Ball3D(Ranges):
    """3DBall: cube turned by up to 10 degrees about x, then z; ball 4 m above it, at rest."""

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check cube and ball; the ball's position counts from the cube."""
        w, x, y, z = self.scene.cube_rotation[rows].T
        self.within("begin: cube about x, degrees", np.degrees(2 * np.arctan2(x, w)), -10, 10)
        self.within("begin: cube about z, degrees", np.degrees(2 * np.arctan2(z, w)), -10, 10)
        self.holds("cube turned about x, then z, only", np.abs(w * y + x * z) < SLACK)
        ball = self.scene.ball_position[rows]
        self.within("begin: ball x", ball[:, 0], -1.5, 1.5)
        self.within("begin: ball y", ball[:, 1], 4, 4)
        self.within("begin: ball z", ball[:, 2], -1.5, 1.5)
        self.within("begin: ball velocity", self.scene.ball_velocity[rows], 0, 0)

    def tick(self) -> None:
        """Check the cube's tilt and the ball, which may pass the limits of a fall by one tick's way.

        A ball on a corner of the cube is lifted to 4.7 m at most; a turn about one axis changes the other
        component a little beyond its limit.
        """
        x, y, z = self.scene.ball_position.T
        self.within("ball y", y, -2.3, 4.8)
        self.within("ball |x|, |z|", np.maximum(np.abs(x), np.abs(z)), 0, 3.3)
        self.within("cube quaternion x, z", self.scene.cube_rotation[:, 1::2], -0.35, 0.35)


class Basic(Ranges):
    """Basic: place 10 of 0 to 20, a new agent every episode."""

    RESET_HOOK = "enable"

    def before(self) -> int:
        """Return the next free agent id."""
        return int(self.scene.agents.next_id)

    def begun(self, rows: np.ndarray, before: int) -> None:
        """Check the place and the id."""
        self.within("begin: place", self.scene.position[rows], 10, 10)
        self.holds("ids of new agents are new", self.scene.agents.agent_id[rows] >= before)

    def tick(self) -> None:
        """Check the places between the goals."""
        self.within("place", self.scene.position, 8, 16)


WALKER_AT_REST = {
    "hips": (0, 0.953, 0),
    "spine": (0, 1.17839, 0),
    "chest": (0, 1.44404, 0),
    "head": (0, 1.8935, 0),
    "armL": (-0.4125, 1.44404, 0),
    "forearmL": (-0.7425, 1.44404, 0),
    "handL": (-0.9735, 1.44404, 0),
    "armR": (0.4125, 1.44404, 0),
    "forearmR": (0.7425, 1.44404, 0),
    "handR": (0.9735, 1.44404, 0),
    "thighL": (-0.132, 0.689, 0),
    "shinL": (-0.132, 0.359, 0),
    "footL": (-0.132, 0.161, 0),
    "thighR": (0.132, 0.689, 0),
    "shinR": (0.132, 0.359, 0),
    "footR": (0.132, 0.161, 0),
}
WALKER_ORDER = (
    *("hips", "chest", "spine", "head", "thighL", "shinL", "footL", "thighR", "shinR", "footR"),
    *("armL", "forearmL", "handL", "armR", "forearmR", "handR"),
)


class Walker(Ranges):
    """Walker: a T-pose in the middle with any yaw, a goal speed of 0.1 to 10 m/s; the target stays."""

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.rest = np.array([WALKER_AT_REST[name] for name in WALKER_ORDER])
        self.watch(scene, "_place_targets", self._target_placed)

    def before(self) -> np.ndarray | None:
        """Return where the targets are."""
        return self.scene.physics.target_position.copy() if self.scene.started else None

    def begun(self, rows: np.ndarray, before: np.ndarray | None) -> None:
        """Check pose, speeds, contact flags, goal speed, target."""
        physics = self.scene.physics
        w, y = physics.rotation[rows, :1, 0], physics.rotation[rows, :1, 2]
        self.within("begin: yaw, degrees", np.degrees(2 * np.arctan2(y, w)) % 360, 0, 360)
        turn = np.concatenate([w, 0 * w, y, 0 * w], axis=1)[:, None]
        self.within("begin: rotations other than the yaw", physics.rotation[rows] - turn, 0, 0)
        sin, cos = 2 * w * y, 1 - 2 * y * y
        x, up, z = self.rest.T
        rest = np.stack([x * cos + z * sin, up + 0 * cos, z * cos - x * sin], axis=2)
        self.within("begin: parts beside the T-pose", physics.position[rows] - rest, -1e-5, 1e-5)
        self.within("begin: angles", physics.angle[rows], 0, 0)
        self.within("begin: velocity and spin", [physics.velocity[rows], physics.spin[rows]], 0, 0)
        self.within("begin: goal speed", self.scene.goal_speed[rows], 0.1, 10)
        self.holds("contact flags are cleared", ~self.scene.grounded[rows].any(axis=1))
        if before is not None:
            self.within("begin: target moved by", physics.target_position - before, 0, 0)

    def tick(self) -> None:
        """Check that parts are above the ground and nothing flies away; Unity's walls are 12.375 m away."""
        physics = self.scene.physics
        self.within("part x, z", physics.position[:, :, ::2], -12.375, 12.375)
        self.within("part y", physics.position[:, :, 1], 0.1, 4.0)
        self.within("part speed, along an axis", physics.velocity, -40, 40)
        self.within("target x, z", physics.target_position[:, ::2], -12.6, 12.6)
        self.within("target y", physics.target_position[:, 1], 0.2, 3.0)

    def _target_placed(self, rows: np.ndarray, before: None) -> None:
        offset = self.scene.physics.target_position[rows] - (0.0, 1.0, 1.0)
        self.within("target placed: way from its anchor", np.hypot(offset[:, 0], offset[:, 2]), 0, 9)
        self.within("target placed: y above its anchor", offset[:, 1], 0, 0)


class GridFoodCollector(Ranges):
    """GridFoodCollector: agents within 45 m, any whole degree, at rest; food falls in within 45 m."""

    AGENTS = 5

    def before(self) -> np.ndarray | None:
        """Return where the food is, unless it is to be made anew."""
        return None if self.scene._new_food else self.scene.physics.ball_position.copy()

    def begun(self, rows: np.ndarray, before: np.ndarray | None) -> None:
        """Check agents and food; heights count from the floor, 0.5 m above Unity's origin."""
        area, agent = np.divmod(rows, self.AGENTS)
        scene, physics = self.scene, self.scene.physics
        self.within("begin: agent x, z", physics.agent_position[::2, area, agent], -45, 45)
        self.within("begin: agent y", physics.agent_position[1, area, agent], 1.5, 1.5)
        self.within("begin: agent velocity", physics.agent_velocity[:, area, agent], 0, 0)
        self.within("begin: agent yaw, whole degrees", scene.yaw_degrees[area, agent], 0, 359)
        yaw = np.degrees(physics.agent_yaw[area, agent])
        self.within("begin: body's yaw beside it", yaw - scene.yaw_degrees[area, agent], 0, 0)
        self.holds("agents are not frozen", ~scene.frozen[area, agent])
        if before is None:
            self.within("begin: new food x, z", physics.ball_position[::2], -45, 45)
            self.within("begin: new food y", physics.ball_position[1], 0.75, 0.75)  # lifted: the page says so
        else:
            self.within("begin: food moved by", physics.ball_position - before, 0, 0)

    def tick(self) -> None:
        """Check food that falls in, and that bodies are between floor and walls (faces at 50 m).

        An agent's centre may be 0.1 m past the face for a tick, as in DungeonEscape.
        """
        physics = self.scene.physics
        x, y, z = physics.ball_position
        new = y == 2.5
        if new.any():
            self.within("eaten food falls in at x, z", [x[new], z[new]], -45, 45)
        self.within("food x, z", physics.ball_position[::2], -50, 50)
        self.within("food y", y, 0.6, 5.0)
        self.within("agent x, z", physics.agent_position[::2], -50.1, 50.1)
        self.within("agent y", physics.agent_position[1], 0.3, 5.0)


class Soccer(Ranges):
    """Both soccer scenes: ball within 2.5 m, agents within 5 m of their places, yaw within 10 degrees."""

    RESET_HOOK = "_reset_fields"
    AGENTS: tuple[tuple[str, int, float], ...] = ()  # name, side (-1 blue, 1 purple), middle of x

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check all bodies of fields `rows` [n]; the places of z follow in a scene's own class."""
        physics = self.scene.physics
        x, _ = physics.position[:, :, rows]
        self.within("begin: ball x, z", physics.position[:, 0, rows], -2.5, 2.5)
        self.within("begin: all velocities", physics.velocity[:, :, rows], 0, 0)
        self.within("begin: ball spin", physics.spin[rows], 0, 0)
        self.within("begin: timer", self.scene.timer[rows], 0, 0)
        for agent, (name, side, middle) in enumerate(self.AGENTS):
            self.within(f"begin: {name} x", x[1 + agent], middle - 5, middle + 5)
            yaw = -side * np.degrees(self.scene.yaw[agent, rows])
            self.within(f"begin: {name} |yaw|, degrees", yaw, 80, 100)

    def tick(self) -> None:
        """Check that discs are inside the pitch: how far they reach beyond its faces.

        A ball that an agent drives into the corner between two walls is stopped at one of them, and is up to
        0.3 m deep in the other for a tick.
        """
        position = self.scene.physics.position
        x, z = np.abs(position[0]), np.abs(position[1])
        radius = np.where(np.arange(len(x)) == 0, 0.6242, 0.5)[:, None]
        self.within("reach beyond the long sides", z + radius - 7.508, -8, 0.35)
        corner = np.sqrt(0.75) * x + 0.5 * z + radius - 15.497
        self.within("reach beyond the corner walls", np.where(z > 4.3, corner, -1.0), -16, 0.35)
        self.within("reach beyond the nets' backs", x + radius - 17.373, -18, 0.15)
        self.within("reach beyond the nets' sides", np.where(x > 15.6, z + radius - 4.15, -1.0), -5, 0.15)
        self.within("ball |x|", x[0], 0, 15.127)


class SoccerTwos(Soccer):
    """SoccerTwos: one agent of each team on each side."""

    AGENTS = (("purple", 1, 8.19), ("blue", -1, -8.19), ("purple", 1, 8.19), ("blue", -1, -8.19))

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check the places of z as well."""
        super().begun(rows, before)
        z = self.scene.physics.position[1, 1:, rows].T  # [agents, n]
        for team in (0, 1):
            self.within("begin: smaller z of a team", z[team::2].min(axis=0), -1.2, -1.2)
            self.within("begin: larger z of a team", z[team::2].max(axis=0), 1.2, 1.2)


class StrikersVsGoalie(Soccer):
    """StrikersVsGoalie: strikers on both sides, the goalie in the middle; a block in the blue goal."""

    AGENTS = (("striker", -1, -8.19), ("goalie", 1, 9.0), ("striker", -1, -8.19))

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check the places of z as well."""
        super().begun(rows, before)
        z = self.scene.physics.position[1, 1:, rows].T
        self.within("begin: striker's z, larger", np.maximum(z[0], z[2]), 1.2, 1.2)
        self.within("begin: striker's z, smaller", np.minimum(z[0], z[2]), -1.2, -1.2)
        self.within("begin: goalie's z", z[1], 0, 0)

    def tick(self) -> None:
        """Check the block as well."""
        super().tick()
        x, z = self.scene.physics.position
        reach = np.array([0.6242, 0.5, 0.5, 0.5])[:, None] - x - 15.01
        self.within("reach beyond the block", np.where(np.abs(z) < 3.957, reach, -1.0), -34, 0.15)


class DungeonEscape(Ranges):
    """DungeonEscape: free spots within 6.25 m, dragon at a start by the platform's turn, 1 to 7 m/s."""

    RESET_HOOK = "_reset_areas"
    SPOT_HALF = 2.5  # of the square around a spot that nothing may overlap, at the height of 1 m
    TOMB, DRAGON, KEY = 1, 3, 4  # in the scene's arrays of things

    def before(self) -> dict[str, np.ndarray]:
        """Return the bodies of the ended episode."""
        scene, room = self.scene, self.scene.room
        return {
            "agents": room.position.reshape(-1, 3, 3).copy(),
            "yaw": room.yaw.reshape(-1, 3).copy(),
            "enabled": scene.enabled.copy(),
            "ids": scene.agents.agent_id.reshape(-1, 3).copy(),
            "thing": room.thing.copy(),
            "thing_yaw": room.thing_yaw.copy(),
            "present": room.present.copy(),
        }

    def begun(self, rows: np.ndarray, before: dict[str, np.ndarray]) -> None:
        """Check areas `rows` [n]."""
        scene, room = self.scene, self.scene.room
        place = room.position.reshape(-1, 3, 3)[rows]
        self.within("begin: agent x, z", place[:, :, ::2], -6.25, 6.25)
        self.within("begin: agent y", place[:, :, 1], 1, 1)
        self.within("begin: agent velocity", room.velocity.reshape(-1, 3, 3)[rows], 0, 0)
        yaw = np.degrees(room.yaw.reshape(-1, 3)[rows])
        self.within("begin: agent yaw, degrees", yaw, 0, 360)
        self._spots(rows, place, yaw, before)
        dragon = room.thing[rows, self.DRAGON]
        self.within("begin: dragon y", dragon[:, 1], 0.79, 0.79)
        starts = np.array([[0, 8], [-8, 0], [0, -8], [8, 0]])
        away = np.abs(dragon[:, None, ::2] - starts).max(axis=2)
        self.within("begin: dragon beside the nearest of its starts", away.min(axis=1), 0, 0)
        self.within("begin: which start", away.argmin(axis=1), 0, 3)
        self.within("begin: dragon speed", room.dragon_speed[rows], 1, 7)
        self.within("begin: timer", scene.timer[rows], 0, 0)
        present = room.present[rows]
        there = scene.enabled[rows].all(axis=1) & present[:, self.DRAGON] & (scene.remaining[rows] == 3)
        self.holds("all agents and the dragon are there", there)
        shown = present[:, self.KEY] | present[:, self.TOMB] | scene.has_key[rows].any(axis=1)
        self.holds("key and tombstone are hidden, nobody holds a key", ~shown)
        ids = scene.agents.agent_id.reshape(-1, 3)[rows]
        kept = ids == before["ids"][rows]
        self.holds("only agents that were away have new ids", (kept == before["enabled"][rows]).all(axis=1))
        groups = scene.agents.group_id.reshape(-1, 3)[rows]
        self.holds("agents are in their area's group", (groups == rows[:, None] + 1).all(axis=1))

    def tick(self) -> None:
        """Check that agents and dragon are within the walls (faces at 12.5 m) and above the floor.

        Detection is discrete, as in Unity: an agent that runs at 30 m/s goes on for up to 0.6 m before the
        wall stops it, so that its centre may be 0.1 m past the face for a tick.
        """
        room = self.scene.room
        self.within("agent x, z", room.position[:, ::2], -12.6, 12.6)
        self.within("agent y", room.position[:, 1], 0.3, 3.0)
        dragon = room.thing[room.present[:, self.DRAGON], self.DRAGON]
        self.within("dragon x, z", dragon[:, ::2], -12.5, 12.5)
        self.within("dragon y", dragon[:, 1], 0.74, 0.8)

    def _spots(
        self, rows: np.ndarray, place: np.ndarray, yaw: np.ndarray, before: dict[str, np.ndarray]
    ) -> None:
        """Check that nothing overlapped the squares around the spots when they were drawn, in turn."""
        beside = np.abs(np.abs(place[:, :, ::2]) - (4.5, 4.0)) - self.SPOT_HALF
        column = np.hypot(*np.maximum(beside, 0).transpose(2, 0, 1)) - 0.718
        self.within("begin: spot's square from a column", column, 0, 10)
        for number in range(3):
            for other in range(3):
                if other < number:  # placed before
                    body, turn, there = place[:, other], yaw[:, other], np.ones(len(rows), bool)
                else:
                    body, turn = before["agents"][rows, other], np.degrees(before["yaw"][rows, other])
                    there = before["enabled"][rows, other] & (np.abs(body[:, 1] - 1) < 0.49)
                self._apart("agent", place[there, number], body[there], turn[there], (0.5, 0.5))
            for thing, name, half_y, half in (
                (self.DRAGON, "dragon", 0.75, (0.75, 0.75)),
                (self.TOMB, "tombstone", 0.71, (0.525, 0.165)),
            ):
                body, turn = before["thing"][rows, thing], np.degrees(before["thing_yaw"][rows, thing])
                there = before["present"][rows, thing] & (np.abs(body[:, 1] - 1) < half_y - 0.01)
                self._apart(name, place[there, number], body[there], turn[there], half)

    def _apart(
        self, what: str, spot: np.ndarray, body: np.ndarray, turn: np.ndarray, half: tuple[float, float]
    ) -> None:
        gap = square_gap(body[:, ::2] - spot[:, ::2], np.radians(turn), half, self.SPOT_HALF)
        self.within(f"begin: spot's square from a body: {what}", gap, 0, np.inf)


class Hallway(Ranges):
    """Hallway: O at x within 3 m or X in the middle, agent at the far end, goals by a coin."""

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.last = np.full((scene.num_areas, 2), np.nan)  # x, z a tick ago

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check symbol, agent and goals."""
        scene = self.scene
        shows_x, symbol = scene.shows_x[rows], scene.symbol[rows]
        self.within("begin: O block x", symbol[~shows_x, 0], -3, 3)
        self.within("begin: X block x", symbol[shows_x, 0], 0, 0)
        self.within("begin: block y", symbol[:, 1], 2.5, 2.5)
        self.within("begin: block z", symbol[:, 2], -5, 5)
        self.within("begin: agent x", scene.position[rows, 0], -3, 3)
        self.within("begin: agent y", scene.position[rows, 1], 1.5, 1.5)
        self.within("begin: agent z", scene.position[rows, 2], -20, -10)
        self.within("begin: agent velocity", scene.velocity[rows], 0, 0)
        self.within("begin: agent yaw, degrees", np.degrees(scene.yaw[rows]), 0, 360)
        self.within("begin: side of O, -1 or 1", np.abs(scene.o_side[rows]), 1, 1)
        self.within("begin: symbol and side, 0 .. 3", 2 * shows_x + (scene.o_side[rows] > 0), 0, 3)
        self.last[rows] = np.nan

    def tick(self) -> None:
        """Check that the agent's box is inside the room, and did not pass through the block."""
        scene = self.scene
        place = scene.position[:, ::2]
        extent = 0.5 * (np.abs(np.sin(scene.yaw)) + np.abs(np.cos(scene.yaw)))
        self.within("reach beyond the side walls", np.abs(place[:, 0]) + extent - 9.5, -10, 0.15)
        self.within("reach beyond the end walls", np.abs(place[:, 1]) + extent - 24.75, -25, 0.15)
        self.within("agent y", scene.position[:, 1], 1, 1.5)
        block = np.concatenate([scene.symbol[:, None, ::2], np.full((len(place), 1, 2), (2.0, 0.5))], axis=2)
        self.holds("nobody passes through the block", ~passed(self.last, place, block))
        self.last = place.copy()


class WallJump(Ranges):
    """WallJump: agent on a line, block in a rectangle, one of five configurations."""

    HEIGHT = np.array([0.0, 4.0, 8.0, 8.0, 8.0])
    BIG = np.array([0, 0, 1, 1, 1])

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.last = np.full((scene.num_areas, 2), np.nan)  # x, z a tick ago
        self.watch(scene, "_place_blocks", self._block_placed)
        fixed_update = scene.fixed_update

        def watched() -> None:
            drawn = self.scene.configuration.copy() if self.scene.started else None
            fixed_update()
            self._configured(drawn)

        scene.fixed_update = watched

    def before(self) -> np.ndarray:
        """Return the headings, which a reset keeps."""
        return self.scene.bodies.yaw.copy()

    def begun(self, rows: np.ndarray, before: np.ndarray) -> None:
        """Check the agent and the drawn configuration."""
        bodies = self.scene.bodies
        self.within("begin: agent x", bodies.position[rows, 0], -9, 9)
        self.within("begin: agent y", bodies.position[rows, 1], 1, 1)
        self.within("begin: agent z", bodies.position[rows, 2], -12, -12)
        self.within("begin: velocities", [bodies.velocity[rows], bodies.block_velocity[rows]], 0, 0)
        self.within("begin: yaw changed by", bodies.yaw - before, 0, 0)
        self.within("begin: configuration", self.scene.configuration[rows], 0, 4)
        self.last[rows] = np.nan

    def tick(self) -> None:
        """Check that bodies are on the platform or at most a tick past its edge, and not through a wall.

        An agent on the block has ground up to 1.5 m beyond the edge. A block gets as fast as agents run (31
        m/s, 0.62 m in a tick), and is pushed out of one by 0.2 m at most.
        """
        bodies = self.scene.bodies
        place = bodies.position[:, ::2]
        self.within("agent x", place[:, 0], -13, 13)
        self.within("agent z", place[:, 1], -17, 9)
        self.within("agent y", bodies.position[:, 1], 0.3, 12)
        self.within("block x", bodies.block[:, 0], -11.35, 11.35)
        self.within("block y", bodies.block[:, 1], 1.5, 1.5)
        self.within("block z", bodies.block[:, 2], -15.35, 7.35)
        wall = np.broadcast_to([0.0, -1.98, 10.0, 0.75], (len(place), 1, 4))
        below = bodies.position[:, 1] < bodies.wall_height / 2
        self.holds("nobody passes through the wall", ~(passed(self.last, place, wall) & below))
        self.last = place.copy()

    def _block_placed(self, rows: np.ndarray, before: None) -> None:
        block = self.scene.bodies.block[rows]
        self.within("begin: block x", block[:, 0], -8.1, 8.1)
        self.within("begin: block y", block[:, 1], 1.5, 1.5)
        self.within("begin: block z", block[:, 2], -6.27 - 3.5, -6.27 + 3.5)

    def _configured(self, drawn: np.ndarray | None) -> None:
        if drawn is None or not (drawn >= 0).any():
            return
        slots = np.flatnonzero(drawn >= 0)
        height = self.scene.bodies.wall_height[slots]
        self.within("wall's height beside the drawn one", height - self.HEIGHT[drawn[slots]], 0, 0)
        behavior = self.scene.agents.behavior[slots]
        self.within("behavior beside the drawn one", behavior - self.BIG[drawn[slots]], 0, 0)


class PushBlock(Ranges):
    """PushBlock: block, then agent on free spots within 6.25 m, off the goal (its face is at z -8.35)."""

    SPOT_HALF = 2.5  # of the square around a spot that nothing may overlap, at the height of 1 m

    def before(self) -> dict[str, np.ndarray]:
        """Return the bodies of the ended episode."""
        boxes = self.scene.boxes
        return {name: getattr(boxes, name).copy() for name in ("place", "yaw", "height")}

    def begun(self, rows: np.ndarray, before: dict[str, np.ndarray]) -> None:
        """Check agent and block: at rest, on spots that nothing is near, headings kept."""
        boxes = self.scene.boxes
        place = boxes.place[rows]
        self.within("begin: x", place[:, :, 0], -6.25, 6.25)
        self.within("begin: z", place[:, :, 1], -8.35 + self.SPOT_HALF, 6.25)
        self.within("begin: y", boxes.height[rows], 1, 1)
        self.within("begin: velocities", [np.abs(boxes.motion[rows]).max(), boxes.fall[rows].max()], 0, 0)
        self.within("begin: yaw changed by", boxes.yaw[rows] - before["yaw"][rows], 0, 0)
        self.within("begin: width of the block", 2 * boxes.half[rows, 1], 2, 2)
        self._apart("the agent's spot from the block", place[:, 0], place[:, 1], boxes.yaw[rows, 1], 1.0)

        # Where the agent has been: its top, 1 m above the floor, is in the way of both.
        old, turn = before["place"][rows, 0], before["yaw"][rows, 0]
        for body, name in ((0, "agent's"), (1, "block's")):
            self._apart(f"the {name} spot from the agent's last place", place[:, body], old, turn, 0.5)

    def tick(self) -> None:
        """Check that bodies are inside the room, above the floor, and not in each other."""
        boxes = self.scene.boxes
        agent, block = boxes.place[:, 0], boxes.place[:, 1]
        yaw = boxes.yaw[:, 0]
        reach = 0.5 * (np.abs(np.sin(yaw)) + np.abs(np.cos(yaw)))
        for name, place, extent in (("agent", agent, reach), ("block", block, 1.0)):
            self.within(
                f"{name}: reach beyond the side walls", np.abs(place[:, 0]) + extent - 12.5, -13, 0.05
            )
            self.within(f"{name}: reach beyond the wall ahead", place[:, 1] + extent - 12.5, -22, 0.05)
            self.within(f"{name}: reach into the goal", -8.35 - place[:, 1] + extent, -22, 0.05)
        self.within("agent y", boxes.height[:, 0], 0.5, 1)
        self.within("block y", boxes.height[:, 1], 0.375, 1)
        self.within("block yaw", boxes.yaw[:, 1], 0, 0)
        self.within("gap of agent and block", square_gap(agent - block, yaw, (0.5, 0.5), 1.0), -0.05, 30)

    def _apart(self, what: str, spot: np.ndarray, body: np.ndarray, turn: np.ndarray, half: float) -> None:
        gap = square_gap(body - spot, turn, (half, half), self.SPOT_HALF)
        self.within(f"begin: {what}", gap, 0, np.inf)


class CooperativePushBlock(Ranges):
    """CooperativePushBlock: agents, then six blocks on free spots within 6.25 m, any heading."""

    RESET_HOOK = "_reset_areas"
    SPOT_HALF = 1.5  # of the square around a spot that nothing may overlap, at the height of 1 m
    HALF = np.array([0.5] * 5 + [1.0] * 2 + [1.5] * 2)
    PAIRS = np.triu_indices(9, 1)

    def before(self) -> dict[str, np.ndarray]:
        """Return the bodies of the ended episode."""
        boxes = self.scene.boxes
        return {name: getattr(boxes, name).copy() for name in ("place", "yaw")}

    def begun(self, rows: np.ndarray, before: dict[str, np.ndarray]) -> None:
        """Check areas `rows` [n]: everything is there, at rest, on spots that were free in turn."""
        scene, boxes = self.scene, self.scene.boxes
        place, yaw = boxes.place[rows], boxes.yaw[rows]
        self.within("begin: x, z", place, -6.25, 6.25)
        self.within("begin: y", boxes.height[rows], 1, 1)
        self.within("begin: yaw, degrees", np.degrees(yaw), 0, 360)
        self.within("begin: velocities", [np.abs(boxes.motion[rows]).max(), boxes.fall[rows].max()], 0, 0)
        self.within("begin: timer", scene.timer[rows], 0, 0)
        self.holds("all blocks are there", boxes.present[rows].all(axis=1))
        for body in range(9):
            for other in range(9):
                # Placed before; or an agent where it has been, its top 1 m above the floor.
                there, turn = place[:, other], yaw[:, other]
                if other >= body:
                    there, turn = before["place"][rows, other], before["yaw"][rows, other]
                if other < max(body, 3):
                    half = (self.HALF[other], self.HALF[other])
                    gap = square_gap(there - place[:, body], turn, half, self.SPOT_HALF)
                    self.within("begin: spot's square from a body", gap, 0, np.inf)

    def tick(self) -> None:
        """Check that bodies are inside the room, above the floor, not in each other, and not in the goal."""
        boxes = self.scene.boxes
        spread = np.abs(np.sin(boxes.yaw)) + np.abs(np.cos(boxes.yaw))
        beyond = np.abs(boxes.place).max(axis=2) + self.HALF * spread - 12.5
        self.within("reach beyond the walls", beyond[boxes.present], -13, 0.05)
        self.within("agent y", boxes.height[:, :3], 0.5, 1)
        self.within("block y", boxes.height[:, 3:], 0.375, 1)
        self.within("timer", self.scene.timer, 0, 5000)
        in_goal = (boxes.place[:, 3:, 1] - (self.HALF * spread)[:, 3:] < -8.35) & boxes.present[:, 3:]
        self.holds("blocks in the goal vanish", ~in_goal)
        self.holds("some block is left", boxes.present[:, 3:].any(axis=1))
        one, other = self.PAIRS
        both = boxes.present[:, one] & boxes.present[:, other]
        self.within("gap of two bodies", self._gaps(one, other)[both], -0.05, 40)

    def _gaps(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the gaps [N, P] of boxes and others, in the frames of the others."""
        boxes = self.scene.boxes
        x, z = (boxes.place[:, one] - boxes.place[:, other]).reshape(-1, 2).T
        yaw = boxes.yaw[:, other].ravel()
        offset = np.stack([x * np.cos(yaw) - z * np.sin(yaw), x * np.sin(yaw) + z * np.cos(yaw)], axis=1)
        shape = (self.scene.num_areas, len(one))
        half, square = (np.broadcast_to(self.HALF[body], shape).ravel() for body in (one, other))
        gap = square_gap(offset, boxes.yaw[:, one].ravel() - yaw, (half, half), square)
        return gap.reshape(shape)


def _pyramids_walls() -> np.ndarray:
    """Return the inner walls as x, z, half sizes along x and z, [16, 4]."""
    crosses = [
        (x, z, *half) for x in (-16.55, 16.55) for z in (-16.56, 16.56) for half in ((7.575, 0.5), (0.5, 7.5))
    ]
    sides = [(x, z, 7.25, 0.5) for x in (-42.25, 42.25) for z in (-16.5, 16.5)]
    return np.array([*crosses, *sides, *((z, x, 0.5, 7.25) for x, z, _, _ in sides)])


class Pyramids(Ranges):
    """Pyramids: nine things in a permutation of nine zones, each within 11.905 m of its zone's centre."""

    WALLS = _pyramids_walls()

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.last = np.full((scene.num_areas, 2), np.nan)  # x, z a tick ago
        self.watch(scene.bricks, "appear", self._appeared)
        _ = scene.bricks._fall  # made when first needed: not a growth of memory

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check the zones and what stands in them."""
        scene, bodies = self.scene, self.scene.bodies
        agent, switch = bodies.position[rows], bodies.switch_position[rows]
        spots = np.concatenate(
            [
                agent[:, None, ::2],
                switch[:, None, ::2],
                scene.brick_spot[rows][:, None],
                bodies.stone_root[rows],
            ],
            axis=1,
        )
        zone = np.round(spots / 30)
        self.within("begin: things from their zone's centre, x, z", spots - 30 * zone, -11.905, 11.905)
        self.within("begin: zones of the agent, x", zone[:, 0, 0], -1, 1)
        taken = np.sort((zone + 1) @ (1, 3), axis=1)
        self.holds("every zone is taken once", (taken == np.arange(9)).all(axis=1))
        self.within("begin: agent y", agent[:, 1], 2, 2)
        self.within("begin: agent velocity", bodies.velocity[rows], 0, 0)
        degrees = np.degrees(bodies.yaw[rows])
        self.within("begin: agent yaw, degrees", degrees, 0, 359)
        self.within("begin: agent yaw beside whole degrees", degrees - np.round(degrees), 0, 0)
        self.within("begin: switch's box y", switch[:, 1], 4, 4)
        self.within("begin: switch yaw", bodies.switch_yaw[rows], 0, 0)
        self.holds("switch off, no bricks", ~(scene.switch_on[rows] | scene.bricks.present[rows]))
        self.last[rows] = np.nan

    def tick(self) -> None:
        """Check that agent and bricks are within the outer walls, and the agent not through inner ones.

        At 42 m/s an agent's centre may be 0.35 m past a face for a tick, as in DungeonEscape.
        """
        scene, bodies = self.scene, self.scene.bodies
        place = bodies.position[:, ::2]
        self.within("agent x", place[:, 0], -49.5 - 0.35, 49.5 + 0.35)
        self.within("agent z", place[:, 1], -49.6 - 0.35, 49.1 + 0.35)
        self.within("agent y", bodies.position[:, 1], 0.3, 2.0)
        self.within("switch's box y", bodies.switch_position[:, 1], 2.0, 4.0)
        self.holds("nobody passes through an inner wall", ~passed(self.last, place, self.WALLS[None]))
        self.last = place.copy()
        present = np.flatnonzero(scene.bricks.present)
        if present.size:
            cubes = scene.bricks.bodies[present]
            self.within("brick x", cubes[:, :, 0], -49.5, 49.5)
            self.within("brick y", cubes[:, :, 1], 0.4, 8.1)
            self.within("brick z", cubes[:, :, 2], -49.6, 49.1)
            length = np.einsum("nbi,nbi->nb", cubes[:, :, 3:], cubes[:, :, 3:])
            self.within("brick's quaternion, length squared", length, 1 - 1e-5, 1 + 1e-5)

    def _appeared(self, rows: np.ndarray, before: None) -> None:
        goal = self.scene.bricks.bodies[rows, -1, :3] - (0.45, 8.0, 0.8)
        self.within("bricks appear: goal's root x, z, from the spot", goal[:, ::2] - self._spot(rows), 0, 0)
        self.within("bricks appear: goal's root y", goal[:, 1], 0, 0)

    def _spot(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(self.scene.brick_spot[rows])


def square_gap(
    offset: np.ndarray,
    turn: np.ndarray,
    half: tuple[np.ndarray | float, np.ndarray | float],
    square: np.ndarray | float,
) -> np.ndarray:
    """Return the gap [n] along the best separating axis between rectangles and upright squares, in plan.

    `offset` [n, 2] (x, z) of a rectangle with half sizes `half`, turned by `turn` [n] rad (clockwise from
    above), from a square of half size `square` along the axes; negative where they overlap.
    """
    sin, cos = np.sin(turn), np.cos(turn)
    x, z = offset.T
    along_x = np.abs(x) - square - half[0] * np.abs(cos) - half[1] * np.abs(sin)
    along_z = np.abs(z) - square - half[0] * np.abs(sin) - half[1] * np.abs(cos)
    reach = square * (np.abs(sin) + np.abs(cos))
    right = np.abs(x * cos - z * sin) - half[0] - reach
    ahead = np.abs(x * sin + z * cos) - half[1] - reach
    return np.maximum.reduce([along_x, along_z, right, ahead])


def passed(start: np.ndarray, end: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Return bool [N]: who got from one side of a thin wall to its other side in one tick.

    `start`, `end` [N, 2]: x, z (NaN: begun since); `walls` [N or 1, K, 4]: x, z, half sizes along x and z.
    """
    before, after = start[:, None] - walls[..., :2], end[:, None] - walls[..., :2]
    half = walls[..., 2:]
    changed = before * after < 0  # [N, K, 2]
    beside = np.maximum(np.abs(before), np.abs(after)) < half
    thin_x = half[..., 0] < half[..., 1]
    through = np.where(thin_x, changed[..., 0] & beside[..., 1], changed[..., 1] & beside[..., 0])
    return np.asarray(through.any(axis=1))
