"""A course made of the exercises: hand out, grade, report. Thin, over nbgrader.

A course is a folder in nbgrader's own layout, with its settings in it: every command of nbgrader works there
as well.
"""

import logging
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import nbformat
import pandas as pd
from nbformat.warnings import DuplicateCellId

from dmsrd_lite.demonstrations import check_folder
from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook.lessons import NOTEBOOKS
from dmsrd_lite.workbook.records import ROOT

SOLUTIONS = NOTEBOOKS / "exercises" / "solutions"
SETTINGS = SOLUTIONS.parent / "nbgrader_config.py"
REASONS = {  # a word of nbgrader's log: why a notebook could not be graded
    "DeadKernelError": "its code ended Python (exit, or out of memory)",
    "CellTimeoutError|unresponsive": "a loop in it neither ends nor can be interrupted; grade it by hand",
    "": "nbgrader cannot take it; `nbgrader autograde {lesson} --student={student}` in the course says why",
}


class Submission(NamedTuple):
    student: str
    lesson: str
    path: Path


def lessons_with_exercise() -> list[str]:
    return sorted(path.parent.name for path in SOLUTIONS.glob("*/*.ipynb"))


def release(course: str | Path, lessons: Sequence[str] = ()) -> list[Path]:
    """Copies for students of the exercises of ``lessons`` (default: all), under ``course/release``."""
    course, known = Path(course).resolve(), lessons_with_exercise()
    for lesson in lessons:
        if lesson not in known:
            raise InputError(f"{lesson} has no exercise; expected one of {', '.join(known)}")
    if course.is_relative_to(ROOT):
        raise InputError(f"{course} is inside of this repository; expected a folder outside")
    if course.exists() and not course.is_dir():
        raise InputError(f"{course} is a file; expected a new folder, or one made by release")
    settings = course / SETTINGS.name
    if course.is_dir() and any(course.iterdir()) and not settings.exists():
        raise InputError(
            f"{course} is not empty and not a course; expected a new folder, or one made by release"
        )
    check_folder(settings)
    if not settings.exists():
        shutil.copyfile(SETTINGS, settings)
    written = []
    for lesson in lessons or known:
        if not (course / "source" / lesson).exists():  # a teacher may have changed theirs
            shutil.copytree(SOLUTIONS / lesson, course / "source" / lesson)
        _expect(_nbgrader(course).generate_assignment(lesson), f"{lesson} could not be released")
        written.append(course / "release" / lesson / f"{lesson}.ipynb")
    return written


def write_copies() -> list[Path]:
    """The copies for students beside the lessons, made anew from the solutions."""
    written = []
    with tempfile.TemporaryDirectory() as folder:
        for path in release(Path(folder) / "course"):
            place = SOLUTIONS.parent / path.stem
            place.mkdir(exist_ok=True)
            written.append(Path(shutil.copyfile(path, place / path.name)))
    return written


def find_submissions(folder: str | Path) -> tuple[list[Submission], list[dict[str, str]]]:
    """Notebooks under ``folder`` by student and lesson, and a note for each that cannot be taken.

    A notebook has its lesson's name; the student's is that of its folder (above a folder of the lesson's
    name, as nbgrader lays them). A folder that holds none is a student's, too, and gets a note.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; expected one with STUDENT/LESSON.ipynb for each student")
    hidden = (".", "__MACOSX")  # checkpoints, and what archives of other systems hold
    inside = [
        path
        for path in sorted(folder.rglob("*"))
        if not any(part.startswith(hidden) for part in path.relative_to(folder).parts)
    ]
    paths = [path for path in inside if path.suffix == ".ipynb"]
    if not paths:
        raise InputError(f"{folder}: no notebook in it; expected STUDENT/LESSON.ipynb for each student")
    known, taken, notes, homes = lessons_with_exercise(), defaultdict(list), [], set()
    for path in paths:
        home, lesson = path.parent, path.stem
        home = home.parent if home.name in known and home != folder else home
        student = home.name if home != folder else "?"
        homes |= {path.parent if student == "?" else home} - {folder}
        if lesson not in known:
            text = f"{path.name} is no exercise; expected the name of the copy that was handed out"
            notes.append({"student": student, "lesson": "", "note": text})
        elif student == "?":
            text = f"{path.name} lies beside the students' folders; expected it in one of them"
            notes.append({"student": student, "lesson": lesson, "note": text})
        else:
            taken[student, lesson].append(path)
    for place in filter(Path.is_dir, inside):
        if not any(place.is_relative_to(home) or home.is_relative_to(place) for home in homes):
            homes.add(place)
            files = [str(path.relative_to(place)) for path in sorted(place.rglob("*")) if path.is_file()]
            what = ", ".join(files[:3] + ["..."] * (len(files) > 3)) or "nothing"
            text = f"no notebook in its folder, but {what}; expected LESSON.ipynb"
            notes.append({"student": place.name, "lesson": "", "note": text})
    found = []
    for (student, lesson), several in taken.items():
        if len(several) > 1:
            where = " and ".join(str(path.parent.relative_to(folder)) for path in several)
            text = f"handed in {len(several)} times, in {where}; expected once"
            notes.append({"student": student, "lesson": lesson, "note": text})
        else:
            found.append(Submission(student, lesson, several[0]))
    return found, notes


def inspect(path: Path, handed_out: Path) -> tuple[str, bool]:
    """What is unusual about a submitted notebook, in words ("" for nothing), and whether it can be graded."""
    notebook, warned = _read(path)
    cells = [name for name in map(task_of, notebook.cells) if name]
    tasks = {task_of(cell) for cell in nbformat.read(handed_out, 4).cells} - {"setup", "open"}
    if not tasks & set(cells):
        return "holds no task of the exercise; expected the copy that was handed out", False
    notes = []
    if doubles := sorted({name for name in cells if cells.count(name) > 1}):
        notes.append(f"the cell {', '.join(doubles)} is there more than once; all ran, the last one counts")
    if DuplicateCellId in warned:
        notes.append("some cells have the same id; graded with new ones")
    kernel = notebook.metadata.get("kernelspec", {}).get("name", "none")
    if kernel != "python3":
        notes.append(f"asks for the kernel {kernel}; graded with python3")
    return "; ".join(notes), True


def _read(path: Path) -> tuple[nbformat.NotebookNode, set[type[Warning]]]:
    """A notebook, and the kinds of what it was warned of (and mended) while it was read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        notebook = nbformat.read(path, 4)
    return notebook, {warning.category for warning in caught}


def task_of(cell: nbformat.NotebookNode) -> str | None:
    return cell.metadata.get("nbgrader", {}).get("grade_id")


def mended(path: Path, handed_out: Path) -> tuple[nbformat.NotebookNode, list[str]]:
    """A submission as it can be graded, and the names of the cells that were missing.

    Each task's cell is the first of its name; what is there again is plain code. What nbgrader knows of a
    cell is what was handed out. A check that is missing, or the first cell's imports, is put back before the
    next task. An answer is not: a stub might hide what stands in another cell.
    """
    (notebook, _), whole, gone = _read(path), nbformat.read(handed_out, 4), []
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3"}
    about = {task_of(cell): cell.metadata["nbgrader"] for cell in whole.cells if task_of(cell)}
    for cell in notebook.cells:
        own = about.pop(task_of(cell), None)
        cell.metadata.pop("nbgrader", None)
        if own:
            cell.metadata["nbgrader"] = own
    place = len(notebook.cells)
    for cell in reversed(whole.cells):
        names = [task_of(one) for one in notebook.cells]
        if (name := task_of(cell)) in names:
            place = names.index(name) if name else place
        elif name:
            gone.append(name)
            if not cell.metadata["nbgrader"]["solution"]:
                gone[-1] += " (put back)"
                notebook.cells.insert(place, cell)
    return notebook, gone[::-1]


def grade(course: str | Path, submissions: str | Path, progress: Callable = iter) -> Path:
    """Grade every notebook under ``submissions``; the table of ``report``."""
    course = _course(course)
    if (folder := Path(submissions).resolve()).is_relative_to(course):
        raise InputError(
            f"{folder} is inside of the course; expected a folder outside, nothing there is kept"
        )
    found, notes = find_submissions(folder)
    here = {(one.student, one.lesson) for one in found} | {(n["student"], n["lesson"]) for n in notes}
    here |= {(student, "") for student, _ in here}  # what was said of a name that is no exercise's
    notes += [note for note in _notes(course) if (note["student"], note["lesson"]) not in here]
    api = _nbgrader(course)
    for student, lesson, path in progress(found):
        handed_out = course / "release" / lesson / f"{lesson}.ipynb"
        text, gradable = "was not released in this course", False
        if handed_out.exists():
            try:
                text, gradable = inspect(path, handed_out)
                notebook, gone = mended(path, handed_out)
                content = nbformat.writes(notebook).encode()
            except Exception as error:  # one odd notebook must not end the others' grading
                text, gradable = f"does not open as a notebook ({type(error).__name__})", False
        if gradable:
            place = course / "submitted" / student / lesson
            if gone:
                text = f"{text}; " * bool(text) + f"missing: {', '.join(gone)}"
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            (place / f"{lesson}.ipynb").write_bytes(content)
            answer = api.autograde(lesson, student)
            if answer["success"]:
                api.generate_feedback(lesson, student)
            else:
                text, gradable = _why(answer).format(lesson=lesson, student=student), False
                with api.gradebook as book:  # no points rather than none
                    book.remove_submission(lesson, student)
        elif _has(api, lesson, student):
            text += "; the points are of an earlier hand-in"
        if text or not gradable:
            what = text if gradable else f"not graded: {text}"
            notes.append({"student": student, "lesson": lesson, "note": what})
    pd.DataFrame(notes, columns=["student", "lesson", "note"]).to_csv(course / "notes.csv", index=False)
    return _table(course)


def report(course: str | Path) -> Path:
    """``course/grades.csv``: points of every student and lesson, and what was noticed.

    The feedback pages lie in ``course/feedback/STUDENT/LESSON``; those with points that somebody entered are
    made anew.
    """
    course = _course(course)
    api = _nbgrader(course)
    with api.gradebook as book:
        read = [
            (assignment.name, one.student.id)
            for assignment, one, grades in _graded(book)
            if any(grade.manual_score is not None for grade in grades)
        ]
    for lesson, student in read:
        _expect(api.generate_feedback(lesson, student, force=True), f"the page of {student} was not made")
    return _table(course)


def _table(course: Path) -> Path:
    """``grades.csv``, from nbgrader's gradebook and ``notes.csv``."""
    rows = []
    with _nbgrader(course).gradebook as book:
        for assignment, one, grades in _graded(book):
            unread = (g.max_score for g in grades if g.needs_manual_grade and g.manual_score is None)
            rows.append((one.student.id, assignment.name, one.score, assignment.max_score, sum(unread)))
    if not rows and not _notes(course):
        raise InputError(f"{course}: nothing was graded yet; expected `classroom grade` first")
    table = pd.DataFrame(rows, columns=["student", "lesson", "points", "of", "to_read"])
    if noted := _notes(course):
        notes = pd.DataFrame(noted).groupby(["student", "lesson"], as_index=False).note.agg("; ".join)
        table = table.merge(notes, "outer", ["student", "lesson"])
    table.sort_values(["lesson", "student"]).to_csv(course / "grades.csv", index=False)
    return course / "grades.csv"


def _graded(book: Any) -> Iterator[tuple[Any, Any, list]]:
    """Assignment, submission and its grades, for all that a gradebook holds."""
    for assignment in book.assignments:
        for one in assignment.submissions:
            yield assignment, one, [grade for page in one.notebooks for grade in page.grades]


def _notes(course: Path) -> list[dict[str, str]]:
    """What was noticed so far: ``notes.csv``, one line each."""
    path, columns = course / "notes.csv", ["student", "lesson", "note"]
    try:
        return pd.read_csv(path, dtype=str, keep_default_na=False)[columns].to_dict("records")
    except (FileNotFoundError, pd.errors.EmptyDataError):
        return []
    except (KeyError, ValueError, OSError) as error:
        text = f"{path}: no table of notes ({type(error).__name__}); expected the columns"
        raise InputError(f"{text} {', '.join(columns)}, or no such file") from None


def _course(course: str | Path) -> Path:
    course = Path(course).resolve()
    if not (course / "nbgrader_config.py").exists():
        raise InputError(f"{course} is no course; expected a folder made by `classroom release`")
    return course


def _nbgrader(course: Path) -> Any:
    from nbgrader.apps import NbGraderAPI
    from sqlalchemy.exc import DatabaseError
    from traitlets.config import PyFileConfigLoader

    tools = str(Path(sys.executable).parent)  # nbgrader calls alembic by its bare name
    if tools not in os.environ["PATH"].split(os.pathsep):
        os.environ["PATH"] = os.pathsep.join([tools, os.environ["PATH"]])
    config = PyFileConfigLoader(str(course / "nbgrader_config.py")).load_config()
    config.CourseDirectory.root = str(course)
    config.NbGraderAPI.log_level = logging.ERROR
    logging.getLogger("traitlets").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="nbgrader")  # of its database
    api = NbGraderAPI(config=config)
    try:
        api.gradebook.close()
    except DatabaseError as error:
        path = course / "gradebook.db"
        raise InputError(f"{path}: does not open ({error.orig}); expected nbgrader's, or no file") from None
    return api


def _has(api: Any, lesson: str, student: str) -> bool:
    """Does the gradebook hold points of an earlier submission?"""
    with api.gradebook as book:
        return any((a.name, one.student.id) == (lesson, student) for a, one, _ in _graded(book))


def _why(answer: dict[str, Any]) -> str:
    """Why a notebook could not be graded, in words where they are known."""
    said = f"{answer.get('log')} {answer.get('error')}"
    return next(text for word, text in REASONS.items() if re.search(word, said))


def _expect(answer: dict[str, Any], text: str) -> None:
    if not answer["success"]:
        raise InputError(f"{text}: {_last_line(answer)}")


def _last_line(answer: dict[str, Any]) -> str:
    lines = (answer.get("error") or answer.get("log") or "no reason given").strip().splitlines()
    return lines[-1]
