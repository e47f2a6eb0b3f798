"""A class, from clone to grades: who handed in what, and what it earned."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections import Counter
from pathlib import Path

import nbformat
import pandas as pd
import pytest
import test_exercises as exercises

from dmsrd_lite.__main__ import main
from dmsrd_lite.workbook import classroom
from dmsrd_lite.workbook.records import ROOT

LESSON = "04_policy_mixture"


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    course = tmp_path_factory.mktemp("class") / "course"
    classroom.release(course, [LESSON, "07_benchmark"])
    return course


def hand_in(folder, student, notebook, name=f"{LESSON}.ipynb"):
    (folder / student).mkdir(parents=True, exist_ok=True)
    if isinstance(notebook, str):
        (folder / student / name).write_text(notebook)
    else:
        nbformat.write(notebook, folder / student / name)


def solved(lesson=LESSON, **answers):
    """A student's copy with the solutions written in, or ``answers`` {task: code}."""
    copy, right = exercises.student_copy(lesson), exercises.master(lesson)
    known = {a["grade_id"]: source for a, source in exercises.code(right) if a.get("solution")}
    for cell in copy.cells:
        about = cell.metadata.get("nbgrader", {})
        if cell.cell_type == "code" and about.get("solution"):
            task = about["grade_id"]
            kept = re.sub(r".*### (BEGIN|END) SOLUTION\n?", "", known[task])
            cell.source = answers.get(task.replace("-", "_"), kept)
    return copy


def points_of(lesson):
    checks = [about for about, _ in exercises.code(exercises.master(lesson)) if about.get("grade")]
    return {about["grade_id"].removesuffix("-check"): about["points"] for about in checks}


def test_release_makes_a_course_that_nbgrader_knows(course):
    assert (course / "nbgrader_config.py").exists()
    names = sorted(path.parent.name for path in (course / "release").glob("*/*.ipynb"))
    assert names == [LESSON, "07_benchmark"]


@pytest.mark.parametrize(
    ("files", "notes"),
    [
        ({"ada/04_policy_mixture.ipynb": ""}, {}),
        ({"ada/04_policy_mixture/04_policy_mixture.ipynb": ""}, {}),
        ({"ada/hw.ipynb": ""}, {"ada": "hw.ipynb is no exercise"}),
        ({"04_policy_mixture.ipynb": ""}, {"?": "lies beside the students' folders"}),
        (
            {"ada/04_policy_mixture.ipynb": "", "late/ada/04_policy_mixture.ipynb": ""},
            {"ada": "handed in 2 times, in ada and late/ada; expected once"},
        ),
        ({"ada/00_start_here.ipynb": ""}, {"ada": "is no exercise"}),
        ({"ada/04_policy_mixture.ipynb": "", "__MACOSX/ada/._04_policy_mixture.ipynb": ""}, {}),
        (
            {
                "ada/04_policy_mixture/04_policy_mixture.ipynb": "",
                "ada/notes/data.csv": "",
                "bob/04_policy_mixture/04_policy_mixture.ipynb.txt": "",
                "late/cy/04_policy_mixture.IPYNB": "",
                "late/dan/04_policy_mixture.txt": "",
                "late/fay/hw.ipynb": "",
                "eve/": "",
            },
            {
                "bob": "but 04_policy_mixture/04_policy_mixture.ipynb.txt; expected LESSON.ipynb",
                "cy": "no notebook in its folder, but 04_policy_mixture.IPYNB;",
                "dan": "but 04_policy_mixture.txt;",
                "eve": "but nothing;",
                "fay": "hw.ipynb is no exercise",
            },
        ),
    ],
)
def test_who_handed_in_what(files, notes, tmp_path):
    for name, text in files.items():
        (tmp_path / f"{name}x").parent.mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            (tmp_path / name).write_text(text)
    found, said = classroom.find_submissions(tmp_path)
    taken = [] if {"ada", "?"} & set(notes) else [("ada", LESSON)]
    assert [(one.student, one.lesson) for one in found] == taken
    assert sorted(note["student"] for note in said) == sorted(notes)
    assert all(notes[note["student"]] in note["note"] for note in said)


def test_bad_input_is_one_sentence(course, tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("")
    for name, file in {"noted": "notes.csv", "broken": "gradebook.db"}.items():
        (shutil.copytree(course, tmp_path / name) / file).write_text("a;b\n" * 1000)
    for arguments, words in {
        (
            "release",
            tmp_path / "new",
            "--lesson",
            "00_start_here",
        ): "00_start_here has no exercise; expected one of 01",
        ("release", tmp_path / "full"): "not empty and not a course",
        ("release", ROOT / "class"): "inside of this repository; expected a folder outside",
        ("release", tmp_path / "full" / "thesis.txt"): "is a file; expected a new folder",
        ("release", tmp_path / "full" / "thesis.txt" / "x"): "cannot be written to (Not a directory)",
        ("grade", course, tmp_path / "full"): "no notebook in it; expected STUDENT/LESSON.ipynb",
        ("grade", course, tmp_path / "nobody"): "nobody is no folder; expected one with STUDENT/LESSON.ipynb",
        ("grade", course, course / "submitted"): "inside of the course; expected a folder outside",
        ("report", tmp_path / "nowhere"): "no course; expected a folder made by",
        ("report", course): "nothing was graded yet; expected `classroom grade` first",
        (
            "report",
            tmp_path / "noted",
        ): "notes.csv: no table of notes (KeyError); expected the columns student,",
        ("report", tmp_path / "broken"): "gradebook.db: does not open (file is not a database); expected",
    }.items():
        assert main(["classroom", *map(str, arguments)]) == 2
        said = capsys.readouterr().err.strip()
        assert words in said
        assert "\n" not in said
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("change", "words", "gradable"),
    [
        (lambda notebook: notebook.cells.append(notebook.cells[3].copy()), "more than once", True),
        (
            lambda notebook: notebook.metadata.update(kernelspec={"name": "ir", "display_name": "R"}),
            "kernel ir",
            True,
        ),
        (lambda notebook: notebook.metadata.update(kernelspec={}), "kernel none", True),
        (
            lambda notebook: [cell.update(id="same") for cell in notebook.cells],
            "some cells have the same id; graded with new ones",
            True,
        ),
        (lambda notebook: notebook.cells.clear(), "no task of the exercise", False),
        (
            lambda notebook: notebook.update(exercises.student_copy("02_airl")),
            "no task of the exercise",
            False,
        ),
        (lambda notebook: None, "", True),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_unusual_is_noticed(change, words, gradable, tmp_path):
    copy = exercises.student_copy(LESSON)
    change(copy)
    (tmp_path / "ada.ipynb").write_text(json.dumps(copy))
    hand_in(tmp_path, "out", exercises.student_copy(LESSON))
    places = tmp_path / "ada.ipynb", tmp_path / "out" / f"{LESSON}.ipynb"
    said, can = classroom.inspect(*places)
    classroom.mended(*places)
    assert words in said
    assert bool(said) == bool(words)
    assert can == gradable


def test_a_check_that_was_deleted_is_put_back_in_its_place(tmp_path):
    whole = exercises.student_copy(LESSON)
    hand_in(tmp_path, "out", whole)
    about = [cell.metadata.nbgrader for cell in whole.cells if classroom.task_of(cell)]
    for missing in ("setup", "mix-check", "explain-check", "explain"):
        copy = exercises.student_copy(LESSON)
        copy.cells = [cell for cell in copy.cells if classroom.task_of(cell) != missing]
        for cell in copy.cells:
            cell.metadata.get("nbgrader", {}).pop("schema_version", None)
        copy.cells[0].metadata["nbgrader"] = {"grade_id": "of another lesson"}
        copy.metadata.kernelspec = {}
        hand_in(tmp_path, "ada", copy)
        places = (tmp_path / who / f"{LESSON}.ipynb" for who in ("ada", "out"))
        notebook, gone = classroom.mended(*places)
        put_back = missing != "explain"
        assert gone == [f"{missing} (put back)" if put_back else missing]
        found = [cell.metadata.nbgrader for cell in notebook.cells if "nbgrader" in cell.metadata]
        assert found == [one for one in about if one.grade_id != missing or put_back]
        nbformat.validate(notebook)


@pytest.mark.parametrize(
    ("log", "words"),
    [
        ("nbclient.exceptions.DeadKernelError: Kernel died", "its code ended Python"),
        ("CellTimeoutError: ...\nThe message was: Timeout waiting for IOPub output.", "grade it by hand"),
        ("the kernel became unresponsive and we could not interrupt it", "grade it by hand"),
        ("something new", "nbgrader cannot take it; `nbgrader autograde {lesson} --student={student}`"),
    ],
)
def test_why_a_notebook_was_not_graded(log, words):
    assert words in classroom._why({"success": False, "log": log, "error": "Please see the above traceback"})


def test_notes_of_another_lesson_stay(course, tmp_path):
    own = shutil.copytree(course, tmp_path / "own")
    hand_in(tmp_path / "first", "ada", "no notebook", "07_benchmark.ipynb")
    hand_in(tmp_path / "first", "ada", "no notebook", "homework.ipynb")
    (own / "notes.csv").write_text("")
    classroom.grade(own, tmp_path / "first")
    odd = exercises.student_copy(LESSON)
    hand_in(tmp_path / "second", "ada", json.dumps(odd | {"metadata": {"kernelspec": "python3"}}))
    odd.cells[3].metadata["nbgrader"] = "oops"
    hand_in(tmp_path / "second", "ben", json.dumps(odd))
    odd.cells[3].metadata["nbgrader"] = {"grade_id": []}
    hand_in(tmp_path / "second", "cleo", json.dumps(odd))
    table = pd.read_csv(classroom.grade(own, tmp_path / "second"), keep_default_na=False)
    assert list(table.student) == ["ada", "ben", "cleo", "ada"]
    assert list(table.lesson) == [LESSON] * 3 + ["07_benchmark"]
    assert all(table.note.str.contains("not graded: does not open"))


@pytest.mark.verify
def test_nbgraders_own_command_makes_the_same_copies(tmp_path):
    folder = shutil.copytree(classroom.SETTINGS.parent, tmp_path / "exercises")
    before = (folder / LESSON / f"{LESSON}.ipynb").read_bytes()
    (folder / LESSON / f"{LESSON}.ipynb").unlink()
    command = [sys.executable, "-m", "nbgrader", "generate_assignment", LESSON, "--force"]
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run(command, cwd=folder, check=True, env=environment)
    assert (folder / LESSON / f"{LESSON}.ipynb").read_bytes() == before


@pytest.mark.verify
def test_a_class_of_all_sorts(course, tmp_path):
    """Full points for the reference, none untouched; each mishap costs its own student, or its own task."""
    folder, points = tmp_path / "submissions", points_of(LESSON)
    hand_in(folder, "ada", solved())
    hand_in(folder, "ben", exercises.student_copy(LESSON))
    hand_in(folder, "cleo", "this is no notebook")
    hand_in(folder, "dora", solved(mix="def mix(weights, means, sigmas):\n    while True:\n        pass"))
    edited = solved(explain="def explanation(*_):\n    return 'pure'")
    for cell in edited.cells:
        if cell.metadata.get("nbgrader", {}).get("grade_id") == "explain-check":
            cell.source = "pass"
    hand_in(folder, "emil", edited)
    doubled = solved()
    doubled.cells.append(doubled.cells[3].copy())
    hand_in(folder, "fay", doubled)
    noisy = solved()
    noisy.cells[3].source = noisy.cells[3].source.replace(
        "    return", "    import warnings\n    warnings.warn('harmless')\n    return", 1
    )
    hand_in(folder, "gil", noisy)
    hand_in(folder, "hal", solved(), "my homework.ipynb")
    deleted = solved()
    deleted.cells = [cell for cell in deleted.cells if classroom.task_of(cell) != "explain-check"]
    hand_in(folder, "jan", deleted)
    cheating = solved(explain="def check(*_, **__):\n    pass")
    cheating.cells = [cell for cell in cheating.cells if classroom.task_of(cell) != "setup"]
    hand_in(folder, "kai", cheating)
    hand_in(folder, "leo", solved(mix="import os\nos._exit(1)"))
    caught = "import time\nwhile True:\n    try:\n        time.sleep(0.1)\n    except:\n        pass"
    hand_in(folder, "mia", solved(mix=f"def mix(*_):\n{textwrap.indent(caught, '    ')}"))
    (folder / "nia").mkdir()
    worn = solved()
    for cell in worn.cells:
        cell.metadata.get("nbgrader", {}).pop("schema_version", None)
    hand_in(folder, "oda", json.dumps(worn | {"metadata": {"kernelspec": {}}}))
    hand_in(folder, "pit", json.dumps(worn | {"metadata": {"kernelspec": "python3"}}))
    worn.cells[3].source = 5
    hand_in(folder, "rio", json.dumps(worn))
    shutil.copytree(folder / "ben", folder / "late" / "ben")
    hand_in(folder, "ida", solved("07_benchmark"), "07_benchmark.ipynb")
    table = pd.read_csv(classroom.grade(course, folder), keep_default_na=False).set_index("student")
    full = sum(points.values())
    earned = {name: float(value) for name, value in table.points.items() if value != ""}
    assert earned == {
        "ada": full, "dora": full - points["mix"], "emil": full - points["explain"], "fay": full, "gil": full,
        "ida": sum(points_of("07_benchmark").values()), "jan": full, "kai": full - points["explain"],
        "oda": full,
    }  # fmt: skip
    notes = {
        "ben": "handed in 2 times",
        "cleo": "does not open",
        "fay": "more than once",
        "hal": "is no exercise",
        "jan": "missing: explain-check (put back)",
        "kai": "missing: setup (put back)",
        "leo": "not graded: its code ended Python",
        "mia": "not graded: a loop in it neither ends nor can be interrupted",
        "nia": "no notebook in its folder",
        "oda": "asks for the kernel none; graded with python3",
        "pit": "not graded: does not open",
        "rio": f"`nbgrader autograde {LESSON} --student=rio`",
    }
    assert {name: note for name, note in table.note.items() if note}.keys() == notes.keys()
    assert all(words in table.note[name] for name, words in notes.items())
    pages = Counter(path.parts[-3] for path in (course / "feedback").rglob("*.html"))
    assert pages == Counter(["ada", "dora", "emil", "fay", "gil", "ida", "jan", "kai", "oda"])
    for page in (course / "feedback").rglob("*.html"):
        assert "HIDDEN TESTS" not in page.read_text()
    shutil.rmtree(folder / "late")
    table = pd.read_csv(classroom.grade(course, folder), keep_default_na=False).set_index("student")
    assert float(table.points["ben"]) == 0
    other = tmp_path / "other"
    hand_in(other, "kim", "this is no notebook")
    hand_in(other, "ada", "this is no notebook")
    table = pd.read_csv(classroom.grade(course, other), keep_default_na=False).set_index("student")
    assert {"cleo", "kim"} <= set(table.index[table.note != ""]), "notes of other folders stay"
    assert "the points are of an earlier hand-in" in table.note["ada"]
    assert float(table.points["ada"]) == full
    with classroom._nbgrader(course).gradebook as book:
        book.find_grade("open", LESSON, LESSON, "ada").manual_score = 1.5
        book.db.commit()
    table = pd.read_csv(classroom.report(course), keep_default_na=False).set_index("student")
    assert float(table.points["ada"]) == full + 1.5
    assert float(table.to_read["ada"]) == 0
    assert f"Score: {full + 1.5}" in (course / "feedback" / "ada" / LESSON / f"{LESSON}.html").read_text()
