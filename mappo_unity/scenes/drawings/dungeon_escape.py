"""How DungeonEscape looks: the dungeon with its door, the portal, three agents and the dragon."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.drawings.shapes import (
    BLUE,
    BROWN,
    DARK,
    FLOOR,
    GREEN,
    GREY,
    PURPLE,
    RED,
    WALL,
    YELLOW,
    Camera,
    Drawing,
    Shape,
    agent_cube,
    box,
    capsule,
    cylinder,
    faded,
    square_walls,
    yaw_rotation,
)
from mappo_unity.scenes.dungeon_escape import DungeonEscape
from mappo_unity.scenes.dungeon_room import (
    AGENT_HALF,
    DRAGON_HALF,
    HALVES,
    LOCK,
    NUM_AGENTS,
    PORTAL,
    PORTAL_YAW,
)
from mappo_unity.scenes.dungeon_room import (
    WALL as WALL_FACE,
)
from mappo_unity.scenes.dungeon_spawn import (
    CARRIED_KEY_HALF,
    COLUMN,
    COLUMN_RADIUS,
    TOMB_DROP,
    TOMB_LOWER_HALF,
    TOMB_UPPER_HALF,
)

WALL_SHOWN = 1.2  # m: cut off, to look inside
DOOR, CAVE = (0.015, 1.385, 12.6), (11.83, 1.83, -11.77)  # middles of the lock and of the portal


def shapes(scene: DungeonEscape, area: int) -> list[Shape]:
    """Return the room in the platform's axes, who is still in it, key and tombstone."""
    room = scene.room
    drawn = _room()
    for agent in range(NUM_AGENTS):
        if scene.enabled[area, agent]:
            slot = area * NUM_AGENTS + agent
            place, yaw = room.position[slot], float(room.yaw[slot])
            drawn += agent_cube(place, AGENT_HALF[0], yaw, BLUE)
            if scene.has_key[area, agent]:
                drawn += _key(place + [0, 0.85, 0], yaw)
    if room.dragon_present[area]:
        yaw = float(room.dragon_yaw[area])
        place, turn = room.dragon_position[area], yaw_rotation(yaw)
        drawn += agent_cube(place, DRAGON_HALF[0], yaw, RED)
        for side in (-1, 1):
            horn = place + turn @ np.array([0.45 * side, 0.95, 0.3])
            drawn.append(capsule(horn, 0.12, 0.22, DARK))
    if room.key_present[area]:
        drawn += _key(room.key_position[area], float(room.key_yaw[area]))
    if room.tomb_present[area]:
        place, turn = room.tomb_position[area], yaw_rotation(float(room.tomb_yaw[area]))
        drawn.append(box(place, TOMB_UPPER_HALF, GREY, turn))
        drawn.append(box(place - [0, TOMB_DROP, 0], TOMB_LOWER_HALF, GREY, turn))
    return drawn


def _room() -> list[Shape]:
    drawn = [box((0, -0.1, 0), (WALL_FACE, 0.1, WALL_FACE), FLOOR)]
    drawn += square_walls(WALL_FACE, WALL_FACE, WALL_SHOWN, 0.5, WALL)
    for x in (-COLUMN[0], COLUMN[0]):
        for z in (-COLUMN[1], COLUMN[1]):
            drawn.append(cylinder((x, 1.75, z), COLUMN_RADIUS, 1.75, GREY))
            drawn += [box((x, y, z), (0.85, 0.185, 0.85), GREY) for y in (0.0, 3.5)]
    drawn.append(box(DOOR, HALVES[LOCK], BROWN))
    drawn.append(box((DOOR[0], DOOR[1], DOOR[2] - HALVES[LOCK][2]), (1.1, 1.05, 0.06), GREEN))
    turn = yaw_rotation(PORTAL_YAW)
    drawn.append(box(CAVE, HALVES[PORTAL], faded(PURPLE, 0.6), turn))
    return drawn


def _key(place: np.ndarray, yaw: float) -> list[Shape]:
    turn, half = yaw_rotation(yaw), np.array(CARRIED_KEY_HALF)
    bow = place + turn @ np.array([-half[0] + half[1], 0, 0])
    teeth = place + turn @ np.array([half[0] - 0.12, -0.12, 0])
    lying = turn @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # its own y points ahead
    return [
        cylinder(bow, half[1], half[2], YELLOW, lying),
        box(place, (half[0], 0.07, half[2]), YELLOW, turn),
        box(teeth, (0.08, 0.12, half[2]), YELLOW, turn),
    ]


DRAWING = Drawing(shapes, Camera((0.6, 0.0, -0.8), 43.0, yaw=10.0, pitch=48.0))
