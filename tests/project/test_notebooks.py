"""The notebooks of the documentation run without errors and give the results that they state."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))
FRAMES = 16  # instead of 40, because rendering takes most of the time


def executed(path: Path):
    """Return the notebook after it was executed on few frames."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            frames = rf"\g<1>{FRAMES}"
            cell.source = re.sub(r"^(FRAMES(?:, EVERY)? = )40", frames, cell.source, flags=re.M)
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    return notebook


def outputs(notebook) -> str:
    found = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    return "".join(o.get("text", "") or o.get("data", {}).get("text/plain", "") for o in found)


def pictures(notebook) -> int:
    found = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    return sum("image/png" in o.get("data", {}) for o in found)


def test_notebooks_are_stored_without_outputs():
    assert [path.stem for path in NOTEBOOKS] == ["detectors", "slam"]
    for path in NOTEBOOKS:
        cells = nbformat.read(path, as_version=4).cells
        assert not any(cell.get("outputs") for cell in cells)


def test_slam_from_python():
    notebook = executed(NOTEBOOKS[1])
    said = outputs(notebook)
    assert f"{FRAMES} poses, 0 lost" in said
    assert float(re.search(r"greatest error ([\d.]+) m", said)[1]) < 0.2
    assert pictures(notebook) == 2


def test_detectors_compared():
    notebook = executed(NOTEBOOKS[0])
    shares = {
        name: [float(x) for x in values.split(",")]
        for name, values in re.findall(r"'([\w-]+)': \[([\d., ]+)\]", outputs(notebook))
    }
    assert shares.keys() == {"bow", "capsule"}
    # Unchanged images are identical to the gallery.
    assert all(values[0] == 1.0 for values in shares.values())
    assert pictures(notebook) == 1
