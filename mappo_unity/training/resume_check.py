"""Whether a checkpoint fits an environment and its options."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.schema import ModelConfig, ValueNormKind
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.policies.layouts import describe_spec, same_layout
from mappo_unity.policies.policy import model_from_saved
from mappo_unity.runs.checkpoint import CheckpointError
from mappo_unity.training.collection.description import Played


def describe_policies(env: Played) -> dict[str, Any]:
    """Return what a network must fit: sensors, actions and team size of every policy name."""
    out = {}
    for name, sides in env.sides.items():
        behavior = env.behaviors[sides[0]]
        out[name] = describe_spec(behavior.spec, behavior.slots.team_size)
    return out


def check_compatible(
    path: Path, state: dict[str, Any], env_name: str, layout: dict[str, Any], models: dict[str, Any]
) -> None:
    """Refuse a checkpoint of another environment or network, saying what differs."""
    if state["env_name"] != env_name:
        raise CheckpointError(
            f"checkpoint {path} was written for env={state['env_name']}, not for env={env_name}"
        )

    saved_layout = state["layout"]
    if saved_layout.keys() != layout.keys() or not all(
        same_layout(saved_layout[name], layout[name]) for name in layout
    ):
        raise CheckpointError(
            f"checkpoint {path} was written for policies {state['layout']}, but the environment has {layout}"
        )

    different = []
    # an option that the checkpoint does not know yet had its default's effect
    saved = describe_models({name: model_from_saved(state["model"][name]) for name in models})
    for name, model in models.items():
        different += _differences("model", saved[name], model)

    if different:
        raise CheckpointError(f"checkpoint {path} holds another network: {'; '.join(different)}")


def _differences(option: str, there: Any, here: Any) -> list[str]:
    """Say which options differ, each one of a group for itself."""
    if isinstance(there, dict) and isinstance(here, dict):
        return [line for key in here for line in _differences(f"{option}.{key}", there[key], here[key])]
    return [f"{option}={show_value(there)} there, {show_value(here)} here"] if there != here else []


def check_learners(path: Path, saved: dict[str, Any], learners: dict[str, PolicyLearner]) -> None:
    """Refuse a checkpoint of other reward streams or models of them, or of values in another scale."""
    _check_streams(path, saved, learners)
    for name, learner in learners.items():
        _check_value_scale(path, name, saved[name], learner.cfg.normalize_values)


def _check_value_scale(path: Path, name: str, saved: dict[str, Any], here: ValueNormKind) -> None:
    """Refuse a critic whose outputs would be read in another scale than it learnt them in."""
    is_normalized = float(saved["value_norm"]["debias"]) > 0
    has_learnt = int(saved.get("updates", 0)) > 0  # else both are as they were made
    # PopArt rescales a critic that learnt without, and takes up that of `running`
    misread = here is ValueNormKind.none if is_normalized else has_learnt and here is ValueNormKind.running
    if misread:
        there, others = ("popart or running",) * 2 if is_normalized else ("none", "none or popart")
        raise CheckpointError(
            f"checkpoint {path} holds a critic of {name} that learnt with ppo.normalize_values={there}, and "
            f"ppo.normalize_values={here.name} would misread its values; with resume it can be {others}"
        )


def _check_streams(path: Path, saved: dict[str, Any], learners: dict[str, PolicyLearner]) -> None:
    for name, learner in learners.items():
        there = set(saved[name].get("rewards", {}))
        here = {stream.name for stream in learner.rewards.intrinsic}
        for stream in sorted(there ^ here):
            state, other = ("on", "off") if stream in there else ("off", "on")
            raise CheckpointError(
                f"checkpoint {path} holds another critic of {name}: rewards.{stream} is {state} there and "
                f"{other} here; its strength may change with resume, but not from or to 0"
            )

        for own in learner.rewards.intrinsic:
            model = saved[name]["rewards"][own.name]["model"]
            if _shapes(model) != _shapes(own.model.state_dict()):
                options = {option: value for option, value in vars(own.cfg).items() if option in _OF_LAYERS}
                raise CheckpointError(
                    f"checkpoint {path} holds another model of rewards.{own.name} of {name}: what makes its "
                    "layers cannot change with resume; here "
                    + ", ".join(f"{option}={show_value(value)}" for option, value in options.items())
                )


def check_workers(path: Path, state: dict[str, Any], workers: int) -> None:
    """Refuse a checkpoint of another number of workers: its environments are others."""
    saved = len(state.get("workers", []))
    if saved != workers:
        raise CheckpointError(
            f"checkpoint {path} was written with collect.workers={saved}, which cannot change with resume; "
            f"here it is {workers}"
        )


def known_generators(state: dict[str, Any], learners: int) -> list[Any] | None:
    """Return the generators of the learners beside the first, where a checkpoint has them of as many."""
    generators: list[Any] | None = state.get("generators")
    return generators if generators is not None and len(generators) == learners - 1 else None


def has_snapshot(state: dict[str, Any]) -> bool:
    """Return whether a checkpoint holds its environments' states; without them new episodes begin."""
    return all(part["env"] is not None for part in state.get("workers") or [state])


_OF_LAYERS = ("hidden", "use_actions", "use_vail")
"""Options of streams that their models' layers follow from."""


def _shapes(state: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in state.items()}


def plain(value: Any) -> Any:
    """Turn enums into their values, all through a nested dict or list."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return getattr(value, "value", value)


def describe_models(models: dict[str, ModelConfig]) -> dict[str, Any]:
    """Return the model options of every policy name as plain values."""
    return {name: plain(asdict(model)) for name, model in models.items()}
