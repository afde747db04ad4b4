"""Every key of ML-Agents' configuration with its kind and its default (mlagents/trainers/settings.py)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

WHOLE, NUMBER, FLAG, TEXT, TEXTS = "a whole number", "a number", "true or false", "a text", "a list of texts"


@dataclass(frozen=True)
class Key:
    """A key: the kind of its value, its default, and the choices where it has some.

    `optional`: null is a value, too.
    """

    kind: str
    default: Any
    choices: tuple[str, ...] = ()
    optional: bool = False


SCHEDULES = ("linear", "constant")
TRAINERS = ("ppo", "poca")
ENCODERS = ("simple", "nature_cnn", "resnet", "match3", "fully_connected")
SIGNALS = ("extrinsic", "curiosity", "rnd", "gail")

_NETWORK = {
    "normalize": Key(FLAG, False),
    "hidden_units": Key(WHOLE, 128),
    "num_layers": Key(WHOLE, 2),
    "vis_encode_type": Key(TEXT, "simple", ENCODERS),
    "goal_conditioning_type": Key(TEXT, "hyper", ("hyper", "none")),
    "deterministic": Key(FLAG, False),
}
_MEMORY = {"sequence_length": Key(WHOLE, 64), "memory_size": Key(WHOLE, 128)}


def _below(prefix: str, keys: dict[str, Key]) -> dict[str, Key]:
    return {f"{prefix}.{name}": key for name, key in keys.items()}


_PPO = {
    "batch_size": Key(WHOLE, 1024),
    "buffer_size": Key(WHOLE, 10240),
    "learning_rate": Key(NUMBER, 3e-4),
    "learning_rate_schedule": Key(TEXT, "linear", SCHEDULES),
    "beta": Key(NUMBER, 5e-3),
    "beta_schedule": Key(TEXT, "linear", SCHEDULES),
    "epsilon": Key(NUMBER, 0.2),
    "epsilon_schedule": Key(TEXT, "linear", SCHEDULES),
    "lambd": Key(NUMBER, 0.95),
    "num_epoch": Key(WHOLE, 3),
    "shared_critic": Key(FLAG, False),
}
_SIGNAL = {"gamma": Key(NUMBER, 0.99), "strength": Key(NUMBER, 1.0)}
_OWN = {
    "extrinsic": {},
    "curiosity": {"learning_rate": Key(NUMBER, 3e-4), "encoding_size": Key(WHOLE, None, optional=True)},
    "rnd": {"learning_rate": Key(NUMBER, 1e-4), "encoding_size": Key(WHOLE, None, optional=True)},
    "gail": {
        "learning_rate": Key(NUMBER, 3e-4),
        "encoding_size": Key(WHOLE, None, optional=True),
        "use_actions": Key(FLAG, False),
        "use_vail": Key(FLAG, False),
        "demo_path": Key(TEXT, None),
    },
}
_INNER = _NETWORK | _below("memory", _MEMORY)

BEHAVIOR: dict[str, Key] = {
    "trainer_type": Key(TEXT, "ppo", TRAINERS),
    "max_steps": Key(WHOLE, 500_000),
    "time_horizon": Key(WHOLE, 64),
    "summary_freq": Key(WHOLE, 50_000),
    "keep_checkpoints": Key(WHOLE, 5),
    "checkpoint_interval": Key(WHOLE, 500_000),
    "even_checkpoints": Key(FLAG, False),
    "threaded": Key(FLAG, False),
    "init_path": Key(TEXT, None, optional=True),
    "framework": Key(TEXT, None, optional=True),
    **_below("hyperparameters", _PPO),
    **_below("network_settings", _INNER),
    **{
        f"reward_signals.{signal}.{name}": key
        for signal in SIGNALS
        for name, key in (_SIGNAL | _OWN[signal] | _below("network_settings", _INNER)).items()
    },
    **_below(
        "behavioral_cloning",
        {
            "demo_path": Key(TEXT, None),
            "steps": Key(WHOLE, 0),
            "strength": Key(NUMBER, 1.0),
            "samples_per_update": Key(WHOLE, 0),
            "num_epoch": Key(WHOLE, None, optional=True),
            "batch_size": Key(WHOLE, None, optional=True),
        },
    ),
    **_below(
        "self_play",
        {
            "save_steps": Key(WHOLE, 20_000),
            "team_change": Key(WHOLE, None, optional=True),  # 5 x save_steps
            "swap_steps": Key(WHOLE, 2000),
            "window": Key(WHOLE, 10),
            "play_against_latest_model_ratio": Key(NUMBER, 0.5),
            "initial_elo": Key(NUMBER, 1200.0),
        },
    ),
}
"""Keys of a behavior, dotted."""

OPTIONAL = ("self_play", "behavioral_cloning", "network_settings.memory") + tuple(
    f"reward_signals.{signal}.network_settings.memory" for signal in SIGNALS
)
"""Sections of a behavior that are off unless they are given."""

RUN: dict[str, Key] = {
    **_below(
        "env_settings",
        {
            "env_path": Key(TEXT, None, optional=True),
            "env_args": Key(TEXTS, None, optional=True),
            "base_port": Key(WHOLE, 5005),
            "num_envs": Key(WHOLE, 1),
            "num_areas": Key(WHOLE, 1),
            "timeout_wait": Key(WHOLE, 60),
            "seed": Key(WHOLE, -1),
            "max_lifetime_restarts": Key(WHOLE, 10),
            "restarts_rate_limit_n": Key(WHOLE, 1),
            "restarts_rate_limit_period_s": Key(WHOLE, 60),
        },
    ),
    **_below(
        "engine_settings",
        {
            "width": Key(WHOLE, 84),
            "height": Key(WHOLE, 84),
            "quality_level": Key(WHOLE, 5),
            "time_scale": Key(NUMBER, 20.0),
            "target_frame_rate": Key(WHOLE, -1),
            "capture_frame_rate": Key(WHOLE, 60),
            "no_graphics": Key(FLAG, False),
            "no_graphics_monitor": Key(FLAG, False),
        },
    ),
    **_below(
        "checkpoint_settings",
        {
            "run_id": Key(TEXT, "ppo"),
            "initialize_from": Key(TEXT, None, optional=True),
            "load_model": Key(FLAG, False),
            "resume": Key(FLAG, False),
            "force": Key(FLAG, False),
            "train_model": Key(FLAG, False),
            "inference": Key(FLAG, False),
            "results_dir": Key(TEXT, "results"),
        },
    ),
    "torch_settings.device": Key(TEXT, None, optional=True),
    "debug": Key(FLAG, False),
}
"""Keys of the whole run, dotted."""

TOP = ("default_settings", "behaviors", "environment_parameters") + tuple(
    dict.fromkeys(key.partition(".")[0] for key in RUN)
)
"""What may stand outermost in a file."""

RENAMED = {
    "trainer": "trainer_type",
    "use_recurrent": "network_settings.memory",
    "pretraining": "behavioral_cloning",
    "lambda": "hyperparameters.lambd",
    "num_epochs": "hyperparameters.num_epoch",
    "sequence_length": "network_settings.memory.sequence_length",
    "memory_size": "network_settings.memory.memory_size",
    "gamma": "reward_signals.extrinsic.gamma",
    "summary_path": "",
    "allow_multiple_obs": "",
}
"""Spellings of older ML-Agents releases and where they stand now; empty: there is no such thing any more."""
