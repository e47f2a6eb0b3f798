"""nbgrader's settings, of this folder and of a course (``classroom release``)."""

import os
from pathlib import Path

from nbconvert.preprocessors import CSSHTMLHeaderPreprocessor
from nbgrader.preprocessors import ClearHiddenTests, GetGrades


def seconds(cell):
    """For a cell: an endless loop costs its own task, a slow import nobody's."""
    return 4 if cell.metadata.get("nbgrader", {}).get("grade") else 60


c = get_config()  # noqa: F821 (traitlets defines it)
if (Path(__file__).parent / "solutions").is_dir():  # and students' copies beside them
    c.CourseDirectory.source_directory = "solutions"
    c.CourseDirectory.release_directory = "."
c.CourseDirectory.course_id = "dmsrd_lite"
pages = [GetGrades, ClearHiddenTests, CSSHTMLHeaderPreprocessor]
c.GenerateFeedback.preprocessors = pages
c.ClearSolutions.code_stub = {"python": 'raise NotImplementedError("not yet")'}
c.ClearSolutions.text_stub = "*Your answer.*"
c.Execute.timeout_func = seconds
c.Execute.extra_arguments = ["--IPKernelApp.log_level=40"]  # it warns of its sockets
os.environ["PYTHONWARNINGS"] = "ignore"  # nbgrader takes warnings for wrong answers
