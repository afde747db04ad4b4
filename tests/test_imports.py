"""The package's import graph has no cycle, and light modules stay light."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import mappo_unity

PACKAGE = Path(mappo_unity.__file__).parent


def module_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path, known):
    """Modules of the package that a file imports, inside functions too."""
    found = set()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):  # first, since walk() looks at a node's children before it gives the node
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found & known - {"mappo_unity"}


def test_modules_import_only_upward():
    paths = {module_name(path): path for path in PACKAGE.rglob("*.py")}
    graph = {name: imports_of(path, set(paths)) - {name} for name, path in paths.items()}
    assert "mappo_unity.learning.ppo" in graph["mappo_unity.training.learners"]
    left = dict(graph)
    while left:
        free = [name for name, needs in left.items() if not needs & left.keys()]
        assert free, f"modules that import each other: {sorted(left)}"
        for name in free:
            del left[name]


def test_scripts_find_what_they_import():
    scripts = PACKAGE.parent / "scripts"
    needs_vmas = ("vmas_env.py", "vmas_holders.py")
    paths = [path for path in sorted(scripts.glob("*.py")) if path.name not in needs_vmas]
    code = f"""
import importlib, sys
sys.path.insert(0, {str(scripts)!r})
for name in {[path.stem for path in paths]!r}:
    importlib.import_module(name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert len(paths) > 20 and done.returncode == 0, done.stderr


def test_options_and_help_need_no_torch():
    light = "mappo_unity.config.compose, mappo_unity.cli, mappo_unity.cli.help"
    code = f"import sys, {light}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize(("given", "found"), [({}, "PASSIVE 0"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE 0")])
def test_waiting_threads_sleep_unless_the_environment_says_otherwise(given, found):
    code = "import os, mappo_unity; print(os.environ['OMP_WAIT_POLICY'], os.environ['GOMP_SPINCOUNT'])"
    clean = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    run = subprocess.run([sys.executable, "-c", code], env=clean | given, capture_output=True, text=True)
    assert run.stdout.strip() == found
