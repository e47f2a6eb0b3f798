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
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

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


def answers(lesson):
    """The reference's answers: (task, the name of a function in it, code)."""
    for about, source in code(master(lesson)):
        if about.get("solution"):
            for name in re.findall(r"^def (\w+)", source, re.M):
                yield about["grade_id"], name, source


@each_lesson
def test_an_answer_that_returns_nothing_gets_a_sentence(lesson):
    for task, name, source in answers(lesson):
        nothing = f"{source}\n\n\ndef {name}(*_, **__):\n    pass\n"
        said = graded(master(lesson), {task: nothing})[task]
        assert said is not None, f"{task}: nothing earns full points"
        assert said.startswith("AssertionError"), f"{task}: {said}"


@each_lesson
def test_a_list_does_where_a_tuple_is_asked_for(lesson):
    listed = (
        "\n\n\ndef {0}(*of, right={0}):\n    x = right(*of)\n    return [*x] if type(x) is tuple else x\n"
    )
    as_lists: dict[str, str] = {}
    for task, name, source in answers(lesson):
        as_lists[task] = as_lists.get(task, source) + listed.format(name)
    assert set(graded(master(lesson), as_lists).values()) == {None}


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
        ([None, 1.0], [1.0, 2.0], "None in it .is a return missing"),
        ([1.0, [2.0]], (1.0, [2.0]), None),
        ([1.0], (1.0, [2.0]), "a tuple of 1; expected a tuple of 2"),
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


ANSWERS = """
def stub():
    raise NotImplementedError("not yet")
def two(ask=None):
    return ask() if ask else 2
def slip():
    return unknown
"""
CHECK = "from dmsrd_lite.workbook.exercises import check\n{}\n'the answer is 42'"


def test_a_notebook_shows_a_sentence_or_the_answers_own_lines_and_the_cell_has_failed():
    shown = {
        "check(stub(), 42)": "NotImplementedError: not yet",
        "check(two(), 42, {'The half.': 2})": "AssertionError: The half.",
        "assert two() == 42, 'Not two.'": "AssertionError: Not two.",
        "check(slip(), 42)": "    return unknown",
        "two(lambda: 1 / 0)": "    return ask() if ask else 2",
        "two(1, 42)": "TypeError: two() takes from 0 to 1 positional arguments but 2 were given",
    }
    cells = [nbformat.v4.new_code_cell(source) for source in (ANSWERS, *map(CHECK.format, shown), "slip()")]
    quiet = ["--IPKernelApp.log_level=40"]  # it warns of its sockets
    client = NotebookClient(
        nbformat.v4.new_notebook(cells=cells), allow_errors=True, extra_arguments=quiet, timeout=60
    )
    client.execute()
    said = []
    for cell in cells[1:]:
        (output,) = cell.outputs
        assert output.output_type == "error"
        said.append(re.sub(r"\x1b\[[\d;]*m", "", "\n".join(output.traceback)))
    for text, words in zip(said, shown.values(), strict=False):
        assert words in text
        assert "42" not in text.replace(words, "")
        assert ("\n" in text) == words.startswith(" ")
    assert "----> 1 slip()" in said[-1], "one's own cell is no check"
    client.allow_errors = False
    with pytest.raises(CellExecutionError):
        client.execute()
