"""What mappo-doctor says: findings, good and bad, and what cures the bad ones."""

from __future__ import annotations

from collections.abc import Callable

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.ports import FORBIDDEN

CURES = {
    "protobuf": "messages are parsed in pure Python, 10 to 80 times slower: pip install --upgrade protobuf, "
    "and unset PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION",
    "TIME_WAIT": "a run that ended less than a minute ago holds it (TIME_WAIT); it comes free by itself",
    "in use": "another training run or a game started by hand holds it: end that one, or use another port "
    "(env.port=N, here --port N) on both sides",
    FORBIDDEN: "this user may not listen on it: use a port from 1024 up (env.port=N, here --port N)",
    "not started": "build the game for this system and its processor; does it start by hand?",
    "display": "no display: start players with env.no_graphics=true (no cameras then), or under xvfb-run",
    "no behavior": "the player runs, but no agent requested a decision: give every Agent a DecisionRequester "
    "(or call RequestDecision), set Behavior Type to Default, and see that the agents' objects are active",
    "rhythm": "no agent asked again after its first decision: is DecisionRequester's period very long, or "
    "are the agents destroyed without EndEpisode?",
    "log": "what ended it stands there; if not, start the game by hand and look",
    "old package": "build the game with com.unity.ml-agents 2.0 or later (release 18), for groups and hybrid "
    "actions",
}
"""Cures in words, by trouble."""

Say = Callable[[str], None]


class Report:
    """Say findings as they come, and count the bad ones."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self.failures = self.warnings = 0

    def head(self, text: str) -> None:
        """Begin a section."""
        self._say(text)

    def good(self, text: str) -> None:
        """Say that something is as it should be."""
        self._say(f"  ok    {text}")

    def warn(self, text: str, cure: str) -> None:
        """Say that something may be in the way, and what to do."""
        self.warnings += 1
        self._say(f"  look  {text}\n        {cure}")

    def fail(self, text: str, cure: str) -> None:
        """Say that something does not work, and what to do."""
        self.failures += 1
        self._say(f"  FAIL  {text}\n        {cure}")

    def mistake(self, error: ConfigError) -> None:
        """Say a mistake, whose message says what to do."""
        self.failures += 1
        self._say(f"  FAIL  {error}")
