"""From command-line overrides to a checked `Config`.

Below the overrides are the presets and a file of options, or a resumed run's config.yaml. Every mistake is
a ConfigError. No folder is made, and torch is not imported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from mappo_unity.config import effects
from mappo_unity.config.behavior_lines import OPEN
from mappo_unity.config.extras import SWEEP_EXTRA
from mappo_unity.config.option_table import option_table
from mappo_unity.config.options_file import CLEARED, cleared, file_root, read_yaml
from mappo_unity.config.overrides import (
    add_plus_prefix,
    check_overrides,
    check_value,
    given_options,
    parse,
)
from mappo_unity.config.parameters.values import is_whole
from mappo_unity.config.plain_options import check_form
from mappo_unity.config.presets import NO_CHOICE, conf_dir, group_choices
from mappo_unity.config.renamed import rename_keys
from mappo_unity.config.schema import Config
from mappo_unity.config.schema.model import let_mirror_give_way
from mappo_unity.config.schema.workers import let_workers_give_way
from mappo_unity.config.text_lines import key_name, literal_lines
from mappo_unity.errors import ConfigError

_ALWAYS_SAVED = ("env", "output_dir")
"""The first and the last option of a run's config.yaml: a file that lacks one has been cut off."""
_NOISE = ("object_type=", "reference_type=", "Config search path", "provider=", "See ", "To append")


@dataclass(frozen=True)
class Composed:
    """A checked configuration and the tree it came from (with Hydra's own node)."""

    config: Config
    tree: DictConfig

    @property
    def run_dir(self) -> Path:
        """Folder that hydra.run.dir names; raises ConfigError."""
        return _folder(self.tree, "hydra.run.dir")

    def sweep_dir(self, env_name: str) -> Path:
        """Return the folder that hydra.sweep.dir names for jobs of an environment; raises ConfigError."""
        tree = self.tree.copy()
        tree.env.name = env_name
        return _folder(tree, "hydra.sweep.dir")


def _folder(tree: DictConfig, key: str) -> Path:
    try:
        return Path(str(OmegaConf.select(tree, key)))
    except OmegaConfBaseException as error:  # of ${...} that names nothing
        raise ConfigError(f"{key}: {_explain(error)}") from error


def compose_config(lines: list[str], base: Path | None = None, file: Path | None = None) -> Composed:
    """Compose and check the options of one run.

    `base` is the config.yaml of a run that is resumed; without it the presets are the base, and the options
    of `file` go on top of them. Raises ConfigError.
    """
    tree = compose_tree(lines, base, file)
    settle(tree, lines, is_resumed=base is not None)
    return Composed(to_config(tree), tree)


def compose_tree(lines: list[str], base: Path | None = None, file: Path | None = None) -> DictConfig:
    """Return the tree of `compose_config` as Hydra composes it, before `settle`. Raises ConfigError."""
    # our checks come before Hydra's: they name the rule and the choices
    check_overrides(lines, Config, group_choices())

    lines = [add_plus_prefix(line) for line in lines]
    name = register_root(lines, base, file)

    try:
        with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
            return compose(name, lines, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(_explain(error)) from error


def settle(tree: DictConfig, lines: list[str], is_resumed: bool = False) -> None:
    """Do in a composed tree what Hydra does not: let options of presets give way to those of the lines.

    The options of a run that is resumed have settled when it began. Raises ConfigError.
    """
    lines = [add_plus_prefix(line) for line in lines]
    try:
        _keep_parameters_whole(tree, lines)
        if not is_resumed:
            given = given_options(lines)
            let_workers_give_way(tree, given)
            let_mirror_give_way(tree, given)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(_explain(error)) from error


def register_root(lines: list[str], base: Path | None = None, file: Path | None = None) -> str:
    """Register what the options start from, as `compose_config` says; return its name. Raises ConfigError."""
    store = register_schema()

    if base is not None:
        store.store(name="resumed", node=_resumed_root(base))
        return "resumed"

    if file is not None:
        root = file_root(file, lines)
        store.store(name=CLEARED, node=cleared(root), package="_global_")
        store.store(name="from_file", node=root)
        return "from_file"

    return "config"


def register_schema() -> ConfigStore:
    """Register `Config` as "schema", and the sweep plugins' defaults as ..._plugin.

    conf/hydra holds presets of ours under the plugins' plain names; Hydra refuses to build a preset
    on a registered one of the same name.
    """
    Plugins.instance()  # imports the plugins, which register themselves
    store = ConfigStore.instance()

    for choice in SWEEP_EXTRA:
        group, _, name = choice.partition("=")
        nodes = store.repo["hydra"][group.partition("/")[2]]

        # None: the plugin is not installed, or was moved by an earlier call
        node = nodes.pop(f"{name}.yaml", None)
        if node is not None:
            nodes[f"{name}_plugin.yaml"] = replace(node, name=f"{name}_plugin.yaml")

    store.store(name="schema", node=Config)
    return store


def load_config(path: Path) -> Config:
    """Return the options that a run's config.yaml holds; raise ConfigError, which names the file."""
    try:
        return compose_config([], path).config
    except ConfigError as error:
        # some messages name the file already
        if str(error).startswith(str(path)):
            raise
        raise ConfigError(f"{path}: {error}") from error


def to_config(tree: DictConfig) -> Config:
    """Turn a composed tree into the dataclass and run its checks; raise ConfigError."""
    # Hydra's own node is no part of `Config`
    tree = tree.copy()
    with open_dict(tree):
        tree.pop("hydra", None)
        for key in OPEN:
            _respell(tree, key)

    try:
        config = OmegaConf.to_object(tree)
    except OmegaConfBaseException as error:
        raise ConfigError(_explain(error)) from error

    assert isinstance(config, Config)
    return config


def compose_plain(lines: list[str], schema: type) -> Any:
    """Build a dataclass without presets (mappo-eval) from its defaults and overrides; raise ConfigError."""
    lines = literal_lines(lines, schema)
    check_form(lines, schema)
    check_overrides(lines, schema, {})

    tree = OmegaConf.structured(schema)
    for override in parse(lines):
        OmegaConf.update(tree, override.key_or_group, override.value(), merge=True)

    # the first of the options that must be given
    for key in OmegaConf.missing_keys(tree):
        name = key.partition("[")[0]  # runs[0] of ???, which a shell leaves where no file has such a name
        raise ConfigError(f"{name} is not given: {name}=... ({option_table(schema)[name].description})")

    try:
        return OmegaConf.to_object(tree)
    except OmegaConfBaseException as error:
        raise ConfigError(_explain(error)) from error


def check_effect(lines: list[str], configs: list[Config]) -> None:
    """Refuse options on the command line that none of the runs it stands for looks at; raise ConfigError."""
    effects.check_effect(given_options(lines), configs)


def _keep_parameters_whole(tree: DictConfig, lines: list[str]) -> None:
    """Put parameters of the command line in the place of others, whose keys Hydra mixes in: the last wins.

    What is neither a number nor a sampler nor a curriculum, but holds keys, is mixed as Hydra does it.
    """
    root = "env.params"
    for override in parse(lines):
        key = override.key_or_group
        value: Any = None if override.is_delete() else override.value()
        if key != root and not key.startswith(f"{root}."):
            continue

        name = key[len(root) + 1 :]
        if override.is_delete():
            if name and "." not in name:
                with open_dict(tree):
                    tree.env.params.pop(name, None)
            continue
        if "." in name:  # one key of a parameter, as given behind the whole
            OmegaConf.update(tree, key, value, force_add=True)
            continue

        for parameter, raw in ({name: value} if name else value or {}).items():
            if is_whole(raw):
                with open_dict(tree):
                    tree.env.params[parameter] = raw


def _resumed_root(base: Path) -> dict[Any, Any]:
    saved = _read_options(base)

    # behind _self_, so that a recipe of the command line wins over what was saved; by itself none is chosen
    groups = [
        {group: NO_CHOICE if NO_CHOICE in names else None}
        for group, names in group_choices().items()
        if group != "env"
    ]

    # the file that the recipe has for this env, if it has one
    official = {"optional official": f"${{recipe}}/{saved['env'].get('name')}"}
    quiet = [{"override hydra/job_logging": "none"}, {"override hydra/hydra_logging": "none"}]

    return {"defaults": ["schema", "_self_", *groups, official, *quiet], **saved}


def _respell(tree: DictConfig, key: str) -> None:
    """Give the names below an open option their own letters again."""
    names = OmegaConf.to_container(OmegaConf.select(tree, key), resolve=False)
    if _named(names) != names:
        OmegaConf.update(tree, key, _named(names), merge=False)


def _named(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    return {key_name(name) if isinstance(name, str) else name: _named(item) for name, item in value.items()}


def _read_options(path: Path) -> dict[Any, Any]:
    saved = read_yaml(path)
    if not isinstance(saved, dict) or not saved:
        raise ConfigError(f"{path} holds no options")

    missing = [key for key in _ALWAYS_SAVED if key not in saved]
    if missing:
        raise ConfigError(f"{path} is not complete: {' and '.join(missing)} missing")

    # the run may be one of an earlier version
    saved = rename_keys(saved)

    for key, value in saved.items():
        try:
            check_value(str(key), value, Config)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error

    return saved


def _explain(error: BaseException) -> str:
    texts = []

    # Hydra wraps the error that says what is wrong: each message of the chain is told, once
    seen: BaseException | None = error
    while seen is not None:
        lines = [line.strip() for line in str(seen).splitlines() if line.strip()]
        texts.append("; ".join(line for line in lines if not line.startswith(_NOISE)))
        seen = seen.__cause__

    return ": ".join(dict.fromkeys(text for text in texts if text))
