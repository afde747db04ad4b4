"""One tick of a scene in Unity's order, cut in two where Unity waits for Python."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mlagents_envs.base_env import DecisionSteps, TerminalSteps

if TYPE_CHECKING:
    from mappo_unity.scenes.core.scene import Scene


def start(scene: Scene) -> None:
    """Run to the first exchange; of a scene that `is_staggered` the areas' times are random then."""
    run_to_exchange(scene)
    if scene.is_staggered:
        scene.pass_time(scene.rng.random(scene.num_areas))


def run_to_exchange(scene: Scene) -> None:
    """Run ticks until some agent reports: requests a decision, or has ended."""
    while not begin_tick(scene):
        finish_tick(scene)


def begin_tick(scene: Scene) -> bool:
    """Run a tick up to the exchange with Python; return whether there is one."""
    agents, exchange = scene.agents, scene.exchange
    scene.fixed_update()
    if not scene.started:
        scene.begin_episode(agents.order)

    # `decides` is called before the counter moves: Unity's requesters look at the academy's old count.
    decides = scene.decides()
    if decides is True:
        exchange.ask(agents.order)
    else:
        exchange.ask(agents.order[:0] if decides is False else agents.order[decides[agents.order]])
    scene.counter += 1
    agents.count_tick()

    # The very first tick is an exchange even where nobody decides: reset() must end.
    if not exchange.asked.size and not len(scene.records) and scene.started:
        return False

    rows = exchange.asked_rows
    frames = scene.observe_all(rows) if exchange.asked.size else [[] for _ in scene.BEHAVIORS]
    exchange.results = [_records(scene, behavior, new) for behavior, new in enumerate(frames)]
    agents.clear_actions(exchange.asked)  # who is set no action by Python acts with zeros
    return True


def finish_tick(scene: Scene) -> None:
    """Run a tick from the exchange with Python to its end."""
    slots = scene.agents.order if scene.TAKE_ACTIONS_BETWEEN_DECISIONS else scene.exchange.asked
    if slots.size:
        scene.act(slots)

    # After the action, as in Unity: what it earned belongs to the episode that ends here.
    if scene.MAX_STEP:
        late = scene.agents.step_count >= scene.MAX_STEP
        if np.count_nonzero(late):
            scene.end_episode(late, interrupted=True)

    scene.controllers()
    scene.simulate()
    if scene.after_tick is not None:
        scene.after_tick()


def _records(scene: Scene, behavior: int, frames: list[np.ndarray]) -> tuple[DecisionSteps, TerminalSteps]:
    """Return a behavior's records of this exchange."""
    slots = scene.exchange.asked_rows[behavior]
    has_choices = scene.BEHAVIORS[behavior].branches and slots.size
    mask = scene.action_mask(behavior, slots) if has_choices else None
    decisions = scene.records.decisions(behavior, slots, frames, mask)
    return decisions, scene.records.take_terminals(behavior)
