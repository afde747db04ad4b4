"""Where a run's time goes, and findings about a player that is slow or crashes."""

from __future__ import annotations

from collections.abc import Iterator

from mappo_unity.diagnosis.evidence import Evidence, Finding, amount

_SLOW = 500.0  # decisions a second: embedded scenes make thousands on a core
_FROM_OUTSIDE = ("player", "editor", "registry", "custom", "pettingzoo")


def from_pace(evidence: Evidence) -> Iterator[Finding]:
    """Yield what slows a run down, and what it loses."""
    collect_s, update_s = evidence.column("collect_s").sum(), evidence.column("update_s").sum()
    backend = evidence.option("env.backend")
    if evidence.updates >= 5 and collect_s and evidence.decisions / (collect_s + update_s) < _SLOW:
        share = collect_s / (collect_s + update_s)
        said = describe_pace(evidence)
        if share >= 0.8 and backend in _FROM_OUTSIDE:
            yield Finding("slow environment", "the run waits for its environment", said, _faster(evidence))
        elif share <= 0.2:
            yield Finding(
                "slow learning",
                "the run waits for the update",
                said,
                f"fewer ppo.epochs (now {evidence.option('ppo.epochs')}), a larger ppo.minibatch_size (now "
                f"{evidence.option('ppo.minibatch_size')}), a smaller model.hidden, or device=cuda",
            )

    dropped, restarts = evidence.column("dropped_steps"), evidence.column("restarts")
    if len(dropped) and evidence.decisions and dropped[-1] > 0.05 * evidence.decisions:
        yield Finding(
            "crashes",
            "players crash, and take episodes along",
            f"{amount(restarts[-1])} restarts, {amount(dropped[-1])} decisions lost",
            "their logs in the run's folder players/ say why; env.time_scale lower, or mappo-doctor "
            "--file-name GAME",
        )


def describe_pace(evidence: Evidence) -> str:
    """Return where the time went, in a line."""
    collect_s, update_s = evidence.column("collect_s").sum(), evidence.column("update_s").sum()
    total_s = collect_s + update_s
    if not total_s:
        return "no iteration was timed"
    return (
        f"{amount(evidence.decisions / total_s)} decisions/s: {collect_s / total_s:.0%} of the time "
        f"collecting, {update_s / total_s:.0%} learning"
    )


def _faster(evidence: Evidence) -> str:
    if evidence.option("env.backend") in ("custom", "pettingzoo"):
        return "collect.workers=N (a process each) with collect.overlap=true, or more agents in one step"
    return (
        f"env.num_players=N (now {evidence.option('env.num_players')}) with collect.workers=N, "
        f"env.time_scale (now {evidence.option('env.time_scale')}), env.no_graphics=true, more areas"
    )
