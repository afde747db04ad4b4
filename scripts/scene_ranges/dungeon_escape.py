"""Where DungeonEscape's agents and dragon may be."""

from __future__ import annotations

import numpy as np

from scene_ranges.plan import square_gap
from scene_ranges.ranges import Ranges


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
