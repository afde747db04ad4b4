"""Options of one behavior name: the sections of its learner, with its own overrides on top.

Beside them stand `init_from`, what its networks begin with, and `train`, whether they learn.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import fields
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mappo_unity.config.option_table import show_value
from mappo_unity.config.overrides import check_value
from mappo_unity.config.schema import BCConfig, Config, ModelConfig, PPOConfig, RewardsConfig
from mappo_unity.errors import ConfigError

INIT_FROM, TRAIN = "init_from", "train"


class BehaviorConfig(NamedTuple):
    """The sections that can differ by behavior."""

    model: ModelConfig
    ppo: PPOConfig
    rewards: RewardsConfig
    bc: BCConfig


def check_behaviors(cfg: Config, policies: Iterable[str]) -> None:
    """Check that every behavior named in the options exists and names only options that exist.

    Raises:
        ConfigError: naming those that the environment has.
    """
    known = list(policies)
    for name in cfg.behaviors:
        if name not in known:
            raise ConfigError(
                f"behaviors.{name}: the environment has no behavior {name!r}; it has {', '.join(known)}"
            )

        behavior_config(cfg, name)

    missing = [name for name in known if name not in cfg.behaviors]
    if cfg.only_named_behaviors and missing:
        raise ConfigError(
            f"the environment has {', '.join(missing)}, which `behaviors` does not name, and "
            "only_named_behaviors=true asks for all: name it there, or give only_named_behaviors=false"
        )


def behavior_config(cfg: Config, policy: str) -> BehaviorConfig:
    """Return the options of a policy name.

    Raises:
        ConfigError: an override names no option, or its value has the wrong type or range.
    """
    own = cfg.behaviors.get(policy) or {}
    where = f"behaviors.{policy}"
    _check_form(own, where)

    sections = BehaviorConfig._fields
    out = BehaviorConfig(*(_merged(getattr(cfg, s), own.get(s), f"{where}.{s}") for s in sections))
    if not is_frozen(cfg, policy):
        _check_teachers(out, policy)
        _check_members(out, policy)
    return out


def _check_form(own: Any, where: str) -> None:
    # the schema has no fields below a behavior's name, so nothing has checked their form yet
    if not isinstance(own, dict):
        raise ConfigError(f"{where}={own!r} must hold sections, for example {where}.ppo.lr=1e-4")

    sections = BehaviorConfig._fields
    for section in own:
        if section not in (*sections, INIT_FROM, TRAIN):
            raise ConfigError(
                f"{where}.{section}: only the sections {', '.join(sections)}, {INIT_FROM} and {TRAIN} can "
                "differ by behavior"
            )
    if not isinstance(own.get(INIT_FROM), (str, type(None))) or own.get(INIT_FROM) == "":
        raise ConfigError(
            f"{where}.{INIT_FROM}={own[INIT_FROM]!r} must name a run folder, a checkpoint or an ONNX file; "
            "null: new networks"
        )
    if not isinstance(own.get(TRAIN, True), bool):
        raise ConfigError(f"{where}.{TRAIN}={own[TRAIN]!r} must be true or false")

    if isinstance(own.get("bc"), dict) and "only" in own["bc"]:
        raise ConfigError(
            f"{where}.bc.only={show_value(own['bc']['only'])} has no effect: the environment is played for "
            "all behaviors or for none; give bc.only=true"
        )


def _check_members(out: BehaviorConfig, policy: str) -> None:
    if out.ppo.shuffle_members and not out.model.share_parameters:
        raise ConfigError(
            f"ppo.shuffle_members=true of {policy} does not go with model.share_parameters=false, where each "
            "member's network learns from that member alone; give ppo.shuffle_members=false"
        )


def _check_teachers(out: BehaviorConfig, policy: str) -> None:
    if not (out.rewards.extrinsic.strength or out.rewards.intrinsic or out.bc.demos):
        raise ConfigError(
            f"rewards.extrinsic.strength=0 leaves {policy} nothing to learn from: turn another stream on, "
            "such as rewards.rnd.strength=0.3"
        )
    if out.bc.demos and not out.model.share_parameters:
        raise ConfigError(
            f"bc.demos={show_value(out.bc.demos)} of {policy} needs model.share_parameters=true: a recording "
            "does not tell the members of a team apart"
        )


def init_source(cfg: Config, policy: str) -> tuple[str, str | None]:
    """Return the option that says what a policy begins with, and its value; None: with new weights."""
    own = cfg.behaviors.get(policy) or {}
    if INIT_FROM in own:
        return f"behaviors.{policy}.{INIT_FROM}", own[INIT_FROM]
    return INIT_FROM, cfg.init_from


def is_frozen(cfg: Config, policy: str) -> bool:
    """Return whether a policy only plays (`behaviors.NAME.train=false`)."""
    return not (cfg.behaviors.get(policy) or {}).get(TRAIN, True)


def _merged(section: Any, own: Any, where: str) -> Any:
    if not own:
        return section
    if not isinstance(own, dict):
        raise ConfigError(f"{where}={own!r} must hold options, for example {where}.lr=1e-4")

    names = [field.name for field in fields(section)]
    for name in own:
        if name not in names:
            close = difflib.get_close_matches(str(name), names, 3)
            hint = f"; did you mean {' or '.join(close)}?" if close else f"; there are {', '.join(names)}"
            raise ConfigError(f"{where}.{name}: there is no such option{hint}")
    _check_values(own, where)

    # the new object runs the section's own checks, on the values of both
    try:
        merged = OmegaConf.merge(OmegaConf.structured(section), own)
        assert isinstance(merged, DictConfig)
        return OmegaConf.to_object(merged)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    except OmegaConfBaseException as error:
        raise ConfigError(f"{where}: {str(error).splitlines()[0]}") from error


def _check_values(own: dict[Any, Any], where: str) -> None:
    """Raise ConfigError for the first value that does not fit its option, as for options of all."""
    behavior, _, section = where.rpartition(".")
    for name, value in own.items():
        try:
            check_value(f"{section}.{name}", value, Config)
        except ConfigError as error:
            raise ConfigError(f"{behavior}.{error}") from error
