"""A YAML file as nested nodes that know their lines, so that a mistake is told with its place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from mappo_unity.errors import ConfigError

_SPELLINGS = {
    "lessons": ("curriculum",),
    "completion": ("completion_criteria",),
    "sampler": ("sampler_type",),
    "min": ("min_value",),
    "max": ("max_value",),
}


@dataclass(frozen=True)
class Node:
    """A value of the file and the line it stands in, from 1."""

    value: Any
    """A scalar, a list of nodes, or nodes by key."""
    line: int

    @property
    def plain(self) -> Any:
        """The value without lines."""
        if isinstance(self.value, dict):
            return {key: node.plain for key, node in self.value.items()}
        if isinstance(self.value, list):
            return [node.plain for node in self.value]
        return self.value


def read_yaml(path: Path) -> Node:
    """Return the file's outermost mapping; an empty file is an empty one.

    Raises:
        ConfigError: it cannot be read, is no YAML, or gives a key twice.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file") from error
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"{path} cannot be read ({error})") from error

    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            tree = Node({}, 1)
        else:
            _check_twice(path, root, set())
            tree = _node(loader, root)
    except yaml.MarkedYAMLError as error:
        raise ConfigError(_explain(path, text, error)) from error
    except ConfigError:
        raise
    # of values such as the date 2026-02-30, and anchors that hold themselves
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is no YAML ({' '.join(str(error).split())})") from error

    if not isinstance(tree.value, dict):
        raise ConfigError(f"{path}, line {tree.line}: the file must hold sections, such as behaviors:")
    return tree


def inside(node: Node, word: str) -> Node:
    """Return the node of a parameter's key or of a lesson's number, also as ML-Agents spells it.

    The node itself where there is none.
    """
    if isinstance(node.value, list):
        return node.value[int(word)] if word.isdigit() and int(word) < len(node.value) else node
    if not isinstance(node.value, dict):
        return node

    parameters = node.value.get("sampler_parameters")
    for name in (word, *_SPELLINGS.get(word, ())):
        if name in node.value:
            return node.value[name]
        if parameters is not None and isinstance(parameters.value, dict) and name in parameters.value:
            return parameters.value[name]
    return node


def _node(loader: yaml.SafeLoader, node: yaml.Node) -> Node:
    line = node.start_mark.line + 1
    if isinstance(node, yaml.SequenceNode):
        return Node([_node(loader, item) for item in node.value], line)
    if not isinstance(node, yaml.MappingNode):
        return Node(loader.construct_object(node), line)

    loader.flatten_mapping(node)  # <<: *anchor
    # the line of a section is that of its name
    found = {}
    for key, item in node.value:
        inner = _node(loader, item)
        found[str(key.value)] = Node(inner.value, key.start_mark.line + 1)
    return Node(found, line)


def _check_twice(path: Path, node: yaml.Node, done: set[int]) -> None:
    """Look for keys that are given twice, before `flatten_mapping` puts those of anchors beside a node's own.

    `done`: ids of nodes; one with an anchor comes by several times.
    """
    if id(node) in done or not isinstance(node, yaml.CollectionNode):
        return
    done.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_twice(path, item, done)
        return

    seen: dict[str, int] = {}
    for key, item in node.value:
        name, line = str(key.value), key.start_mark.line + 1
        if name in seen:
            raise ConfigError(f"{path}, line {line}: {name} is given twice, first in line {seen[name]}")
        seen[name] = line
        _check_twice(path, item, done)


def _explain(path: Path, text: str, error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    number = 1 if mark is None else mark.line + 1
    lines = text.splitlines()
    content = lines[number - 1] if number <= len(lines) else ""

    key = content.partition(":")[0].strip().lstrip("- ")
    where = f"{path}, line {number}" + (f": {key}" if ":" in content else "")
    if "\t" in content[: len(content) - len(content.lstrip())]:
        return f"{where}: a tab stands before it; YAML takes spaces only"
    return f"{where}: this is no YAML ({error.problem or error.context})"
