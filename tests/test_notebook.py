"""The example notebook runs from its first cell to its last, and is committed without outputs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "examples" / "quickstart.ipynb"


def test_it_holds_no_outputs() -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 3
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)


@pytest.mark.slow
def test_it_runs(tmp_path: Path) -> None:
    for package in ("nbclient", "ipykernel", "matplotlib", "pettingzoo"):
        pytest.importorskip(package, reason=f"needs {package} (extras 'notebook' and 'farama')")
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()

    texts = [_printed(cell) for cell in notebook.cells if cell.cell_type == "code"]
    assert texts[0].startswith("finished: mean return 0.")
    assert float(texts[2].split()[0]) > 0.85
    assert texts[3].strip() == "True" and (tmp_path / "Basic.onnx").is_file()
    assert texts[4].startswith("(20,)")


def _printed(cell: Any) -> str:
    return "".join(output["text"] for output in cell.outputs if output.get("name") == "stdout")
