"""The house: rooms import only from those above them, and nothing in them is too long to read."""

import ast
import statistics
from pathlib import Path

import pytest

import mappo_unity

PACKAGE = Path(mappo_unity.__file__).parent
ROOMS = (
    *("errors", "keys", "signals", "config", "scenes", "protocol", "envs", "farama"),
    *("learning", "runs", "reports", "diagnosis", "policies", "viewing", "training", "sharing", "cli"),
)
DOORS = ("__init__", "api", "player")
"""Modules at the top that stand outside the rooms and open any of them."""
FILES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def rooms_imported(tree: ast.AST) -> set[str]:
    """Return the rooms that a module imports from, inside functions too."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == "mappo_unity":
            names |= {f"mappo_unity.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {name.split(".")[1] for name in names if name.startswith("mappo_unity.")} & {*ROOMS, *DOORS[1:]}


def length(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def functions(path: Path) -> list[tuple[str, int]]:
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    return [
        (node.name, (node.end_lineno or 0) - node.lineno + 1) for node in nodes if isinstance(node, kinds)
    ]


def test_every_module_stands_in_a_room():
    assert {room_of(path) for path in FILES} == {*ROOMS, *DOORS}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_room_imports_only_from_those_above_it(path):
    room = room_of(path)
    if room in DOORS:
        return
    above = {*ROOMS[: ROOMS.index(room) + 1]}
    below = rooms_imported(ast.parse(path.read_text(encoding="utf-8"))) - above
    assert not below, f"{room}/ stands above {', '.join(sorted(below))}"


def test_an_import_from_a_lower_room_is_seen():
    assert rooms_imported(ast.parse("def f():\n    from mappo_unity.training.trainer import train")) == {
        "training"
    }
    assert rooms_imported(ast.parse("from mappo_unity import keys\nimport mappo_unity.cli.train")) == {
        "keys",
        "cli",
    }


def test_no_room_is_crowded_and_no_module_is_long():
    for folder in {path.parent for path in FILES} - {path.parent for path in PACKAGE.glob("scenes/*/*.py")}:
        modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(modules) <= 16, f"{folder.name}/ holds {len(modules)} modules"
    lengths = {str(path.relative_to(PACKAGE)): length(path) for path in FILES if path.name != "__init__.py"}
    assert statistics.median(lengths.values()) <= 150
    assert [name for name, lines in lengths.items() if lines > 300] == []


def test_no_function_is_long():
    loop = PACKAGE / "training" / "trainer.py"
    found = [(path.name, name, lines) for path in FILES for name, lines in functions(path) if lines > 50]
    assert [entry for entry in found if entry[0] != loop.name] == []
    assert all(lines <= 80 for _, _, lines in found), "the training loop fits on one screen"
