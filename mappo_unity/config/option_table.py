"""The options of a command as a table: one `Option` for each field of its dataclass.

The description of an option is the docstring below its field, which is read from the source.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import sys
import types
from collections.abc import Iterable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", Any: "any value"}
_PLURALS = {int: "whole numbers", float: "numbers", str: "texts"}


@dataclass(frozen=True)
class Option:
    """One option: its full name, type, default and description; a section has children."""

    key: str
    type: Any
    default: Any
    description: str
    is_section: bool = False

    @property
    def is_open(self) -> bool:
        """Whether the option takes names of the user's own below it (``env.params.mass``)."""
        return get_origin(without_none(self.type)) is dict

    @property
    def accepts(self) -> str:
        """Say in words which values the option takes."""
        return describe_type(self.type)


@cache
def option_table(schema: type, prefix: str = "") -> dict[str, Option]:
    """Return every option and section of a dataclass by its full name, in the order of the source."""
    table: dict[str, Option] = {}
    hints, docs = get_type_hints(schema), _field_docs(schema)

    for item in fields(schema):
        key, hint = prefix + item.name, hints[item.name]
        default = item.default_factory() if item.default_factory is not MISSING else item.default
        is_section = is_dataclass(hint)
        table[key] = Option(key, hint, default, docs.get(item.name, ""), is_section)
        if is_section:
            table.update(option_table(hint, key + "."))

    return table


def find_option(table: dict[str, Option], key: str) -> Option | None:
    """Return the option that a key sets: itself, or the open option above it; None if there is none."""
    if key in table:
        return table[key]

    # the nearest option above decides: below one that is not open there are no names
    parts = key.split(".")
    for length in range(len(parts) - 1, 0, -1):
        above = table.get(".".join(parts[:length]))
        if above is not None:
            return above if above.is_open else None

    return None


def close_names(name: str, names: Iterable[str], count: int = 3) -> list[str]:
    """Return the names most like a misspelt one, best first: whole names, then last parts."""
    names = list(names)

    # the right name in the wrong section, lr for ppo.lr
    last = name.rsplit(".", 1)[-1]
    same_last = [other for other in names if other.rsplit(".", 1)[-1] == last]

    # the whole name misspelt
    lower = {other.lower(): other for other in names}
    alike = [lower[hit] for hit in difflib.get_close_matches(name.lower(), lower, count, 0.6)]

    # the last part misspelt, whatever stands before it
    tails: dict[str, list[str]] = {}
    for other in names:
        tails.setdefault(other.rsplit(".", 1)[-1], []).append(other)
    by_tail = [other for hit in difflib.get_close_matches(last, tails, count, 0.75) for other in tails[hit]]

    return list(dict.fromkeys(same_last + alike + by_tail))[:count]


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return ``" (did you mean a or b?)"`` for a misspelt name, or an empty text."""
    hits = close_names(name, names)
    return f" (did you mean {' or '.join(hits)}?)" if hits else ""


def with_article(name: str) -> str:
    """Return ``"an int"`` for int, ``"a function"`` for function."""
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def describe_type(hint: Any) -> str:
    """Say in words which values a type takes: ``Optional[int]`` -> "a whole number or null"."""
    inner = without_none(hint)
    if inner is not hint:
        return f"{describe_type(inner)} or null"

    if get_origin(hint) is list:
        (item,) = get_args(hint)
        if _is_enum(item):
            return f"a list of any of {_members(item)}, for example [{next(iter(item)).name}]"

        example = "[128,128]" if item is int else "[a,b]"
        return f"a list of {_PLURALS.get(item, 'values')}, for example {example}"

    if get_origin(hint) is dict:
        return "named values, for example {name: 1}"
    if _is_enum(hint):
        return f"one of {_members(hint)}"

    return _WORDS.get(hint, str(hint))


def short_type(hint: Any) -> str:
    """Return a type as the help shows it: ``Optional[list[int]]`` -> ``"[int] or null"``."""
    inner = without_none(hint)
    if inner is not hint:
        return f"{short_type(inner)} or null"

    if get_origin(hint) is list:
        return f"[{short_type(get_args(hint)[0])}]"
    if get_origin(hint) is dict:
        return "{name: value}"

    return (
        "|".join(member.name for member in hint) if _is_enum(hint) else getattr(hint, "__name__", str(hint))
    )


def show_value(value: Any) -> str:
    """Return a value as it is written on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(show_value(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {show_value(item)}" for name, item in value.items()) + "}"

    return str(value)


def without_none(hint: Any) -> Any:
    """Return a type without its None: ``Optional[int]`` -> ``int``."""
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = [item for item in get_args(hint) if item is not type(None)]
        return inner
    return hint


def _is_enum(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Enum)


def _members(enum: type[Enum]) -> str:
    return ", ".join(member.name for member in enum)


@cache
def _module_docs(module: str) -> dict[str, dict[str, str]]:
    # Python keeps no docstrings of fields: they stand only in the source
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: _class_docs(node) for node in tree.body if isinstance(node, ast.ClassDef)}


def _class_docs(node: ast.ClassDef) -> dict[str, str]:
    docs: dict[str, str] = {}

    for item, following in zip(node.body, node.body[1:], strict=False):
        if not (isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)):
            continue

        # a field's docstring is the text right below it
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            docs[item.target.id] = " ".join(str(following.value.value).split())

    return docs


def _field_docs(schema: type) -> dict[str, str]:
    docs: dict[str, str] = {}
    for base in reversed(schema.__mro__[:-1]):  # all but object
        docs |= _module_docs(base.__module__).get(base.__name__, {})
    return docs
