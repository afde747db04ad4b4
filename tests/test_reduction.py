"""Several learners with a part of a batch each learn what one learns from the whole."""

from __future__ import annotations

import copy
import multiprocessing
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from masked import whole
from tensordict import TensorDict, TensorDictBase
from test_memory import options
from test_ppo import A, G, T, make_batch, make_learner
from torch import Tensor
from torchrl.envs.utils import exploration_type, set_exploration_type

from mappo_unity import keys
from mappo_unity.config.schema import (
    AdvantageKind,
    CriticKind,
    ObjectiveKind,
    ObsNormUpdate,
    RatioKind,
    ValueNormKind,
    ValueNormUpdate,
)
from mappo_unity.errors import ConfigError
from mappo_unity.learning.minibatches import EvenSampler
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.reduction import Reduction, SeveralLearners
from mappo_unity.training.setup import set_up

PARTS = (slice(0, 2), slice(2, G))  # teams of each learner
ONE_STEP = {"num_minibatches": 1, "epochs": 3}


class InThreads(SeveralLearners):
    """Two learners in threads: what torch.distributed does between processes."""

    def __init__(self, rank: int, table: list[Any], barrier: threading.Barrier) -> None:
        self._rank, self._table, self._barrier = rank, table, barrier
        super().__init__()

    def _count_learners(self) -> int:
        return len(self._table)

    def _everybodys(self, tensor: Tensor) -> list[Tensor]:
        self._table[self._rank] = tensor.detach().clone()
        self._barrier.wait(120)
        found = list(self._table)
        self._barrier.wait(120)
        assert all(each.shape == tensor.shape for each in found)  # the same call of everybody
        return found

    def _sum(self, tensor: Tensor) -> Tensor:
        return tensor.copy_(torch.stack(self._everybodys(tensor)).sum(0))

    def _most(self, tensor: Tensor) -> Tensor:
        return tensor.copy_(torch.stack(self._everybodys(tensor)).amax(0))

    def _send(self, tensor: Tensor) -> None:
        tensor.copy_(self._everybodys(tensor)[0])


def side_by_side(work: Callable[[int, Reduction], Any]) -> list[Any]:
    """Return what both learners return, each in a thread of its own."""
    table: list[Any] = [None, None]
    out: list[Any] = [None, None]
    barrier = threading.Barrier(2)

    def run(rank: int) -> None:
        try:
            out[rank] = work(rank, InThreads(rank, table, barrier))
        except BaseException as error:
            out[rank] = error
            barrier.abort()

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(2)]
    # TorchRL's losses set this for all threads, and put back what they found
    with set_exploration_type(exploration_type()):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    for each in out:
        if isinstance(each, BaseException) and not isinstance(each, threading.BrokenBarrierError):
            raise each
    return out


def joined(learner: PolicyLearner, reduction: Reduction) -> PolicyLearner:
    """Return a learner with copies of another's networks and options that learns beside others."""
    actor, critic = copy.deepcopy(learner.actor), copy.deepcopy(learner.critic)
    mine = PolicyLearner(actor, critic, learner.cfg)
    mine.join(reduction)
    return mine


def assert_alike(learners: list[PolicyLearner], one: PolicyLearner) -> None:
    """Compare networks, normalisers and statistics: of both learners to the bit, with one's to rounding."""
    states = [learner._trainable_state() for learner in (*learners, one)]
    for part in ("actor", "critic"):
        for name, value in states[2][part].items():
            assert torch.equal(states[0][part][name], states[1][part][name]), name
            assert torch.allclose(states[0][part][name], value, rtol=1e-4, atol=1e-5), name
    for mine, other in zip(learners[0].value_norm.statistics(), one.value_norm.statistics()):
        assert torch.allclose(mine, other, rtol=1e-4)
    assert learners[0].rollbacks == learners[1].rollbacks == one.rollbacks
    assert learners[0].warmup.decisions == learners[1].warmup.decisions == one.warmup.decisions


def assert_same_metrics(found: list[dict[str, float]], wanted: dict[str, float]) -> None:
    for name, value in wanted.items():
        assert found[0][name] == found[1][name] == pytest.approx(value, rel=2e-3, abs=2e-5), name


def staggered(learner: PolicyLearner) -> TensorDictBase:
    """Return a batch in which some act, with the log-probabilities of components, too."""
    batch = make_batch(learner, torch.rand(T, G, A, 1) < 0.7)
    with torch.no_grad():
        dist_now = learner.actor.get_dist(batch.clone())
        batch[keys.LOG_PROBS] = dist_now.component_log_probs(batch[keys.ACTION])
    return batch


CASES: dict[str, dict[str, Any]] = {
    "plain": {"entropy_coef": 0.01},
    "components": {
        "ratio": RatioKind.component,
        "value_norm_update": ValueNormUpdate.minibatch,
        "normalize_values": ValueNormKind.running,
    },
    "corrected": {
        "objective": ObjectiveKind.decoupled,
        "advantage": AdvantageKind.vtrace,
        "clip_value": True,
    },
    "warm-up": {"critic_warmup_steps": T * G, "separate_optimizers": True, "clip_value": True},
    "poca": {"model": {"critic": CriticKind.poca}},
}


def learn_thrice(learner: PolicyLearner, reduction: Reduction, rank: int, batches: list[Any]) -> Any:
    """Return a joined learner and its metrics of some batches, of which it has its teams."""
    mine = joined(learner, reduction)
    return mine, [mine.learn(*whole(batch[:, PARTS[rank]]), 0.1) for batch in batches]


@pytest.mark.parametrize("case", CASES)
def test_two_learners_are_one_with_the_whole_batch(case: str) -> None:
    one = make_learner(ActionLayout(1, (3,)), **ONE_STEP, **CASES[case])
    first = copy.deepcopy(one)
    batches, wanted = [], []
    for _ in range(3):
        batches.append(staggered(one))
        wanted.append(one.learn(*whole(batches[-1]), 0.1))

    out = side_by_side(lambda rank, reduction: learn_thrice(first, reduction, rank, batches))
    assert_alike([learner for learner, _ in out], one)
    for number, metrics in enumerate(wanted):
        assert_same_metrics([found[number] for _, found in out], metrics)


@pytest.mark.parametrize(
    ("limits", "metric"),
    [
        ({"lr": 1e-2, "target_kl": 1e-4}, "kl_stopped"),
        ({"lr": 0.5, "max_kl": 0.05}, "rolled_back"),
    ],
)
def test_all_stop_and_roll_back_together(limits: dict[str, float], metric: str) -> None:
    # the KL of one part alone may be on the other side of the limit
    one = make_learner(num_minibatches=1, epochs=8, **limits)
    first, batch = copy.deepcopy(one), staggered(one)
    wanted = one.learn(*whole(batch), 0.1)
    out = side_by_side(lambda rank, reduction: learn_thrice(first, reduction, rank, [batch]))
    assert wanted[metric] == 1.0
    assert_same_metrics([found[0] for _, found in out], wanted)
    assert_alike([learner for learner, _ in out], one)


def test_learners_begin_with_the_networks_of_the_first_and_stay_alike() -> None:
    # several minibatches: each learner draws its own rows, and all take the same number of steps
    def work(rank: int, reduction: Reduction) -> Any:
        mine = joined(others[rank], reduction)
        return mine, [mine.learn(*whole(batch[:, PARTS[rank]]), 0.1) for batch in batches]

    one = make_learner(minibatch_size=16)
    others = [one, copy.deepcopy(one)]
    with torch.no_grad():
        for parameter in others[1].params:
            parameter.add_(1.0)
    batches = [staggered(one) for _ in range(2)]
    (left, metrics), (right, also) = side_by_side(work)
    assert metrics == also and metrics[0]["kl"] > 0
    for mine, other in zip(left.params, right.params):
        assert torch.equal(mine, other)


def test_where_one_has_nothing_to_learn_from_all_wait() -> None:
    one = make_learner(**ONE_STEP)
    batch = make_batch(one)
    batch["acting"][:, PARTS[0]] = batch["next", "acting"][:, PARTS[0]] = False
    out = side_by_side(lambda rank, reduction: learn_thrice(one, reduction, rank, [batch]))
    for learner, metrics in out:
        assert "policy_loss" not in metrics[0]
        assert all(torch.equal(a, b) for a, b in zip(learner.actor.parameters(), one.actor.parameters()))
    assert torch.equal(out[0][0].norms[0].mean, out[1][0].norms[0].mean)
    assert out[0][0].norms[0].count == T * (G - 2) * A


def test_with_a_memory(tmp_path: Path) -> None:
    cfg = options("EarlyDeath", critic=CriticKind.poca, normalize_obs=True, ppo=dict(ONE_STEP))
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        (one,) = setup.learners.values()
        first, parts, wanted = joined(one, Reduction()), [], []
        for _ in range(2):
            batch, following = (entries.clone() for entries in next(batches).of("Probe"))
            parts.append([teams_of(batch, following, teams) for teams in (slice(0, 6), slice(6, 16))])
            wanted.append(one.learn(batch, following, 0.0))

    def work(rank: int, reduction: Reduction) -> Any:
        mine = joined(first, reduction)
        return mine, [mine.learn(*part[rank], 0.0) for part in parts]

    out = side_by_side(work)
    assert_alike([learner for learner, _ in out], one)
    for number, metrics in enumerate(wanted):
        assert_same_metrics([found[number] for _, found in out], metrics)


def teams_of(batch: TensorDictBase, following: TensorDictBase, teams: slice) -> tuple[Any, Any]:
    """Return some teams' part of a batch ``[T, G, A]`` and of what followed it."""
    rounds, count = batch.shape[:2]
    size = teams.stop - teams.start
    row = following.get(keys.CUT_OFF_AT) + rounds * count
    mine = (row % count >= teams.start) & (row % count < teams.stop)
    at = row[mine] // count * size + row[mine] % count - teams.start
    entries = {keys.FINAL: following.get(keys.FINAL)[teams], keys.CUT_OFF: following.get(keys.CUT_OFF)[mine]}
    return batch[:, teams], TensorDict(entries | {keys.CUT_OFF_AT: at - rounds * size}, [])


@pytest.mark.parametrize("decisions", [[100, 1, 1, 1], [1, 1, 1, 100], [0, 0, 5, 0, 9, 1], [1] * 9])
def test_each_minibatch_gets_a_row(decisions: list[int]) -> None:
    sampler = EvenSampler(torch.tensor(decisions), 4, fills_all=True)
    for _ in range(5):
        parts = sampler._shuffle()
        assert len(parts) == 4 and min(map(len, parts)) > 0
        assert sorted(torch.cat(parts).tolist()) == list(range(len(decisions)))


def test_what_is_not_added_up_is_refused() -> None:
    class Two(Reduction):
        size = 2

    learner = make_learner(obs_norm_update=ObsNormUpdate.round)
    with pytest.raises(ConfigError, match=r"ppo\.obs_norm_update=round does not go with 2 learners"):
        joined(learner, Two())


def learn_in_a_process(rank: int, folder: Path, first: PolicyLearner, batches: list[Any]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=2)
    try:
        mine, metrics = learn_thrice(first, SeveralLearners(), rank, batches)
        torch.save((mine._trainable_state(), metrics), folder / f"{rank}.pt")
    finally:
        dist.destroy_process_group()


@pytest.mark.slow
def test_two_processes_are_one_with_the_whole_batch(tmp_path: Path) -> None:
    one = make_learner(**ONE_STEP)
    first = copy.deepcopy(one)
    batches, wanted = [], []
    for _ in range(3):
        batches.append(staggered(one))
        wanted.append(one.learn(*whole(batches[-1]), 0.1))

    context = multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=learn_in_a_process, args=(rank, tmp_path, first, batches)) for rank in range(2)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    out = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]

    for part in ("actor", "critic"):
        for name, value in one._trainable_state()[part].items():
            assert torch.equal(out[0][0][part][name], out[1][0][part][name]), name
            assert torch.allclose(out[0][0][part][name], value, rtol=1e-4, atol=1e-5), name
    for number, metrics in enumerate(wanted):
        assert_same_metrics([found[1][number] for found in out], metrics)
