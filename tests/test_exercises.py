"""One master serves teacher and student: its solutions pass, an empty answer fails every check."""

import nbformat
import pytest
from nbclient import NotebookClient
from nbgrader.preprocessors import ClearSolutions

from dmsrd_lite.workbook.lessons import NOTEBOOKS

EXERCISES = sorted((NOTEBOOKS / "exercises").glob("*/*.ipynb"))


def checks(notebook):
    return [c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade")]


def failures(cells):
    return [c for c in cells if any(o.output_type == "error" for o in c.get("outputs", []))]


def executed(notebook, path):
    options = {"timeout": 120, "allow_errors": True, "resources": {"metadata": {"path": str(path.parent)}}}
    return NotebookClient(notebook, **options).execute()


@pytest.mark.lesson
@pytest.mark.parametrize("path", EXERCISES, ids=lambda p: p.parent.name)
def test_solutions_pass_and_stubs_fail(path):
    master = nbformat.read(path, 4)
    assert len(checks(master)) >= 3
    solved = executed(master, path)
    assert [c.source for c in failures(solved.cells)] == []
    stub, _ = ClearSolutions().preprocess(nbformat.read(path, 4), {})
    assert "BEGIN SOLUTION" not in nbformat.writes(stub)
    handed_in = executed(stub, path)
    assert len(failures(checks(handed_in))) == len(checks(master)), "an empty answer must earn no points"


@pytest.mark.parametrize("path", EXERCISES, ids=lambda p: p.parent.name)
def test_points_stand_in_the_headings(path):
    notebook = nbformat.read(path, 4)
    text = "".join(c.source for c in notebook.cells if c.cell_type == "markdown")
    missing = [c.metadata.nbgrader.points for c in checks(notebook)]
    missing = [points for points in missing if f"({points} points)" not in text]
    assert not missing, f"{path.parent.name}: write '({missing[0]} points)' into the heading of the task"
