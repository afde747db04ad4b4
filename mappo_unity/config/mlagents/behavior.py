"""One behavior's keys as options of its learner, and its lengths, which ours count over all behaviors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mappo_unity.config.mlagents.keys import SIGNALS
from mappo_unity.config.mlagents.settings import Section
from mappo_unity.errors import ConfigError

Options = dict[str, tuple[Any, str]]
"""Values of options, each with where it comes from."""

_HYPER = {
    "batch_size": "ppo.minibatch_size",
    "learning_rate": "ppo.lr",
    "learning_rate_schedule": "ppo.lr_schedule",
    "beta": "ppo.entropy_coef",
    "beta_schedule": "ppo.entropy_schedule",
    "epsilon": "ppo.clip_epsilon",
    "epsilon_schedule": "ppo.clip_schedule",
    "lambd": "ppo.gae_lambda",
    "num_epoch": "ppo.epochs",
}
_ENCODERS = {
    "simple": "simple",
    "nature_cnn": "nature",
    "resnet": "resnet",
    "match3": "match3",
    "fully_connected": "dense",
}
_CLONING = {"demo_path": "bc.demos", "strength": "bc.strength", "steps": "bc.steps"}


def learner_options(name: str, section: Section) -> Options:
    """Return the options of sections ppo, model, rewards and bc, and init_from; raise ConfigError."""
    out = {option: _taken(section, f"hyperparameters.{key}") for key, option in _HYPER.items()}
    out["ppo.time_horizon"] = _taken(section, "time_horizon")
    critic = "poca" if section["trainer_type"] == "poca" else "local"
    out["model.critic"] = (critic, section.where("trainer_type"))

    out |= _network(section)
    for signal in SIGNALS:
        out |= _signal(name, section, signal)
    out |= _cloning(name, section)
    if section["init_path"] is not None:
        out["init_from"] = _taken(section, "init_path")
    return out


def behavior_warnings(section: Section) -> Iterator[str]:
    """Yield a line for each key whose wish is not fulfilled."""
    for key, what in _WITHOUT_EFFECT.items():
        if key in section.given and section[key] != section.table[key].default:
            yield f"{section.where(key)} has no effect: {what}"

    for signal in SIGNALS:
        prefix = f"reward_signals.{signal}"
        if f"{prefix}.encoding_size" in section.given:
            ignored = (
                "" if not section.has(f"{prefix}.network_settings") else ", and network_settings beat it"
            )
            where = section.where(f"{prefix}.encoding_size")
            yield f"{where} is an old spelling of network_settings.hidden_units{ignored}"
        for key in sorted(section.given):
            inner = key.removeprefix(f"{prefix}.network_settings.")
            if inner == key or inner in ("hidden_units", "num_layers"):
                continue
            if section[key] != section.table.get(key, _NO_KEY).default:
                yield f"{section.where(key)} has no effect: a signal's network has widths only"

    if section["trainer_type"] == "poca":
        for signal in ("curiosity", "rnd", "gail"):
            if _is_on(section, signal):
                yield (
                    f"{section.where(f'reward_signals.{signal}.strength')}: with poca an agent's own signal "
                    "is valued for its team, as in ML-Agents"
                )


def checkpoint_interval(section: Section) -> int:
    """Return steps between two checkpoints."""
    if section["even_checkpoints"] and section["keep_checkpoints"] > 0:
        return max(1, section["max_steps"] // section["keep_checkpoints"])
    return section["checkpoint_interval"]


def team_change(section: Section) -> int:
    """Return steps between two changes of the learning team in self-play."""
    given = section["self_play.team_change"]
    return 5 * section["self_play.save_steps"] if given is None else given


def values_of(options: Options) -> dict[str, Any]:
    """Return options without the places that they come from."""
    return {key: value for key, (value, _) in options.items()}


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by section: {ppo: {lr: 1e-4}}."""
    tree: dict[str, Any] = {}
    for key, value in values.items():
        inside = tree
        *above, last = key.split(".")
        for part in above:
            inside = inside.setdefault(part, {})
        inside[last] = value
    return tree


def _taken(section: Section, key: str) -> tuple[Any, str]:
    return section[key], section.where(key)


def _network(section: Section) -> Options:
    root = "network_settings"
    layers = [section[f"{root}.hidden_units"]] * max(1, section[f"{root}.num_layers"])
    out: Options = {
        "model.hidden": (layers, section.where(f"{root}.hidden_units")),
        "model.normalize_obs": _taken(section, f"{root}.normalize"),
        "model.image_encoder": (
            _ENCODERS[section[f"{root}.vis_encode_type"]],
            section.where(f"{root}.vis_encode_type"),
        ),
        "model.goal_conditioning": _taken(section, f"{root}.goal_conditioning_type"),
    }

    memory = f"{root}.memory"
    if not section.has(memory):
        return out | {"model.memory": ("none", memory)}

    length, batch = section[f"{memory}.sequence_length"], section["hyperparameters.batch_size"]
    if length > batch:
        raise ConfigError(
            f"{section.where(f'{memory}.sequence_length')}={length} must not be above batch_size={batch}"
        )
    return out | {
        "model.memory": ("lstm", section.where(memory)),
        "model.memory_size": _taken(section, f"{memory}.memory_size"),
        "ppo.sequence_length": _taken(section, f"{memory}.sequence_length"),
    }


def _is_on(section: Section, signal: str) -> bool:
    if not section.has("reward_signals"):
        return signal == "extrinsic"
    return section.has(f"reward_signals.{signal}")


def _signal(name: str, section: Section, signal: str) -> Options:
    root = f"reward_signals.{signal}"
    strength = section[f"{root}.strength"] if _is_on(section, signal) else 0.0
    out: Options = {f"rewards.{signal}.strength": (strength, section.where(f"{root}.strength"))}
    if signal == "extrinsic":
        return out | {"ppo.gamma": _taken(section, f"{root}.gamma")}
    if not strength:
        return out

    units = section[f"{root}.network_settings.hidden_units"]
    if not section.has(f"{root}.network_settings") and section[f"{root}.encoding_size"] is not None:
        units = section[f"{root}.encoding_size"]
    layers = max(1, section[f"{root}.network_settings.num_layers"])
    out |= {
        f"rewards.{signal}.gamma": _taken(section, f"{root}.gamma"),
        f"rewards.{signal}.lr": _taken(section, f"{root}.learning_rate"),
        f"rewards.{signal}.hidden": (
            [units] * layers,
            section.where(f"{root}.network_settings.hidden_units"),
        ),
        f"rewards.{signal}.normalize": (False, root),
    }
    if signal == "gail":
        for key in ("use_actions", "use_vail"):
            out[f"rewards.gail.{key}"] = _taken(section, f"{root}.{key}")
        out["rewards.gail.demos"] = ([_demo(name, section, root)], section.where(f"{root}.demo_path"))
    return out


def _cloning(name: str, section: Section) -> Options:
    root = "behavioral_cloning"
    if not section.has(root):
        return {"bc.demos": ([], root)}
    out = {option: _taken(section, f"{root}.{key}") for key, option in _CLONING.items()}
    return out | {"bc.demos": ([_demo(name, section, root)], section.where(f"{root}.demo_path"))}


def _demo(name: str, section: Section, root: str) -> str:
    if section[f"{root}.demo_path"] is None:
        near = next((given.where for key, given in section.given.items() if key.startswith(root)), root)
        raise ConfigError(f"{near}: {root} of {name} needs demo_path: a .demo file or a folder of them")
    return section[f"{root}.demo_path"]


class _NoKey:
    default = None


_NO_KEY = _NoKey()
_WITHOUT_EFFECT = {
    "threaded": "collect.workers=1 collect.overlap=true lets a process collect while this one learns",
    "framework": "PyTorch is all there is",
    "hyperparameters.shared_critic": "the critic has layers of its own here",
    "network_settings.deterministic": "training samples; --inference --deterministic does not",
    "behavioral_cloning.samples_per_update": "each update clones as many samples as it learns from",
    "behavioral_cloning.num_epoch": "cloning has the epochs of the policy (in ML-Agents always 3)",
    "behavioral_cloning.batch_size": "cloning takes the policy's minibatches",
}
