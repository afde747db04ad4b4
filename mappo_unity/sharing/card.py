"""A model card: what is known of an exported policy, as Markdown below the front matter that the hub reads.

Text from facts, nothing else: `facts` gathers them. A card of ours is known by the comment in it, so that one
that somebody wrote by hand is never taken for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import yaml

from mappo_unity.config.overrides import shell_argument
from mappo_unity.policies.matches import Z95

MARK = "<!-- card of mappo-unity -->"
FENCE = "---"
TASK = "reinforcement-learning"
_TAGS = ("reinforcement-learning", "multi-agent", "mappo", "unity", "ml-agents", "onnx")


@dataclass(frozen=True)
class Earned:
    """Returns of episodes that were played for the card."""

    mean: float
    stderr: float
    episodes: int


@dataclass(frozen=True)
class Won:
    """Matches against random that were played for the card; shares are of the decided ones (nan: none)."""

    share: float
    low: float
    high: float
    wins: int
    draws: int
    losses: int
    together: bool = False  # with other policies of the run beside this one


@dataclass(frozen=True)
class LastWindow:
    """What the run itself said of its last episodes before the checkpoint."""

    mean_return: float
    win_rate: float | None = None  # of the decided matches against random; NaN: none was
    draw_rate: float | None = None


@dataclass(frozen=True)
class Training:
    """How a policy came about."""

    command: str
    seed: int
    backend: str
    areas: int | None  # None: as many as the environment has
    wall_s: float | None  # None: not told, of a snapshot of self-play
    versions: Mapping[str, str]


@dataclass(frozen=True)
class Facts:
    """What is known of one ONNX file."""

    policy: str
    file: str
    env: str
    agent_steps: int | None
    sensors: Sequence[tuple[str, Sequence[int]]]
    continuous: int
    discrete: str  # its branches, in words; empty: none
    team_size: int = 1
    training: Training | None = None
    score: Earned | Won | LastWindow | None = None
    film: str | None = None
    is_scene: bool = True  # one of ours, which mappo-eval opens by its name
    tags: Sequence[str] = field(default=_TAGS)


def card_text(facts: Facts) -> str:
    """Return the card of an ONNX file."""
    parts = [
        MARK,
        f"# {facts.policy}",
        _head(facts),
        *([f"[Film]({quote(facts.film)}): the policy in its scene."] if facts.film else []),
        "## What it sees and does",
        _table(facts),
        "## Score",
        _score(facts.score),
        *(["## Training", _training(facts)] if facts.training else []),
        "## Use",
        _use(facts),
    ]
    return joined(_front_matter(facts), "\n\n".join(parts) + "\n")


def joined(front: Mapping[str, Any], body: str) -> str:
    """Return a card of its front matter and its text."""
    lines = yaml.safe_dump(dict(front), sort_keys=False, allow_unicode=True)
    return f"{FENCE}\n{lines}{FENCE}\n\n{body}"


def is_ours(text: str) -> bool:
    """Tell whether a text is a card of ours, which may be written anew."""
    return MARK in text


def split(text: str) -> tuple[dict[str, Any], str]:
    """Return a card's front matter (empty where there is none that can be read) and its text."""
    lines = text.splitlines()
    if not lines or lines[0].strip() != FENCE or FENCE not in lines[1:]:
        return {}, text

    end = lines.index(FENCE, 1)
    try:
        front = yaml.safe_load("\n".join(lines[1:end]))
    except yaml.YAMLError:
        return {}, text
    body = "\n".join(lines[end + 1 :]).lstrip("\n") + "\n"
    return (front, body) if isinstance(front, dict) else ({}, text)


def merged(cards: Sequence[str]) -> str:
    """Return one card of several: a section each, all tags, all results."""
    if len(cards) == 1:
        return cards[0]

    parts = [split(card) for card in cards]
    front = parts[0][0] | {"tags": list(dict.fromkeys(tag for head, _ in parts for tag in _tags(head)))}
    index = [entry for head, _ in parts for entry in head.get("model-index") or []]
    return joined(front | ({"model-index": index} if index else {}), "\n".join(body for _, body in parts))


def _tags(front: Mapping[str, Any]) -> list[str]:
    tags = front.get("tags") or []
    return [tags] if isinstance(tags, str) else list(tags)


def _front_matter(facts: Facts) -> dict[str, Any]:
    front: dict[str, Any] = {
        "library_name": "mappo-unity",
        "pipeline_tag": TASK,
        "tags": [*facts.tags, facts.env] if facts.env else list(facts.tags),
    }
    metric = _metric(facts.score)
    if metric is not None:
        result = {
            "task": {"type": TASK, "name": TASK},
            "dataset": {"name": facts.env, "type": facts.env},
            "metrics": [metric],
        }
        front["model-index"] = [{"name": facts.policy, "results": [result]}]
    return front


def _metric(score: Earned | Won | LastWindow | None) -> dict[str, Any] | None:
    """Return the measured score in the hub's form; what training said of itself is no measurement."""
    if isinstance(score, Earned):
        error = "" if math.isnan(score.stderr) else f" +/- {score.stderr:.2g}"
        value = f"{score.mean:.4g}{error}"
        return {"type": "mean_reward", "name": "mean_reward", "value": value, "verified": False}
    if isinstance(score, Won) and score.wins + score.losses:
        name = "share won against random"
        return {"type": "win_rate", "name": name, "value": round(score.share, 4), "verified": False}
    return None


def _head(facts: Facts) -> str:
    steps = f" after {facts.agent_steps:,} agent steps" if facts.agent_steps is not None else ""
    place = f" in `{facts.env}`" if facts.env else ""
    team = f" It acts for each agent of teams of up to {facts.team_size}." if facts.team_size > 1 else ""
    return (
        f"A policy for the behavior `{facts.policy}`, trained{place} with mappo-unity (MAPPO), as it was"
        f"{steps}.{team}"
    )


def _table(facts: Facts) -> str:
    rows = [f"| sees | `{_cell(name)}` | {list(shape)} |" for name, shape in facts.sensors]
    if facts.continuous:
        rows.append(f"| does | continuous actions | {facts.continuous}, each from -1 to 1 |")
    if facts.discrete:
        rows.append(f"| does | discrete actions | {facts.discrete} |")
    return "\n".join(["| | | shape |", "|---|---|---|", *rows])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("`", "'")


def _score(score: Earned | Won | LastWindow | None) -> str:
    if isinstance(score, Earned):
        if math.isnan(score.stderr):
            return f"Return {score.mean:.4g} in one episode of an agent, with sampled actions."
        low, high = score.mean - Z95 * score.stderr, score.mean + Z95 * score.stderr
        return (
            f"Mean return {score.mean:.4g}, standard error {score.stderr:.2g}, 95 % interval {low:.4g} to "
            f"{high:.4g}, of {score.episodes:,} episodes of an agent, with sampled actions."
        )

    if isinstance(score, Won) and not score.wins + score.losses:
        return f"No match against a random side was decided: {score.draws} drawn."

    if isinstance(score, Won):
        who = "With the run's other policies on its side, won" if score.together else "Won"
        return (
            f"{who} {100 * score.share:.1f} % of the decided matches against a random side, 95 % interval "
            f"(Wilson) {100 * score.low:.1f} % to {100 * score.high:.1f} %: {score.wins} won, {score.draws} "
            f"drawn, {score.losses} lost, with sampled actions, half of them on each side."
        )

    if isinstance(score, LastWindow):
        said = f"the mean return of its last training episodes was {score.mean_return:.4g}"
        if score.win_rate is not None:
            drawn = "" if score.draw_rate is None else f", {100 * score.draw_rate:.1f} % of all drawn"
            won = f"won {100 * score.win_rate:.1f} % of the decided ones{drawn}"
            won = "decided none" if math.isnan(score.win_rate) else won
            said = f"in its last matches against random while training it {won}"
        return f"Not evaluated: {said}, which is no measurement of the finished policy."

    return "Not evaluated."


def _training(facts: Facts) -> str:
    training = facts.training
    assert training is not None
    versions = ", ".join(f"{name} {version}" for name, version in training.versions.items())
    areas = f", {training.areas} areas" if training.areas is not None else ""
    rows = {
        "environment": f"{facts.env}, backend {training.backend}{areas}",
        "agent steps": "unknown" if facts.agent_steps is None else f"{facts.agent_steps:,}",
        "wall time": "unknown" if training.wall_s is None else f"{training.wall_s:,.0f} s",
        "seed": str(training.seed),
        "versions": versions,
    }
    table = "\n".join(["| | |", "|---|---|", *(f"| {name} | {_cell(text)} |" for name, text in rows.items())])
    return f"{table}\n\nAgain, with the options that differ from the preset:\n\n    {training.command}"


def _use(facts: Facts) -> str:
    unity = (
        f"In Unity: copy `{facts.file}` into `Assets` and drag it onto *Model* in the Behavior Parameters of "
        "the agents."
    )
    if not facts.is_scene:
        run = shell_argument("run", facts.file)
        return (
            f"{unity}\n\nWith mappo-unity: `mappo-eval {run}`, with the file in the folder of a run of that "
            "environment."
        )

    env = shell_argument("env", facts.env or "NAME")
    return (
        f"{unity}\n\nWith mappo-unity (a folder of several files plays their behaviors):\n\n"
        f"    mappo-eval {shell_argument('run', facts.file)} {env}\n"
        f"    mappo-play {shell_argument('policy', facts.file)} {env}"
    )
