"""Boxes that slide and push each other: how many agents move which block, turns, walls, corners."""

from __future__ import annotations

import numpy as np
import pytest

from mappo_unity.scenes.push_block.bodies import SlidingBoxes
from mappo_unity.scenes.push_block.contacts import Room

GRAVITY = 14.715  # the cooperative scene's
BLOCKS = {"small": (0.5, 10.0), "large": (1.0, 100.0), "very large": (1.5, 150.0)}  # half width m, mass kg


def pushed(block: str, agents: int, ticks: int = 100, walls: float = 50.0, areas: int = 1) -> SlidingBoxes:
    """Let agents side by side push a block from its south side; it stands in the middle at the start."""
    half, mass = BLOCKS[block]
    boxes = SlidingBoxes(
        areas,
        half=np.array([[0.5, 0.5, 0.5]] * agents + [[half, 0.375, half]]),
        mass=[10.0] * agents + [mass],
        drag=[4.0] * agents + [0.5],
        turns=[False] * agents + [True],
        room=Room(np.full(2, -walls), np.full(2, walls)),
        gravity=GRAVITY,
    )
    boxes.place[:, :agents, 0] = 1.02 * (np.arange(agents) - (agents - 1) / 2)
    boxes.place[:, :agents, 1] = -half - 0.5
    push(boxes, ticks)
    return boxes


def push(boxes: SlidingBoxes, ticks: int) -> None:
    """Let all but the last body of each area go forward."""
    drive = np.zeros(boxes.yaw.shape, complex)
    drive[:, :-1] = 3j
    for _ in range(ticks):
        boxes.step(drive)
        assert boxes.deepest().max() < 0.01


@pytest.mark.parametrize(
    ("block", "agents", "force"),
    [
        ("small", 1, 10),
        ("large", 1, 100),
        ("large", 2, 100),
        ("large", 3, 100),
        ("very large", 1, 150),
        ("very large", 2, 150),
        ("very large", 3, 150),
    ],
)
def test_how_many_agents_move_a_block(block: str, agents: int, force: float) -> None:
    """All bodies as one, momentum by tick: agents give 30 kg m/s each, the floor takes 1.2 m g dt of all.

    (M + 10 n) v' = 10 n (v + 3) 0.92 + M v 0.99 - 1.2 * 14.715 * 0.02 (10 n 0.92 + M 0.99); no more than
    stops them: 24.3 a pushing agent against 35.0 for a large block and 52.4 for a very large one.
    """
    speed, mass = 0.0, 10.0 * agents
    loss = 1.2 * GRAVITY * 0.02 * (mass * 0.92 + force * 0.99)
    for _ in range(100):
        gained = mass * (speed + 3.0) * 0.92 + force * speed * 0.99
        speed = max(gained - loss, 0.0) / (mass + force)

    boxes = pushed(block, agents)
    moves = {"small": 1, "large": 2, "very large": 3}[block] <= agents
    assert moves == (speed > 1.0)
    assert boxes.motion[0, -1, 1] == pytest.approx(speed, abs=0.05)
    if not moves:
        assert abs(boxes.place[0, -1, 1]) < 0.02


def test_a_push_off_the_middle_turns_a_block() -> None:
    """From the south at its east side: its east side goes north, that is, counterclockwise from above."""
    boxes = pushed("small", 1, ticks=0)
    boxes.place[0, 0, 0] = 0.85
    drive = np.zeros((1, 2), complex)
    drive[0, 0] = 3j
    for _ in range(12):
        boxes.step(drive)
        assert boxes.deepest()[0] < 0.01
    assert boxes.yaw[0, 1] < -0.5 and boxes.yaw[0, 0] == 0.0
    assert (boxes.place[0, 1] > 0.0).tolist() == [False, True]  # and it is pushed away to the left


def test_a_spin_dies_on_the_floor() -> None:
    """Two anchors in opposite corners: 1.2 * m g r / I a second, r the half diagonal, I = m w^2 / 6."""
    boxes = pushed("large", 0, ticks=0)
    boxes.motion[0, 0, 2] = 5.0
    boxes.step(np.zeros((1, 1), complex))
    loss = 1.2 * GRAVITY * 0.02 * 0.99 * np.sqrt(2.0) / (4.0 / 6.0)
    assert boxes.motion[0, 0, 2] == pytest.approx(5.0 * 0.999 - loss)
    for _ in range(10):
        boxes.step(np.zeros((1, 1), complex))
    assert boxes.motion[0, 0, 2] == 0.0


@pytest.mark.parametrize("block", BLOCKS)
def test_blocks_stop_at_walls(block: str) -> None:
    boxes = pushed(block, 3, ticks=300, walls=6.0)
    half = BLOCKS[block][0]
    assert boxes.place[0, -1, 1] == pytest.approx(6.0 - half, abs=0.01)
    assert abs(boxes.motion[0, -1, 1]) < 0.01


def test_a_turned_block_is_pressed_flat_at_a_wall() -> None:
    """A corner that meets a wall turns the block until its face lies on the wall."""
    boxes = pushed("small", 1, ticks=0, walls=4.0)
    boxes.place[0, :, 1] += 1.0
    boxes.yaw[0, 1] = 0.3
    boxes.place[0, 0, 1] -= 0.2
    drive = np.zeros((1, 2), complex)
    drive[0, 0] = 3j
    for _ in range(100):
        boxes.step(drive)
        assert boxes.deepest()[0] < 0.02
    assert abs(boxes.yaw[0, 1]) < 0.01 and boxes.place[0, 1, 1] == pytest.approx(3.5, abs=0.02)


def test_absent_bodies_are_not_met() -> None:
    boxes = pushed("very large", 1, ticks=0)
    boxes.present[0, 1] = False
    drive = np.zeros((1, 2), complex)
    drive[0, 0] = 3j
    for _ in range(20):
        boxes.step(drive)
    assert boxes.place[0, 0, 1] > 2.0 and boxes.place[0, 1, 1] == 0.0


@pytest.mark.parametrize("speed", [12.0, 17.7, 30.0])
def test_who_is_hit_does_not_enter_the_next_one(speed: float) -> None:
    """An agent runs into a second one, which stands just before a third, corner to corner."""
    boxes = pushed("small", 3, ticks=0)
    boxes.place[0, :, 0] = 0.0
    boxes.place[0, :, 1] = -1.25, 0.0, 1.46, 20.0  # the last one is the block
    boxes.yaw[0, 1:3] = np.pi / 4
    boxes.motion[0, 0, 1] = speed

    for _ in range(20):
        boxes.step(np.zeros((1, 4), complex))
        assert boxes.deepest()[0] < 0.002
    assert boxes.place[0, 2, 1] > 1.5


def test_areas_move_alike_however_many_there_are() -> None:
    """Few areas make one system of contacts, many a system each, of which some have fewer contacts."""
    alone, few, many = (pushed("large", 3, ticks=0, walls=5.0, areas=areas) for areas in (1, 4, 40))
    for boxes in (alone, few, many):
        boxes.place[1::2, :3, 1] -= 3.0  # they come to the block later
        boxes.place[2::4, 0, 0] -= 2.0  # and past it
        push(boxes, 40)
    assert np.ptp(few.place[:, 3, 1]) > 0.5

    # All areas take the rounds of the one that needs most.
    np.testing.assert_allclose(few.place[0], alone.place[0], atol=1e-3)
    for name, state in few.get_state().items():
        expected = np.concatenate([state] * 10)
        np.testing.assert_allclose(many.get_state()[name], expected, atol=1e-9)
