"""What goes wrong with a player: its errors, and what its silence may mean."""

from __future__ import annotations

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.player_options import PlayerOptions

NO_DECISION_HINT = (
    "every Agent needs a DecisionRequester (or a call of RequestDecision), Behavior Type Default, and an "
    "active object"
)


class PlayerFailure(RuntimeError):
    """A player crashed, hung, left or sent nonsense; the message says what it logged or printed."""


class ProtocolMismatch(PlayerFailure, ConfigError):
    """The player speaks another version of the protocol."""


def never_connected(options: PlayerOptions, port: int) -> str:
    """Say that a player did not come, and why that may be."""
    limit = _limit(options.timeout_s)
    if options.executable is None:
        return (
            f"did not connect to port {port} {limit}: press Play in a scene whose agents have "
            "Behavior Type Default, and see that no other training run is on that port"
        )

    return (
        f"did not connect {limit}: it may need env.no_graphics=true on a machine without a display, wait "
        "for a user, or hold no agent with Behavior Type Default"
    )


def never_answered(timeout_s: float, has_behaviors: bool) -> str:
    """Say that a connected player fell silent; one that has shown no behavior may hold no agent that acts."""
    hint = "" if has_behaviors else f": no agent requested a decision; {NO_DECISION_HINT}"
    return f"did not answer {_limit(timeout_s)}{hint}"


def _limit(timeout_s: float) -> str:
    return f"within env.timeout_s={timeout_s:g}"
