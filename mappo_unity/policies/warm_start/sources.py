"""What init_from names, and the model options that an ONNX file brings; known without torch."""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mappo_unity.config.option_table import show_value
from mappo_unity.config.options_file import file_root
from mappo_unity.config.overrides import given_options, parse
from mappo_unity.config.schema import Config, MirrorConfig, ModelConfig, show_mirror
from mappo_unity.errors import ConfigError
from mappo_unity.policies.policy_files import Kind, Source, check_checkpoint, locate

MIRROR = "mirror"
STARTS = "a run folder, a checkpoint (.pt) or an ONNX file"


def find_source(where: str, option: str) -> Source:
    """Return what an `init_from` names.

    Raises:
        ConfigError: nothing is there, or nothing that networks could begin with.
    """
    source = locate(where, option, STARTS)
    if source.kind is Kind.random:
        raise ConfigError(
            f"{option}=random: without {option} networks begin with random weights; give {STARTS}"
        )
    if source.kind is Kind.onnx_folder:
        raise ConfigError(
            f"{option}={where} is a folder of ONNX files: give each behavior its own, "
            "behaviors.NAME.init_from=FOLDER/NAME.onnx"
        )
    return source


def adopt_file_options(config: Config, lines: list[str], file: Path | None = None) -> Config:
    """Return options whose networks have the shape of the ONNX files that they begin with.

    Args:
        config: the composed options; preset and recipe give way to the file.
        lines, file: what the user gave, which is not overruled.

    Raises:
        ConfigError: a given option contradicts a file, or there is no such file or checkpoint.
    """
    given = {name.split(".")[1] for name in given_options(lines) if name.startswith("model.")}
    root = {} if file is None else file_root(file, lines)
    given |= set(root.get("model") or {})
    given_to_behaviors = _given_to_behaviors(lines, root.get("behaviors") or {})

    behaviors = copy.deepcopy(config.behaviors)
    shape = _shape_of(config.init_from, "init_from")
    model = _adopted(config.model, shape, given, "model", str(config.init_from))

    for name, own in behaviors.items():
        if not isinstance(own, dict) or not isinstance(own.get("model") or {}, dict):
            continue  # `behavior_config` says what is wrong with it
        option = f"behaviors.{name}"
        theirs = dict(own.get("model") or {})
        given_to_it = {key: value for key, value in theirs.items() if (name, key) in given_to_behaviors}
        if "init_from" in own:
            # what the file of the other behaviors changed is not meant for this one
            back = {key: _plain(getattr(config.model, key)) for key in shape if key not in theirs}
            shape_of_own = _shape_of(own["init_from"], f"{option}.init_from")
            _check_given(given_to_it, shape_of_own, f"{option}.model", str(own["init_from"]))
            if shape or shape_of_own:
                own["model"] = back | theirs | shape_of_own
        else:
            _check_given(given_to_it, shape, f"{option}.model", str(config.init_from))
            if shape:
                own["model"] = {key: value for key, value in theirs.items() if key not in shape}

    return replace(config, model=model, behaviors=behaviors)


def _given_to_behaviors(lines: list[str], of_file: dict[str, Any]) -> set[tuple[str, str]]:
    """Return the model options that the user, and no preset, gave to behaviors: names of both."""
    trees = [of_file]
    for line in parse(lines):
        first, *names = line.key_or_group.split(".")
        value = line.value()
        for name in reversed(names):
            value = {name: value}
        if first == "behaviors" and isinstance(value, dict):
            trees.append(value)

    return {
        (str(name), key)
        for tree in trees
        for name, own in tree.items()
        if isinstance(own, dict) and isinstance(own.get("model"), dict)
        for key in own["model"]
    }


def _shape_of(where: Any, option: str) -> dict[str, Any]:
    """Return the model options of an ONNX file; none of a checkpoint, which is only looked for."""
    if where is None:
        return {}
    if not isinstance(where, str) or not where:
        raise ConfigError(f"{option}={where!r} must name {STARTS}, or be null")

    source = find_source(where, option)
    if source.kind is Kind.onnx:
        # it loads torch, which mistakes told before need not wait for
        from mappo_unity.policies.warm_start.onnx_network import read_network

        return read_network(source.path).options
    check_checkpoint(source)
    return {}


def _adopted(
    model: ModelConfig, shape: dict[str, Any], given: Collection[str], where: str, path: str
) -> ModelConfig:
    changed = {key: value for key, value in shape.items() if _plain(getattr(model, key)) != value}
    _check_given({key: _plain(getattr(model, key)) for key in given if key in shape}, shape, where, path)
    if not shape:
        return model
    try:
        merged = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(model), changed))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    assert isinstance(merged, ModelConfig)
    return merged


def _check_given(given: dict[str, Any], shape: dict[str, Any], where: str, path: str) -> None:
    for key, value in given.items():
        if key not in shape:
            continue
        value = _plain(value)
        if key == MIRROR:
            # of a behavior only what is given stands there
            value = _plain(_mirror(value, f"{where}.{key}").in_effect)

        if value != shape[key]:
            own, theirs = (show_mirror(v) if key == MIRROR else show_value(v) for v in (value, shape[key]))
            raise ConfigError(
                f"{where}.{key}={own} contradicts {path}, whose network has {key}={theirs}: leave the option "
                "out, and it is taken from the file"
            )


def _mirror(value: Any, where: str) -> MirrorConfig:
    names = [field.name for field in fields(MirrorConfig)]
    if not isinstance(value, dict) or not value.keys() <= set(names):
        raise ConfigError(f"{where}={show_value(value)} must hold options among {', '.join(names)}")
    return MirrorConfig(**value)


def _plain(value: Any) -> Any:
    value = getattr(value, "value", value)
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return list(value) if isinstance(value, (list, tuple)) else value
