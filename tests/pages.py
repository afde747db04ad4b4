"""Pages that a script of scripts/ writes from what was measured."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest


def assert_page_is_written(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a script writes its page, `script.PAGE`, as it stands."""
    written = script.PAGE.read_text(encoding="utf-8")
    page = tmp_path / script.PAGE.name
    page.write_text(written)
    monkeypatch.setattr(script, "PAGE", page)
    script.write_page()
    assert page.read_text() == written, f"python scripts/{script.__name__}.py --draw writes it anew"
