"""Texts as people type them: ``run=/x/jürgen/a, b`` needs no quotes inside quotes.

Quotes are put where Hydra's grammar cannot read a text, or takes it for something else (a number, a list,
several values). Names that it cannot read are spelt in letters that it can.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import quote, unquote

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

from mappo_unity.config.option_table import option_table, without_none
from mappo_unity.errors import ConfigError

ONE_FOLDER = ("resume", "output_dir", "hydra.run.dir", "hydra.sweep.dir")
"""Options that name one place, in a sweep too."""

LINE = re.compile(r"(?P<prefix>\+\+|\+|~)?(?P<key>[^=+~\s]+)(?P<rest>=.*)?", re.DOTALL)
# what reads the same in Hydra's grammar, but for the words below it
_SIMPLE = re.compile(r"(\.{0,2}/)?[A-Za-z_][A-Za-z0-9_./-]*")
_WORDS = ("null", "true", "false", "inf", "nan")
_READABLE = re.compile(r"[A-Za-z0-9_/\-\\+.$%*@?|: \t]*")  # the letters of Hydra's unquoted texts
_KEY_LETTERS = "/\\+$*@?| "  # those that a name in {name: value} may have besides letters, digits and _.-~
_QUOTED = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')\s*""", re.DOTALL)
_PIECE = re.compile(r"\$\{[^}]*\}|\\.|.", re.DOTALL)
_CHOICE = re.compile(r"\s*choice\s*\((.*)\)\s*", re.DOTALL)
_ESCAPED = re.compile(r"\\([\\()\[\]{}:=, \t])")


def quoted(value: str | Path) -> str:
    """Return a text as a quoted value of Hydra's grammar."""
    text = str(value)
    mark = Quote.single if '"' in text and "'" not in text else Quote.double
    return str(QuotedString(text, mark).with_quotes())


def quoted_path(value: str | Path) -> str:
    """Return a path as a quoted value, in which nothing is interpolated."""
    return quoted(re.sub(r"(\\*)\$\{", lambda match: 2 * match[1] + r"\${", str(value)))


def literal_lines(lines: list[str], schema: type, sweep: bool = False) -> list[str]:
    """Return a command's lines with each text option's value taken as it was typed.

    Quotes around it, ``null``, escapes and ``${...}`` keep Hydra's meaning; so do several values in a sweep,
    but for the options that name one place. Raises ConfigError for a line that is no readable text.
    """
    return [_literal_line(line, schema, sweep) for line in lines]


def quote_words(value: str) -> str:
    """Return a value with quotes around each text in it that has letters foreign to Hydra's grammar."""
    if _READABLE.fullmatch(value):
        return value

    choice = _CHOICE.fullmatch(value)
    if choice is not None and not value.isascii():  # Hydra takes the quotes off the values of this form
        value = choice[1]

    return "".join(_requoted(value))


def key_spelling(name: str) -> str:
    """Return a name of the user's (a behavior, a parameter) in letters that Hydra's dictionaries take.

    A spelling is returned as it is.
    """
    if re.fullmatch(rf"[A-Za-z0-9_.%{re.escape(_KEY_LETTERS)}-]+", name) and name.strip() == name:
        return name
    return quote(name, safe=_KEY_LETTERS.strip())


def key_name(spelling: str) -> str:
    """Return the name that `key_spelling` has spelt; others are returned as they are."""
    name = unquote(spelling)
    return name if key_spelling(name) == spelling else spelling


def parse_or_none(line: str) -> Override | None:
    """Parse an override in Hydra's grammar; None if it is not in it."""
    try:
        return OverridesParser.create().parse_override(line)
    except HydraException:
        return None


@cache
def _text_options(schema: type) -> frozenset[str]:
    table = option_table(schema)
    texts = {key for key, option in table.items() if without_none(option.type) is str}
    # only mappo-train has resume and, with it, the options of Hydra
    return frozenset(texts | {key for key in ONE_FOLDER if key.startswith("hydra.") and "resume" in table})


def _literal_line(line: str, schema: type, sweep: bool) -> str:
    # surrogates stand for bytes of a file name that are no UTF-8
    try:
        line.encode()
    except UnicodeEncodeError as error:
        raise ConfigError(f"{line!r} has bytes that are no UTF-8 text; rename the file or folder") from error

    match = LINE.fullmatch(line)
    if match is None or match["rest"] is None or match["key"] not in _text_options(schema):
        return line

    text = match["rest"][1:]
    if _SIMPLE.fullmatch(text) and text.lower() not in _WORDS:
        return line

    # what Hydra reads as null, a text or (in a sweep) several values keeps that meaning
    head = line[: len(line) - len(text)]
    override = parse_or_none(f"text={text}") if text.strip() else None
    if override is not None:
        if override.value() is None or isinstance(override.value(), str):
            return line
        if sweep and override.is_sweep_override() and match["key"] not in ONE_FOLDER:
            return line
    elif not text.strip() or _QUOTED.fullmatch(text):
        return line

    # several texts, some of which Hydra cannot read: each is quoted by itself
    if sweep and override is None and match["key"] not in ONE_FOLDER:
        return head + ",".join(_element(part) for part in text.split(","))

    return head + quoted(text)


def _element(text: str) -> str:
    override = parse_or_none(f"text={text}")
    return text if override is not None and isinstance(override.value(), str) else quoted(text)


def _requoted(value: str) -> Iterator[str]:
    """Yield the pieces of a value: separators as they are, each text between two of them to be read."""
    nesting, word, at = [""], "", 0
    # whether the word being read is a name in {name: value}
    is_key = False

    while at < len(value):
        # a quoted text is one piece, separators in it and all; quotes inside a word are letters of it
        match = None if word.strip() else _QUOTED.match(value, at)
        if match is not None:
            word += match[0]
            at = match.end()
            continue

        piece = _PIECE.match(value, at)[0]  # type: ignore[index]
        at += len(piece)

        ends_key = piece == ":" and is_key
        if not (piece in ("(", ")", "[", "]", "{", "}", ",") or ends_key):
            word += piece
            continue

        yield _word(word, nesting[-1], ends_key) + piece
        word = ""
        if piece in "([{":
            nesting.append(piece)
        elif piece in ")]}" and len(nesting) > 1:
            nesting.pop()

        is_key = nesting[-1] == "{" and piece in "{,"

    yield _word(word, nesting[-1], False)


def _word(word: str, within: str, is_key: bool) -> str:
    text = word.strip()
    if is_key:
        return key_spelling(text)

    # left alone: what Hydra reads, what is quoted, and name=value of a call, range(start=1,stop=3)
    is_plain = _READABLE.fullmatch(re.sub(r"\$\{[^}]*\}", "", _ESCAPED.sub("", text)))
    if is_plain or text[0] in "\"'" or (within == "(" and re.match(r"\w+\s*=", text)):
        return word

    return quoted(_ESCAPED.sub(r"\1", text))
