"""A warm start: what learners begin with instead of drawn weights, and the lines that say so.

Only networks are copied: steps, optimizer, schedules and episodes begin anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.per_behavior import behavior_config, init_source
from mappo_unity.config.schema import (
    Config,
    DistributionKind,
    MemoryKind,
    ModelConfig,
    ValueNormKind,
    show_mirror,
)
from mappo_unity.errors import ConfigError
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.value_norm import by_stream
from mappo_unity.policies.policy import model_from_saved
from mappo_unity.policies.policy_files import Kind, choose_checkpoint
from mappo_unity.policies.warm_start.actors import copy_network
from mappo_unity.policies.warm_start.onnx_network import read_network
from mappo_unity.policies.warm_start.sources import find_source
from mappo_unity.policies.warm_start.tensors import Row, copy_fitting, table
from mappo_unity.runs import checkpoint


def warm_start(
    cfg: Config, learners: Mapping[str, PolicyLearner], layouts: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Copy tensors into the learners of all behaviors that have an `init_from`; return lines for the user.

    Args:
        cfg: the run's options.
        learners: by policy name, new.
        layouts: what each was built for, as `describe_spec` returns it.

    Raises:
        ConfigError: nothing fits, or an ONNX file cannot be read as a network of ours.
    """
    lines: list[str] = []
    for name, learner in learners.items():
        option, where = init_source(cfg, name)
        if where is None:
            continue

        source = find_source(where, option)
        try:
            if source.kind is Kind.onnx:
                told, rows = _from_onnx(source.path, learner, layouts[name])
                notes = []
            else:
                path = choose_checkpoint(source.path, option)
                told, rows, theirs = _from_checkpoint(path, name, learner)
                own = behavior_config(cfg, name).model
                notes = _unseen(theirs, own, learner.actor.layout.continuous > 0)
        except ConfigError as error:
            raise ConfigError(f"{option}: {error}") from error

        # biases of other networks fit by chance: they are no start without a layer of the actor's
        layers = [row for row in rows if row.name.startswith("actor.") and len(row.shape or ()) > 1]
        if all(row.reason for row in layers):
            mistake = ConfigError(
                f"{option}={where}: no layer of it fits the actor of {name}; "
                f"behaviors.{name}.init_from=null starts {name} anew"
            )
            mistake.details = tuple(table(rows))
            raise mistake
        lines += [f"{name} begins with {told}:", *table(rows), *notes]
    return lines


def _from_onnx(path: Path, learner: PolicyLearner, layout: Mapping[str, Any]) -> tuple[str, list[Row]]:
    network = read_network(path)
    rows, error = copy_network(network, learner.actor, layout["sensors"])

    told = f"{path}, whose network has {show_options(network.options)}"
    if error is not None:
        told += f"; on random observations its actions differ from onnxruntime's by {error:.1e}"
    return told, [*rows, Row("critic", None, "an ONNX file holds none: a new one learns")]


def show_options(options: Mapping[str, Any]) -> str:
    """Return the options of a network as a line of `name=value`."""
    shown = [f"{name}={show_value(value)}" for name, value in options.items() if name != "mirror"]
    mirror = show_mirror(options["mirror"])
    return " ".join(shown + [f"mirror={mirror}"] * (mirror != "none"))


def _unseen(there: ModelConfig, here: ModelConfig, is_continuous: bool) -> list[str]:
    """Return a line about each option that the layers' shapes do not show, and that is another one here."""
    options = ["activation", "normalize_obs", "layer_norm", "flatten_branches"]
    options += ["critic_traces", "critic_traced"]
    if is_continuous:
        options.append("action_distribution")
    if here.action_distribution is DistributionKind.tanh_normal:
        options.append("init_log_std")
    if here.memory is MemoryKind.traces:
        options += ["memory_traces", "memory_traced"]
    pairs = [(option, *(show_value(getattr(model, option)) for model in (there, here))) for option in options]
    pairs.append(("mirror", *(show_mirror(asdict(model.mirror)) for model in (there, here))))
    return [
        f"  note: model.{option}={old} there and {new} here: what is copied computes otherwise"
        for option, old, new in pairs
        if old != new
    ]


def _from_checkpoint(path: Path, name: str, learner: PolicyLearner) -> tuple[str, list[Row], ModelConfig]:
    state = checkpoint.load(path)
    known = list(state["learners"])
    if name not in known and len(known) > 1:
        raise ConfigError(
            f"{path} holds policies {', '.join(known)}, none called {name}; "
            f"behaviors.{name}.init_from=null starts {name} anew"
        )

    theirs = name if name in known else known[0]
    saved = state["learners"][theirs]
    rows = copy_fitting(learner.actor, "actor", saved["actor"], {})
    if "critic" in saved:
        rows += _critic(learner, saved["critic"], by_stream(saved["value_norm"]))
    else:  # a past policy of self-play
        rows.append(Row("critic", None, "the file holds none: a new one learns"))
    told = f"{path}" + (f", policy {theirs}" if theirs != name else "")
    model = model_from_saved(state["model"][theirs])
    return f"{told} ({int(state['agent_steps']):,} agent steps)", rows, model


def _critic(learner: PolicyLearner, saved: dict[str, Any], statistics: dict[str, Any]) -> list[Row]:
    """Copy a critic; its values are in the scale of the statistics under which it learnt."""
    if not learner.value_norm.enabled and float(statistics["debias"]) > 0:
        return [
            Row("critic", None, "its values are normalised, here they are not (ppo.normalize_values=none)")
        ]
    # PopArt rescales the last layer as its statistics move away from 0 and 1; nothing else does
    if learner.cfg.normalize_values is ValueNormKind.running and not float(statistics["debias"]):
        return [
            Row("critic", None, "its values are not normalised, here they are (ppo.normalize_values=running)")
        ]

    critic = copy_fitting(learner.critic, "critic", saved, {})
    whole = not any(row.reason for row in critic)
    reason = {"": "it is of use to the whole critic only"}
    return [*critic, *copy_fitting(learner.value_norm, "value_norm", statistics if whole else {}, reason)]
