"""The form of a lesson: what a reader can rely on in every notebook."""

import re
import statistics

import nbformat
import papermill
import pytest

from dmsrd_lite.runs import ROOT, lessons

PATHS = lessons()
SECTIONS = ("**Question.**", "**You will be able to**", "**Needs.**", "**Time.**", "**Predict first.**", "**Break it", "What we claim",
            "What this does not show", "## Go on")  # fmt: skip


def read(path):
    notebook = nbformat.read(path, 4)
    code = [c for c in notebook.cells if c.cell_type == "code"]
    text = "\n".join(c.source for c in notebook.cells if c.cell_type == "markdown")
    return notebook, code, text


def n_lines(cell):
    return sum(1 for line in cell.source.splitlines() if line.strip())


@pytest.mark.parametrize("path", PATHS, ids=lambda p: p.stem)
class TestForm:
    def test_sections(self, path):
        notebook, _, text = read(path)
        assert re.match(r"# \d\d \w+", notebook.cells[0].source)
        plain = text.replace("### Break it", "**Break it")
        assert [s for s in SECTIONS if s not in plain] == []

    def test_stored_without_outputs_and_with_a_plain_kernel(self, path):
        notebook, code, _ = read(path)
        assert all(c.outputs == [] and c.execution_count is None for c in code)
        assert notebook.metadata.kernelspec.name == "python3"
        assert notebook.metadata.kernelspec.language == "python"

    def test_parameters(self, path):
        found = papermill.inspect_notebook(str(path))
        assert {"domain", "preset", "seed"} <= set(found)
        _, code, _ = read(path)
        (cell,) = [c for c in code if "parameters" in c.metadata.get("tags", [])]
        for line in cell.source.splitlines():
            assert re.fullmatch(r"\w+: (str|int|float|bool) = [^#]+  # .+", line), line
        assert len(found) == len(cell.source.splitlines()), "papermill must see every parameter"

    def test_cells_are_short(self, path):
        _, code, _ = read(path)
        assert max(map(n_lines, code)) <= 25
        assert statistics.median(map(n_lines, code)) <= 8

    def test_no_magics_addresses_or_absolute_paths(self, path):
        _, code, text = read(path)
        for cell in code:
            assert not re.search(r"^\s*[!%]", cell.source, re.M), cell.source
        everything = text + "\n".join(c.source for c in code)
        assert not re.search(r"https?://|(?<![\w.~])/(home|root|opt|tmp|work)/", everything)

    def test_every_figure_is_explained(self, path):
        notebook, _, _ = read(path)
        for cell, following in zip(notebook.cells, [*notebook.cells[1:], None], strict=True):
            if cell.cell_type == "code" and "plt.show()" in cell.source:
                assert following is not None
                assert "**Reading the figure.**" in following.source, cell.source


def test_the_repository_names_no_machine():
    for path in (*ROOT.glob("*.md"), *ROOT.glob("*.toml"), *ROOT.glob("dmsrd_lite/*.py"), *ROOT.glob("*/*.md"), ROOT / "requirements.lock"):
        assert not re.search(r"(?<![\w.~])/(home|root|opt|tmp|work)/\w", path.read_text()), path
