"""The masked recursion against hand-worked numbers and TorchRL's GAE."""

import math

import numpy as np
import pytest
import torch
from masked import masked_gae
from torchrl.objectives.value.functional import generalized_advantage_estimate

from mappo_unity.config.schema import Schedule
from mappo_unity.learning.advantage import explained_variance, normalize, scheduled
from mappo_unity.learning.reduction import masked_mean


def gae(
    reward,
    value,
    *,
    valued=None,
    final=0.0,
    final_valued=True,
    terminated=(),
    truncated=(),
    end=None,
    g=0.5,
    lam=1.0,
    rho=None,
):
    count = len(reward)
    column = lambda rows: torch.tensor([t in rows for t in range(count)])  # noqa: E731
    valued = torch.ones(count, dtype=torch.bool) if valued is None else torch.tensor(valued)
    return masked_gae(
        torch.tensor(reward, dtype=torch.float32),
        torch.tensor(value, dtype=torch.float32),
        torch.tensor(end or [0.0] * count),
        torch.tensor(float(final)),
        valued,
        torch.tensor(final_valued),
        column(terminated),
        column(truncated),
        gamma=g,
        gae_lambda=lam,
        rho_T=None if rho is None else torch.tensor(rho),
    )


def test_by_hand_termination_interruption_and_bootstrap():
    # gamma .5, lambda 1: returns 1 + .5*2 = 2 (end), 4 + .5*8 = 8 (cut, bootstraps 8), 1 + .5*6 = 4
    out = gae([1, 2, 4, 1], [0.5] * 4, terminated=[1], truncated=[2], end=[0, 0, 8.0, 0], final=6)
    assert out.target.tolist() == [2.0, 2.0, 8.0, 4.0]
    assert out.advantage.tolist() == [1.5, 1.5, 7.5, 3.5]
    assert out.known.all()


def test_by_hand_an_agent_that_is_asked_every_other_round():
    # decisions in rounds 0 and 2; rewards 1+2 belong to the first, 3+4 to the second
    # A_2 = 7 + .5*10 - 2 = 10; A_0 = 3 + .5*2 - 1 + .5*.8*10 = 7
    out = gae([1, 2, 3, 4], [1, 99, 2, 99], valued=[True, False, True, False], final=10, lam=0.8)
    assert out.advantage.tolist() == pytest.approx([7.0, 0.0, 10.0, 0.0])
    assert out.known.tolist() == [True, False, True, False]


def test_an_end_that_arrives_while_the_agent_waits():
    # asked in round 0 only; rewards 1 and 2, the end comes with the second
    out = gae([1, 2, 5], [1, 0, 0], valued=[True, False, False], terminated=[1], final_valued=False)
    assert out.advantage.tolist() == [2.0, 0.0, 0.0]


def test_a_decision_without_an_outcome_teaches_nothing_but_bootstraps():
    out = gae([1, 5, 5], [1, 4, 0], valued=[True, True, False], final_valued=False)
    assert out.known.tolist() == [True, False, False]
    assert out.advantage.tolist() == [1 + 0.5 * 4 - 1, 0.0, 0.0]


@pytest.mark.parametrize("seed", range(3))
def test_equals_torchrl_where_everybody_acts(seed):
    generator = torch.Generator().manual_seed(seed)
    T, N = 40, 6
    reward, value, following = (torch.randn(N, T, 1, generator=generator) for _ in range(3))
    terminated = torch.rand(N, T, 1, generator=generator) < 0.1
    truncated = (torch.rand(N, T, 1, generator=generator) < 0.1) & ~terminated
    # between ends, the value of the next state is the value of the next row
    ended = terminated | truncated
    following[:, :-1] = torch.where(ended[:, :-1], following[:, :-1], value[:, 1:])
    expected, target = generalized_advantage_estimate(
        0.97, 0.9, value, following, reward, done=ended, terminated=terminated
    )
    first = lambda x: x.transpose(0, 1).squeeze(-1)  # noqa: E731
    out = masked_gae(
        first(reward),
        first(value),
        first(following),
        first(following)[-1],
        torch.ones(T, N, dtype=torch.bool),
        torch.ones(N, dtype=torch.bool),
        first(terminated),
        first(truncated),
        gamma=0.97,
        gae_lambda=0.9,
    )
    assert torch.allclose(out.advantage, first(expected), atol=1e-5)
    assert torch.allclose(out.target, first(target), atol=1e-5)


def test_staggering_does_not_change_what_is_learned():
    # the same experience, once dense and once with a silent round after each decision
    generator = torch.Generator().manual_seed(0)
    reward, value = torch.randn(10, generator=generator), torch.randn(10, generator=generator)
    dense = gae(reward.tolist(), value.tolist(), final=2.0, lam=0.9)
    spread = [x for r in reward.tolist() for x in (0.25 * r, 0.75 * r)]
    held = [x for v in value.tolist() for x in (v, 0.0)]
    sparse = gae(spread, held, valued=[True, False] * 10, final=2.0, lam=0.9)
    assert torch.allclose(sparse.advantage[::2], dense.advantage, atol=1e-6)


def test_v_trace_by_hand():
    # gamma .5: A_1 = 2 - .5, target .5 + .5*1.5 = 1.25; A_0 = 1 + .5*1.25 - .5 = 1.125
    out = gae([1, 2], [0.5, 0.5], terminated=[1], rho=[1.0, 0.5])
    assert out.advantage.tolist() == [1.125, 1.5]
    assert out.target.tolist() == [1.625, 1.25]
    # lambda .8 mixes in the value: 1 + .5*(.8*1.25 + .2*.5) - .5; a ratio of its own moves the target alone
    out = gae([1, 2], [0.5, 0.5], terminated=[1], rho=[0.25, 0.5], lam=0.8)
    assert out.advantage.tolist() == pytest.approx([1.05, 1.5])
    assert out.target.tolist() == pytest.approx([0.5 + 0.25 * 1.05, 1.25])


def test_v_trace_of_the_newest_policy_is_gae():
    generator = torch.Generator().manual_seed(0)
    reward, value = torch.randn(2, 20, generator=generator).tolist()
    valued = (torch.rand(20, generator=generator) < 0.7).tolist()
    case = {
        "valued": valued,
        "terminated": [4],
        "truncated": [11],
        "end": [1.5] * 20,
        "final": 2.0,
        "lam": 0.9,
    }
    plain, corrected = gae(reward, value, **case), gae(reward, value, **case, rho=[1.0] * 20)
    assert torch.equal(plain.advantage, corrected.advantage) and torch.equal(plain.target, corrected.target)


@pytest.mark.parametrize("seed", range(4))
def test_v_trace_is_the_sum_in_the_paper(seed):
    rng = np.random.default_rng(seed)
    rounds, slots, g, lam = 25, 6, 0.9, 0.8
    reward, value, end, rho = rng.normal(size=(4, rounds, slots)).astype(np.float32)
    rho = np.minimum(1, np.exp(rho))
    final = rng.normal(size=slots).astype(np.float32)
    valued, final_valued = rng.random((rounds, slots)) < 0.6, rng.random(slots) < 0.7
    terminated, cut = rng.random((2, rounds, slots)) < 0.08
    cut &= ~terminated
    arrays = (reward, value, end, final, valued, final_valued, terminated, cut)
    tensors = [torch.from_numpy(array) for array in arrays]
    out = masked_gae(*tensors, gamma=g, gae_lambda=lam, rho_T=torch.from_numpy(rho))

    count = 0
    for slot in range(slots):
        # each decision: reward up to the next or the end, the value there, and the decision that follows
        chain = {}
        for t in np.flatnonzero(valued[:, slot]):
            total, bootstrap, following = 0.0, None, None
            for u in range(t, rounds):
                total += reward[u, slot]
                if terminated[u, slot] or cut[u, slot]:
                    bootstrap = end[u, slot] if cut[u, slot] else 0.0
                    break
                if u + 1 < rounds and valued[u + 1, slot]:
                    bootstrap, following = value[u + 1, slot], u + 1
                    break
                if u + 1 == rounds and final_valued[slot]:
                    bootstrap = final[slot]
            if bootstrap is not None:
                chain[t] = (rho[t, slot], total + g * bootstrap - value[t, slot], following)
        assert sorted(chain) == np.flatnonzero(out.known[:, slot]).tolist()

        # equation 1: the sum over t of gamma^(t-s) (c_s ... c_(t-1)) rho_t delta_t
        moved = {}
        for s in chain:
            weight, at, moved[s] = 1.0, s, 0.0
            while at in chain:
                ratio, delta, following = chain[at]
                moved[s] += weight * ratio * delta
                weight, at = weight * g * lam * ratio, following
        for s, (_, delta, following) in chain.items():
            advantage = delta + g * lam * moved.get(following, 0.0)
            assert out.target[s, slot].item() == pytest.approx(value[s, slot] + moved[s], abs=1e-4)
            assert out.advantage[s, slot].item() == pytest.approx(advantage, abs=1e-4)
            count += 1
    assert count > 50


def test_masked_statistics():
    values, mask = torch.tensor([1.0, 3.0, 100.0]), torch.tensor([True, True, False])
    assert masked_mean(values, mask) == 2.0
    assert normalize(values, mask, eps=0.0).tolist() == [-1.0, 1.0, 0.0]
    assert explained_variance(torch.tensor([1.0, 3.0, 0.0]), values, mask) == 1.0
    assert explained_variance(torch.tensor([2.0, 2.0, 0.0]), values, mask) == 0.0
    assert math.isnan(explained_variance(values, torch.ones(3), mask))


def test_schedules():
    assert scheduled(Schedule.constant, 3.0, 1.0, 0.7) == 3.0
    assert scheduled(Schedule.linear, 3.0, 1.0, 0.5) == 2.0
    assert scheduled(Schedule.linear, 3.0, 1.0, 1.5) == 1.0
    assert scheduled(Schedule.cosine, 3.0, 1.0, 0.5) == pytest.approx(2.0)
    assert scheduled(Schedule.cosine, 3.0, 1.0, 0.25) == pytest.approx(1.0 + 2 * (0.5 + math.sqrt(0.125)))
