"""Findings about the update: rollbacks, step sizes, entropy, values, and whether the return rises."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mappo_unity.diagnosis.evidence import Evidence, Finding, amount, leaves_one_action

_COLLAPSED = 0.05  # of the largest entropy of discrete actions
_COLLAPSED_NATS = -2.5  # of a continuous column: a standard deviation of 0.02, where 1 is an action's range
_STILL = 1e-6  # approximate KL of an update that moves nothing; 0.001 to 0.02 is usual
_BLIND = 0.02  # explained variance
_RARE = 0.02  # of the episodes
_FAR = 1.0
_NEAR = 0.9  # gamma below which an end is out of sight, whatever else is learnt


def from_learning(evidence: Evidence) -> Iterator[Finding]:
    """Yield what is wrong with how policies learn."""
    names: list[str | None] = [name for name in evidence.survey if not evidence.is_frozen(name)] or [None]
    for name in names:
        yield from _rollbacks(evidence, name)

    if not evidence.is_judged:
        return
    if evidence.has_risen:
        yield from _horizon(evidence, _NEAR)
        return
    yield _return(evidence)
    for name in names:
        facts = evidence.survey.get(name or "", {})
        # where there is no choice, there is nothing to learn; without rewards or steps, nothing to predict by
        stands = list(_steps(evidence, name))
        if not leaves_one_action(facts):
            yield from stands
            yield from _entropy(evidence, name)
        if not stands and (not facts or facts["rewards"]["nonzero"]):
            yield from _values(evidence, name)
    yield from _rare(evidence)
    yield from _horizon(evidence, _FAR)


def _rollbacks(evidence: Evidence, name: str | None) -> Iterator[Finding]:
    rolled_back = evidence.column("rolled_back", name)
    if len(rolled_back) >= 10 and rolled_back.mean() > 0.2:
        yield Finding(
            "rollbacks",
            f"{_of(name)}updates are rolled back",
            f"{rolled_back.mean():.0%} of {len(rolled_back)} went beyond "
            f"ppo.max_kl={evidence.option('ppo.max_kl', name)}",
            f"a lower ppo.lr (now {evidence.option('ppo.lr', name)}), fewer ppo.epochs, or "
            "ppo.target_kl=0.02, which stops an update in time",
        )


def _return(evidence: Evidence) -> Finding:
    first, last, _ = evidence.returns
    known = (
        f"{amount(first)} at first, {amount(last)} now" if not math.isnan(first) else "too few episodes end"
    )
    has_fallen = evidence.has_fallen
    return Finding(
        "falls" if has_fallen else "no rise",
        "the return has fallen" if has_fallen else "the return has not risen",
        f"{known}, after {amount(evidence.decisions)} decisions",
        "see the other findings. Without any: does the reward depend on what the agent does, can what it "
        "needs be seen, and can a person earn it (in the Editor: Behavior Type Heuristic Only)?",
    )


def _steps(evidence: Evidence, name: str | None) -> Iterator[Finding]:
    kl, clipped = evidence.column("kl", name), evidence.column("clip_fraction", name)
    if not len(kl):
        return
    usual = float(np.median(np.abs(kl)))
    if usual < _STILL and clipped.max(initial=0.0) == 0:
        yield Finding(
            "no steps",
            f"{_of(name)}updates change nothing",
            f"half of them have an approximate KL of at most {amount(usual)}; 0.001 to 0.02 is usual",
            f"a higher ppo.lr (now {evidence.option('ppo.lr', name)}; 3e-4 to 1e-3 is usual)",
        )


def _entropy(evidence: Evidence, name: str | None) -> Iterator[Finding]:
    entropy = evidence.column("entropy", name)
    facts = evidence.survey.get(name or "")
    if len(entropy) < 20 or facts is None:
        return

    now, branches, continuous = float(entropy[-5:].mean()), facts["branches"], facts["continuous"]
    strength = evidence.column("entropy_coef", name)
    if branches and not continuous:
        most = float(np.log(branches).sum())
        has_collapsed, is_still = now < _COLLAPSED * most, now > 0.97 * most
        said = f"{amount(now)} of at most {amount(most)} nats"
    else:
        # of a sum over columns, or of their mean
        columns = 1 if evidence.option("ppo.entropy", name) == "mean" else max(1, continuous)
        has_collapsed = now / columns < _COLLAPSED_NATS
        is_still = now >= float(entropy[:5].mean()) - 0.02 * columns
        said = f"{amount(float(entropy[:5].mean()))} nats at first, {amount(now)} now"

    if has_collapsed:
        yield Finding(
            "entropy collapsed",
            f"{_of(name)}the policy has stopped exploring",
            f"entropy: {said}",
            f"a higher ppo.entropy_coef (now {evidence.option('ppo.entropy_coef', name)}), "
            "ppo.entropy_schedule=constant, or a lower ppo.lr",
        )
    elif is_still and len(strength) and strength.mean() >= 0.02:
        yield Finding(
            "entropy stays",
            f"{_of(name)}the policy acts at random",
            f"entropy: {said}, with ppo.entropy_coef={evidence.option('ppo.entropy_coef', name)}",
            "a lower ppo.entropy_coef: 0.005 to 0.01 is usual",
        )


def _values(evidence: Evidence, name: str | None) -> Iterator[Finding]:
    explained = evidence.column("explained_variance", name)
    late = explained[len(explained) // 2 :]
    if len(late) >= 10 and np.median(late) < _BLIND:
        yield Finding(
            "values",
            f"{_of(name)}the value function explains nothing",
            f"explained variance {amount(float(np.median(late)))} in the second half",
            f"ppo.value_coef (now {evidence.option('ppo.value_coef', name)}; 0.5 is usual), "
            "model.normalize_obs=true, or what the return depends on is not observed",
        )


def _rare(evidence: Evidence) -> Iterator[Finding]:
    for name, facts in evidence.survey.items():
        returns = np.array(facts["returns"])
        if len(returns) < 200 or np.ptp(returns) < 1e-6:
            continue
        is_good = returns > (returns.min() + returns.max()) / 2
        if is_good.mean() < _RARE:
            yield Finding(
                "rare rewards",
                f"{name}: what earns is rarely met",
                f"{is_good.mean():.1%} of episodes earned more than {amount(float(returns[~is_good].max()))}",
                "rewards.rnd.strength=0.1 or rewards.curiosity.strength=0.1, a curriculum (env.params), or "
                "demonstrations (bc.demos, rewards.gail.demos)",
            )


def _horizon(evidence: Evidence, below: float) -> Iterator[Finding]:
    """Yield policies whose gamma, less than `below`, does not reach the ends at which rewards come."""
    length = evidence.column("episode_length_mean")
    for name, facts in evidence.survey.items():
        rewards = facts["rewards"]
        option, gamma = _discount(evidence, name)
        is_late = rewards["nonzero"] and rewards["at_ends"] >= 0.9 * rewards["nonzero"]
        if not len(length) or not is_late or not gamma < below:
            continue

        # what a reward at the end is worth in the middle of an episode
        mean = float(length[-5:].mean())
        worth = gamma ** (mean / 2)
        if worth < 0.01:
            yield Finding(
                "short sight",
                f"{name}: rewards come at the end, and {option} does not see so far",
                f"{amount(mean)} decisions an episode: half way the end is worth {worth:.2g} of itself",
                f"{option}={1 - 2 / max(mean, 20):.3g} or more (now {gamma:g})",
            )


def _discount(evidence: Evidence, name: str) -> tuple[str, float]:
    """Return the option that discounts the environment's rewards, and where it stands."""
    own = evidence.number("rewards.extrinsic.gamma", name)
    if not math.isnan(own):
        return "rewards.extrinsic.gamma", own

    moved = evidence.column("gamma", name)  # where it has a schedule
    return "ppo.gamma", float(moved[-1]) if len(moved) else evidence.number("ppo.gamma", name)


def _of(name: str | None) -> str:
    return f"{name}: " if name else ""
