"""Exercises: the reference earns all points, the untouched copy none, a wrong answer a hint that names it."""

import contextlib
import io
import re
import tomllib
import warnings
from collections import Counter
from pathlib import Path

import nbformat
import pytest
import torch

from dmsrd_lite.workbook import classroom
from dmsrd_lite.workbook.exercises import check
from dmsrd_lite.workbook.lessons import NOTEBOOKS

LESSONS = classroom.lessons_with_exercise()
WRONG = {
    path.stem: tomllib.loads(path.read_text())["wrong"]
    for path in Path(__file__).parent.glob("exercises/*.toml")
}
each_lesson = pytest.mark.parametrize("lesson", LESSONS)


def master(lesson):
    return nbformat.read(classroom.SOLUTIONS / lesson / f"{lesson}.ipynb", 4)


def student_copy(lesson):
    return nbformat.read(NOTEBOOKS / "exercises" / lesson / f"{lesson}.ipynb", 4)


def code(notebook):
    return [(c.metadata.get("nbgrader", {}), c.source) for c in notebook.cells if c.cell_type == "code"]


def graded(notebook, answers=None):
    """{task: None, or what its check says}, with ``answers`` {task: code} in place of the notebook's."""
    names, says = {}, {}
    for about, source in code(notebook):
        task = about.get("grade_id", "")
        if about.get("solution"):
            source = (answers or {}).get(task, source)
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("error" if answers is None else "ignore")  # nbgrader takes them for errors
            try:
                exec(compile(source, task or "cell", "exec"), names)
                said = None
            except Exception as error:
                if not about.get("grade"):
                    raise
                kind = AssertionError if isinstance(error, AssertionError) else type(error)
                said = f"{kind.__name__}: {error}"
        if about.get("grade"):
            says[task.removesuffix("-check")] = said
    return says


def test_every_lesson_of_the_paper_has_an_exercise_and_wrong_answers():
    lessons = sorted(path.stem for path in NOTEBOOKS.glob("[0-9]*.ipynb"))
    assert lessons[1:9] == LESSONS == sorted(WRONG)


@each_lesson
def test_the_reference_earns_all_points_and_the_untouched_copy_none(lesson):
    assert set(graded(master(lesson)).values()) == {None}
    untouched = {
        about["grade_id"]: source for about, source in code(student_copy(lesson)) if about.get("solution")
    }
    says = graded(master(lesson), untouched)
    assert all("not yet" in said for said in says.values()), says


@each_lesson
def test_a_wrong_answer_gets_the_hint_that_names_it(lesson):
    tasks = {about["grade_id"] for about, _ in code(master(lesson)) if about.get("solution")}
    named = {(wrong["task"], wrong["name"]) for wrong in WRONG[lesson]}
    counts = Counter(wrong["task"] for wrong in WRONG[lesson])
    assert len(named) == len(WRONG[lesson])
    assert set(counts) == tasks
    assert min(counts.values()) >= 3
    assert len({(wrong["task"], wrong["hint"]) for wrong in WRONG[lesson]}) == len(WRONG[lesson]), (
        "its own hint"
    )
    own: dict[tuple[str, str], list[str]] = {}
    for wrong in WRONG[lesson]:
        said = graded(master(lesson), {wrong["task"]: wrong["code"]})[wrong["task"]]
        assert said, f"{wrong['task']}: {wrong['name']} earns full points"
        assert said.startswith("AssertionError"), f"{wrong['name']}: {said}"
        assert wrong["hint"] in said, f"{wrong['name']}: {said}"
        own.setdefault((wrong["task"], said), []).append(wrong["name"])
    assert all(len(names) == 1 for names in own.values()), own


@each_lesson
def test_an_exercise_has_what_was_promised(lesson):
    notebook = master(lesson)
    text = "\n".join(c.source for c in notebook.cells if c.cell_type == "markdown")
    graded_cells = [about for about, _ in code(notebook) if about.get("grade")]
    to_read = [c for c in notebook.cells if c.cell_type == "markdown" and c.metadata.get("nbgrader")]
    assert len(to_read) == 1, "one open question"
    assert 3 <= len(graded_cells) + len(to_read) <= 5, "three to five tasks in all"
    parts, headings = zip(*re.findall(r"^## Part (\d).*\((\d+) points\)$", text, re.M), strict=True)
    assert [int(part) for part in parts] == list(range(1, len(parts) + 1))
    assert [int(points) for points in headings] == [about["points"] for about in graded_cells]
    for word in ("by hand", "find the bug", "read a table", "## To discuss", "*Rubric.*"):
        assert word in text, word
    total = re.search(r"^(\w+) points in (\w+) parts", text, re.M)
    numbers = {"three": 3, "four": 4, "Nine": 9, "Ten": 10, "Eleven": 11}
    assert numbers[total[1]] == sum(map(int, headings))
    assert numbers[total[2]] == len(headings)


def test_student_copies_are_up_to_date_and_hold_no_solution(tmp_path):
    for path in classroom.release(tmp_path / "course"):
        lesson, fresh = path.stem, nbformat.read(path, 4)
        stored = student_copy(lesson)
        assert fresh == stored, f"{lesson}: run `python -m dmsrd_lite classroom copies`"
        everything = nbformat.writes(stored)
        for word in ("BEGIN SOLUTION", "HIDDEN TESTS", "*Rubric.*"):
            assert word not in everything, f"{lesson}: {word}"


@pytest.mark.parametrize(
    ("found", "right", "words"),
    [
        (None, 1.0, "is a return missing"),
        ([1.0, 2.0], [1.0, 2.0, 3.0], r"shape \(2,\); expected an array of shape \(3,\)"),
        ([1.0, 2.5], [1.0, 2.0], "expected"),
        ([1.0, 1 / 3], [1.0, 0.3333], "0.33333333333"),
        ([2.0, 1.0], [1.0, 2.0], "swapped"),
        ("mixture", "new strategy", "mixture"),
        (True, 1.0, None),
        ("1.0", 1.0, "a str; expected a number"),
        ((1.0, [2.0]), (1.0, [3.0]), "expected"),
        ([torch.tensor(1.0, requires_grad=True), torch.tensor(2.0)], [1.0, 2.0], None),
        ([None, 1.0], [1.0, 2.0], "None"),
        ([[1.0], [1.0, 2.0]], [1.0, 2.0], "a list that is no array of numbers"),
    ],
)
def test_a_check_says_what_is_wrong(found, right, words):
    hints = {"swapped": [2.0, 1.0]}
    if words is None:
        check(found, right, hints)
        return
    with pytest.raises(AssertionError, match=words):
        check(found, right, hints)


def test_a_check_lets_small_differences_pass():
    check([1.0, 2.0 + 1e-8], [1.0, 2.0])
    check((1.0, None), (1.0, None))
    check(0.41, 0.4101, tolerance=1e-3)
