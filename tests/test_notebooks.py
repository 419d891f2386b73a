"""The notebooks run, and their saved outputs are those of a run."""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# Real recordings, which some of the notebooks read; they are not part of the repository.
DATA = Path(os.environ.get("ALLANJAX_DATA", ROOT.parent / "shared" / "data")).resolve()
UNITS = ("adis16405_unit1.parquet", "adis16405_unit2.parquet")
RECORDINGS = {"02_uncertainty": UNITS, "03_what_the_simulation_gets_wrong": UNITS}
# Words that a reader must find among the outputs.
FITTED = ("angle random walk", "deg/√h", "χ² =")
CRITICIZED = {"03_what_the_simulation_gets_wrong": (*FITTED, "low pass", "resonance")}


def outputs(notebook):
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def shown(notebook):
    """All text that a reader sees as output."""
    return "\n".join(
        output.get("text", "") or output.data.get("text/plain", "") for output in outputs(notebook)
    )


def pictures(notebook):
    return [output for output in outputs(notebook) if "image/png" in output.get("data", {})]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path, tmp_path, monkeypatch):
    for name in RECORDINGS.get(path.stem, ()):
        if not (DATA / name).exists():
            pytest.skip(f"{path.stem} reads {name}, which is not in the folder that ALLANJAX_DATA names")
    monkeypatch.setenv("ALLANJAX_DATA", str(DATA))
    # The command line, tried in this process before, sets one that shows no pictures.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    saved = nbformat.read(path, as_version=4)
    # nbclient fills in the outputs of the notebook that it is given, and raises where a cell does.
    executed = nbformat.read(path, as_version=4)
    NotebookClient(
        executed, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    assert len(pictures(executed)) == len(pictures(saved)) > 0
    assert not [output for output in outputs(executed) if output.get("name") == "stderr"]
    for notebook in (saved, executed):
        for expected in CRITICIZED.get(path.stem, FITTED):
            assert expected in shown(notebook)
