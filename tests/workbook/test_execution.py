"""Notebooks executed headless: the error in one line, what was handed over, the figures of the gallery."""

import base64

import nbformat
import pytest

from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook.execution import execute, export_gallery, handed_over
from dmsrd_lite.workbook.lessons import MIME

PUBLISH = "from IPython.display import publish_display_data\npublish_display_data({'%s': {'%s': n}})"


@pytest.mark.parametrize(
    ("cell", "sentence"),
    [
        ("n += 1", ""),
        ("raise ValueError('first line\\nsecond line')", "cell 4: ValueError: first line"),
        ("import time\ntime.sleep(60)", "Timeout"),
        ("import os\nos._exit(1)", "DeadKernelError"),
    ],
)
def test_parameters_go_in_results_come_out_and_an_error_is_one_line(cell, sentence, tmp_path):
    sources = ("n: int = 0", PUBLISH % (MIME, "first"), cell, PUBLISH % (MIME, "second"))
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    cells[0].metadata.tags = ["parameters"]
    kernel = {"kernelspec": {"name": "python3", "language": "python", "display_name": "Python 3"}}
    nbformat.write(nbformat.v4.new_notebook(cells=cells, metadata=kernel), tmp_path / "in.ipynb")
    output = tmp_path / "new" / "out.ipynb"
    error, seconds = execute(tmp_path / "in.ipynb", output, {"n": 3}, tmp_path, cell_seconds=5)
    assert sentence in error
    assert "\n" not in error
    assert seconds > 0
    results = {"first": 3} if sentence else {"first": 3, "second": 4}
    assert handed_over(nbformat.read(output, 4)) == results, "the copy is kept either way"


def test_the_gallery_is_taken_out_of_executed_notebooks(tmp_path):
    shown = nbformat.v4.new_output("display_data", {"image/png": base64.b64encode(b"picture").decode()})
    cells = [nbformat.v4.new_code_cell("x", outputs=[shown]) for _ in range(2)]
    cells[1].metadata.tags = ["gallery-reward"]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "a.ipynb")
    (path,) = export_gallery(tmp_path, tmp_path / "gallery")
    assert (path.name, path.read_bytes()) == ("reward.png", b"picture")
    with pytest.raises(InputError, match="holds no executed notebook with a figure for the gallery"):
        export_gallery(tmp_path / "gallery", tmp_path / "gallery")
