"""ML-Agents' configuration, checked and merged: default_settings, behaviors, the flags on top."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from mappo_unity.config.mlagents.behavior import team_change
from mappo_unity.config.mlagents.flags import Flags, flag_of
from mappo_unity.config.mlagents.keys import BEHAVIOR, OPTIONAL, RENAMED, RUN, TOP, Key
from mappo_unity.config.mlagents.settings import Given, Section, Settings, checked
from mappo_unity.config.mlagents.yaml_lines import Node, inside, read_yaml
from mappo_unity.config.option_table import did_you_mean
from mappo_unity.errors import ConfigError

_SPREAD = ("beta_schedule", "epsilon_schedule")


def read_settings(flags: Flags) -> Settings:
    """Read the file that a command line names, and put its flags on top; raise ConfigError."""
    if flags.config is None:
        tree, reader = Node({}, 1), _Reader("")
    else:
        tree, reader = read_yaml(Path(flags.config)), _Reader(f"{flags.config}, line ")

    for name, node in tree.value.items():
        if name not in TOP:
            raise ConfigError(reader.unknown_section(name, node))

    default = reader.default(tree)
    sections = {name: reader.behavior(name, node, default) for name, node in reader.behaviors(tree)}
    if not sections and default is None:
        # without a file ML-Agents takes its defaults for whatever is there
        if flags.config is not None:
            raise ConfigError(f"{flags.config} names no behavior: give behaviors: or default_settings:")
        default = Section(BEHAVIOR)

    run = reader.run(tree)
    for key, value in flags.given.items():
        run.given[key] = Given(checked(value, RUN[key], flag_of(key)), flag_of(key))

    parameters = reader.parameters(tree)
    return Settings(sections, default, run, parameters, reader.place_in(tree), flags.warnings)


class _Reader:
    """Reads sections of one file; `before` stands in front of a line's number."""

    def __init__(self, before: str) -> None:
        self._before = before

    def place(self, node: Node, key: str) -> str:
        return f"{self._before}{node.line}: {key}"

    def unknown_section(self, name: str, node: Node) -> str:
        inside = node.value if isinstance(node.value, dict) else {}
        if name == "default" or {"trainer", "trainer_type", "batch_size", "hyperparameters"} & {*inside}:
            return (
                f"{self.place(node, name)}: this is the format before ML-Agents Release 3: behaviors stand "
                "below behaviors: now, and what default: held below default_settings:"
            )
        hint = did_you_mean(name, TOP)
        return f"{self.place(node, name)} is no section of ML-Agents{hint}; sections: {', '.join(TOP)}"

    def default(self, tree: Node) -> Section | None:
        node = tree.value.get("default_settings")
        if node is None or node.value is None:
            return None
        own = self._flat(node, "default_settings")
        # expanded before behaviors come on top: their learning_rate_schedule does not spread any more, and
        # their signals come beside the environment's, and their save_steps do not move team_change
        rate = own.get("hyperparameters.learning_rate_schedule")
        for name in _SPREAD:
            value = Given("linear", "default_settings") if rate is None else rate
            own.setdefault(f"hyperparameters.{name}", value)
        section = Section(BEHAVIOR, own)
        if not section.has("reward_signals"):
            own["reward_signals.extrinsic"] = Given({}, "default_settings")
        if section.has("self_play"):
            own["self_play.team_change"] = Given(team_change(section), section.where("self_play.team_change"))
        return section

    def behaviors(self, tree: Node) -> Iterator[tuple[str, Node]]:
        node = tree.value.get("behaviors")
        if node is None:
            return
        if not isinstance(node.value, dict) or not node.value:
            raise ConfigError(f"{self.place(node, 'behaviors')} must hold behaviors by name")
        yield from node.value.items()

    def behavior(self, name: str, node: Node, default: Section | None) -> Section:
        own = self._flat(node, f"behaviors.{name}")
        given = _merged({} if default is None else default.given, own)
        section = Section(BEHAVIOR, given, self.place(node, f"behaviors.{name}"))

        rate = own.get("hyperparameters.learning_rate_schedule")
        for key in _SPREAD:
            if rate is not None and f"hyperparameters.{key}" not in section.given:
                section.given[f"hyperparameters.{key}"] = rate
        return section

    def run(self, tree: Node) -> Section:
        section = Section(RUN)
        for name in dict.fromkeys(key.partition(".")[0] for key in RUN):
            node = tree.value.get(name)
            if node is not None and name in RUN:
                section.given[name] = Given(
                    checked(node.plain, RUN[name], self.place(node, name)), self.place(node, name)
                )
            elif node is not None:
                self._take(node, name, name, RUN, section.given)
        return section

    def parameters(self, tree: Node) -> dict[str, Given]:
        node = tree.value.get("environment_parameters")
        if node is None or node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise ConfigError(f"{self.place(node, 'environment_parameters')} must hold parameters by name")
        return {
            name: Given(item.plain, self.place(item, f"environment_parameters.{name}"))
            for name, item in node.value.items()
        }

    def place_in(self, tree: Node) -> Callable[[str, str], str]:
        """Return a function that finds the line of what an error about a parameter names."""

        def place(name: str, rest: str) -> str:
            node = tree.value["environment_parameters"].value[name]
            for word in re.findall(r"\w+", re.split(r"[=:]", rest)[0]):
                node = inside(node, word)
            return self.place(node, f"environment_parameters.{name}")

        return place

    def _flat(self, node: Node, root: str) -> dict[str, Given]:
        if node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise ConfigError(f"{self.place(node, root)} must hold keys, such as trainer_type: ppo")
        self._refuse_sac(node, root)
        out: dict[str, Given] = {}
        self._take(node, root, "", BEHAVIOR, out)
        return out

    def _refuse_sac(self, node: Node, root: str) -> None:
        kind = node.value.get("trainer_type")
        if kind is None or kind.value != "sac":
            return
        hyper = node.value.get("hyperparameters")
        inside = hyper.value if hyper is not None and isinstance(hyper.value, dict) else {}
        own = [name for name in inside if f"hyperparameters.{name}" not in BEHAVIOR]
        alone = f"; its {', '.join(own)} mean nothing to ppo" if own else ""
        raise ConfigError(
            f"{self.place(kind, root + '.trainer_type')}: sac is not supported, this trainer "
            f"learns on-policy: give ppo or poca, with hyperparameters of theirs{alone}"
        )

    def _take(
        self, node: Node, root: str, prefix: str, table: Mapping[str, Key], out: dict[str, Given]
    ) -> None:
        """Take a section's keys; `root` names it in messages, `prefix` in the table."""
        if not isinstance(node.value, dict) or (not node.value and prefix not in OPTIONAL):
            empty = "is empty" if not node.value else "must hold keys"
            raise ConfigError(f"{self.place(node, root)} {empty}: give keys, or leave it out")

        for name, item in node.value.items():
            key = f"{prefix}.{name}" if prefix else name
            where = self.place(item, f"{root}.{name}")
            if key in table:
                out[key] = Given(checked(item.plain, table[key], where), where)
            elif not any(known.startswith(f"{key}.") for known in table):
                raise ConfigError(self._unknown(where, name, prefix, table))
            elif key == "reward_signals" and item.value == {}:
                raise ConfigError(f"{where} is empty: name a signal, such as extrinsic:")
            else:
                is_switch = key in OPTIONAL or key.count(".") == 1 and prefix == "reward_signals"
                if is_switch and (item.value is None or item.value == {}):
                    out[key] = Given(item.value if key in OPTIONAL else {}, where)
                    continue
                self._take(item, f"{root}.{name}", key, table, out)

    def _unknown(self, where: str, name: str, prefix: str, table: Mapping[str, Key]) -> str:
        if table is BEHAVIOR and name in RENAMED:
            new = RENAMED[name]
            return f"{where} is an old spelling: " + (f"{new} now" if new else "there is none any more")

        elsewhere = [key for key in table if key.rpartition(".")[2] == name]
        if elsewhere:
            return f"{where} does not stand there: it is {elsewhere[0]}"

        cut = len(prefix) + 1 if prefix else 0
        inside = [key for key in table if key.startswith(f"{prefix}." if prefix else "")]
        names = list(dict.fromkeys(key[cut:].partition(".")[0] for key in inside))
        return f"{where} is no key of ML-Agents{did_you_mean(name, names)}; keys there: {', '.join(names)}"


def _merged(default: dict[str, Given], own: dict[str, Given]) -> dict[str, Given]:
    """Return a behavior's keys above the default's; a section that it sets to null is off."""
    off = [key for key, given in own.items() if given.value is None and key in OPTIONAL]
    kept = {
        key: given
        for key, given in default.items()
        if not any(key == name or key.startswith(f"{name}.") for name in off)
    }
    # a section that the default has switched off, and the behavior fills
    for name in OPTIONAL:
        if name in kept and kept[name].value is None and any(key.startswith(f"{name}.") for key in own):
            del kept[name]
    return kept | own
