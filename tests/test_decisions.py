"""The decision view against a brute-force walk over every slot, one decision at a time."""

import numpy as np
import pytest
import torch
from masked import masked_gae

from mappo_unity.learning.decisions import DecisionView


def brute_force(
    reward, value, end_value, final_value, valued, final_valued, terminated, truncated, g, lam, horizon=None
):
    """Return advantages and masks of one slot, walking forward from each decision."""
    rounds = len(reward)
    place, cut = 0, np.zeros(rounds, bool)
    for t in range(rounds):
        place += valued[t]
        cut[t] = horizon is not None and place % horizon == 0
        place = 0 if terminated[t] or truncated[t] else place

    advantage, known = np.zeros(rounds), np.zeros(rounds, bool)
    for t in range(rounds - 1, -1, -1):
        if not valued[t]:
            continue

        total, s = 0.0, t
        while True:
            total += reward[s]
            if terminated[s] or truncated[s]:
                onward = end_value[s] if truncated[s] else 0.0
                advantage[t], known[t] = total + g * onward - value[t], True
                break
            s += 1
            if s == rounds:
                if final_valued:
                    advantage[t], known[t] = total + g * final_value - value[t], True
                break
            if valued[s]:
                # a decision without an outcome hands its value back, and no advantage
                onward = 0.0 if cut[t] else g * lam * advantage[s]
                advantage[t] = total + g * value[s] - value[t] + onward
                known[t] = True
                break
    return advantage, known


@pytest.mark.parametrize("part", range(3))
def test_a_hundred_random_cases(part):
    rng = np.random.default_rng(part)
    for _ in range(100):
        rounds, slots = int(rng.integers(1, 30)), int(rng.integers(1, 6))
        shape = (rounds, slots)
        reward, value, end_value = rng.normal(size=(3, *shape)).astype(np.float32)
        final_value = rng.normal(size=slots).astype(np.float32)
        valued = rng.random(shape) < rng.random()
        final_valued = rng.random(slots) < 0.5
        terminated = rng.random(shape) < 0.15 * rng.random()
        truncated = (rng.random(shape) < 0.15 * rng.random()) & ~terminated
        g, lam = rng.random(2)
        horizon = rng.choice([None, 1, 2, 3, 5])

        arrays = reward, value, end_value, final_value, valued, final_valued, terminated, truncated
        out = masked_gae(*map(torch.from_numpy, arrays), gamma=g, gae_lambda=lam, horizon=horizon)
        for n in range(slots):
            columns = [a[:, n] if a.ndim == 2 else a[n] for a in arrays]
            advantage, known = brute_force(*columns, g, lam, horizon)
            assert out.known[:, n].numpy().tolist() == known.tolist()
            assert np.allclose(out.advantage[:, n], advantage, atol=1e-5)
            assert np.allclose(out.target[:, n], np.where(known, advantage + value[:, n], 0), atol=1e-5)


def test_a_pending_decision_is_said_to_be_one():
    # slot 0 is asked in rounds 0 and 2 and then not again; slot 1 in every round; slot 2 ends while it waits
    valued = np.array([[1, 1, 1], [0, 1, 0], [1, 1, 0]], bool)
    ended = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 0]], bool)
    view = DecisionView.of(valued, np.array([False, True, False]), ended)
    assert view.pending.tolist() == [[False] * 3, [False] * 3, [True, False, False]]
    rewards = view.rewards(np.array([[1, 10, 100], [2, 20, 200], [4, 40, 400]], np.float32))
    assert rewards.tolist() == [[3, 10, 300], [0, 20, 0], [4, 40, 0]]
