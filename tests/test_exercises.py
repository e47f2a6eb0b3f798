"""One master serves teacher and student: with its solutions it passes, with the solutions cleared it must fail every check."""

import nbformat
import pytest
from nbclient import NotebookClient
from nbgrader.preprocessors import ClearSolutions

from dmsrd_lite.runs import NOTEBOOKS, lessons

EXERCISES = sorted((NOTEBOOKS / "exercises").glob("*/*.ipynb"))


def checks(notebook):
    return [c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade")]


def failures(cells):
    return [c for c in cells if any(o.output_type == "error" for o in c.get("outputs", []))]


@pytest.mark.parametrize("path", EXERCISES, ids=lambda p: p.parent.name)
def test_solutions_pass_and_stubs_fail(path):
    master = nbformat.read(path, 4)
    assert len(checks(master)) >= 3
    solved = NotebookClient(nbformat.from_dict(master), timeout=120, resources={"metadata": {"path": str(path.parent)}}).execute()
    assert failures(solved.cells) == []
    stub, _ = ClearSolutions().preprocess(nbformat.read(path, 4), {})
    assert "BEGIN SOLUTION" not in nbformat.writes(stub)
    client = NotebookClient(stub, timeout=120, allow_errors=True, resources={"metadata": {"path": str(path.parent)}})
    handed_in = client.execute()
    assert len(failures(checks(handed_in))) == len(checks(master)), "an empty answer must earn no points"


def test_points_stand_in_the_headings():
    for path in EXERCISES:
        notebook = nbformat.read(path, 4)
        text = "".join(c.source for c in notebook.cells if c.cell_type == "markdown")
        for cell in checks(notebook):
            assert f"({cell.metadata.nbgrader.points} points)" in text


def test_every_lesson_has_an_exercise():
    names = {p.parent.name for p in EXERCISES}
    assert names == {p.stem for p in lessons() if not p.stem.startswith("00_")}
