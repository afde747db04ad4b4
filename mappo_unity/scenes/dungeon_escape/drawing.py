"""How DungeonEscape looks: the dungeon with its door, the portal, three agents and the dragon."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.shapes import (
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
from mappo_unity.scenes.dungeon_escape.layout import (
    AGENT_HALF,
    COLUMN,
    COLUMN_BASE_HALF,
    COLUMN_RADIUS,
    DRAGON,
    HALVES,
    KEY,
    KEY_HALF,
    LOCK,
    LOCK_CENTRE,
    NUM_AGENTS,
    PORTAL,
    PORTAL_CENTRE,
    PORTAL_YAW,
    TOMB,
    TOMB_DROP,
    TOMB_LOWER_HALF,
    TOMB_UPPER_HALF,
)
from mappo_unity.scenes.dungeon_escape.layout import (
    WALL as WALL_FACE,
)
from mappo_unity.scenes.dungeon_escape.scene import DungeonEscape

WALL_SHOWN = 1.2  # m: cut off, to look inside


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

    present, things = room.present[area], room.thing[area]
    yaws = room.thing_yaw[area].tolist()
    if present[DRAGON]:
        drawn += agent_cube(things[DRAGON], HALVES[DRAGON, 0], yaws[DRAGON], RED)
        for side in (-1, 1):
            horn = things[DRAGON] + yaw_rotation(yaws[DRAGON]) @ np.array([0.45 * side, 0.95, 0.3])
            drawn.append(capsule(horn, 0.12, 0.22, DARK))

    if present[KEY]:
        drawn += _key(things[KEY], yaws[KEY])
    if present[TOMB]:
        place, turn = things[TOMB], yaw_rotation(yaws[TOMB])
        drawn.append(box(place, TOMB_UPPER_HALF, GREY, turn))
        drawn.append(box(place - [0, TOMB_DROP, 0], TOMB_LOWER_HALF, GREY, turn))

    return drawn


def _room() -> list[Shape]:
    drawn = [box((0, -0.1, 0), (WALL_FACE, 0.1, WALL_FACE), FLOOR, shadow=False)]
    drawn += square_walls(WALL_FACE, WALL_FACE, WALL_SHOWN, 0.5, WALL)

    for x in (-COLUMN[0], COLUMN[0]):
        for z in (-COLUMN[1], COLUMN[1]):
            drawn.append(cylinder((x, 1.75, z), COLUMN_RADIUS, 1.75, GREY))
            drawn += [box((x, y, z), COLUMN_BASE_HALF, GREY) for y in (0.0, 3.5)]

    drawn.append(box(LOCK_CENTRE, HALVES[LOCK], BROWN))
    front = np.array(LOCK_CENTRE) - [0, 0, HALVES[LOCK, 2]]
    drawn.append(box(front, (1.1, 1.05, 0.06), GREEN))

    turn = yaw_rotation(PORTAL_YAW)
    drawn.append(box(PORTAL_CENTRE, HALVES[PORTAL], faded(PURPLE, 0.6), turn))
    return drawn


def _key(place: np.ndarray, yaw: float) -> list[Shape]:
    turn, half = yaw_rotation(yaw), np.array(KEY_HALF)
    bow = place + turn @ np.array([-half[0] + half[1], 0, 0])
    teeth = place + turn @ np.array([half[0] - 0.12, -0.12, 0])
    lying = turn @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # its own y points ahead

    return [
        cylinder(bow, half[1], half[2], YELLOW, lying),
        box(place, (half[0], 0.07, half[2]), YELLOW, turn),
        box(teeth, (0.08, 0.12, half[2]), YELLOW, turn),
    ]


DRAWING = Drawing(shapes, Camera((0.4, 0.0, -2.0), 41.5, yaw=0.0, pitch=56.0))
