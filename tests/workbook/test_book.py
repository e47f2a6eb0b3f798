import re
import shutil

import nbformat
import pytest

from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook import book
from dmsrd_lite.workbook.lessons import lessons

PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """The lessons with a figure and a progress bar in lesson 02, as if they had been run."""
    folder = tmp_path_factory.mktemp("executed")
    for path in lessons():
        shutil.copy(path, folder)
    notebook = nbformat.read(folder / "02_airl.ipynb", 4)
    at = next(i for i, c in enumerate(notebook.cells) if c.source.startswith("**Reading the figure.**"))
    notebook.cells[at - 1].outputs = [
        nbformat.v4.new_output("stream", name="stderr", text="a progress bar"),
        nbformat.v4.new_output("display_data", {"image/png": PIXEL}),
    ]
    nbformat.write(notebook, folder / "02_airl.ipynb")
    return folder


@pytest.fixture(scope="module")
def pages(executed, tmp_path_factory):
    first = book.make_book(executed, tmp_path_factory.mktemp("book"))
    assert first.name == "index.html"
    return {path.name: path.read_text() for path in first.parent.iterdir()}


def test_every_link_leads_somewhere_and_none_out_of_reach(pages):
    anchors = {name: set(re.findall(r'id="([^"]+)"', text)) for name, text in pages.items()}
    for name, text in pages.items():
        assert not re.search(r'src="(?!data:)', text), f"{name}: a picture or script that is not in the book"
        for link in re.findall(r'href="(?!https?:)([^"]+)"', text):
            page, _, anchor = link.partition("#")
            assert not anchor or anchor in anchors[page or name], f"{name}: {link}"
            assert not page or page in pages, f"{name}: {link}"
    assert 'href="03_msrd.html"' in pages["02_airl.html"]
    assert 'href="results.html"' in pages["index.html"]


def test_formulas_are_drawn_and_answers_are_folded(pages):
    for name, text in pages.items():
        prose = re.sub(r"<(pre|code)\b.*?</\1>", "", text, flags=re.DOTALL)
        assert not re.search(r"\$|\\[a-z]{2,}", prose), f"{name}: a formula is left as it was typed"
    folded = re.search(r"<details>.*?</details>", pages["02_airl.html"], re.DOTALL)
    assert "Place 0" in folded[0]


def test_a_figure_is_told_by_the_text_that_reads_it_and_progress_is_left_out(pages):
    (told,) = re.findall(r'<img[^>]*alt="([^"]+)"', pages["02_airl.html"])
    assert told.startswith("Left: near 1, the discriminator sees through the policy")
    assert "a progress bar" not in pages["02_airl.html"]


def test_what_cannot_become_a_book_is_said_in_a_sentence(executed, tmp_path):
    with pytest.raises(
        InputError, match=r"^.*expected an executed copy of every lesson, not found: 00_start"
    ):
        book.make_book(tmp_path, tmp_path / "book")
    folder = shutil.copytree(executed, tmp_path / "failed")
    notebook = nbformat.read(folder / "00_start_here.ipynb", 4)
    notebook.cells[1].outputs = [nbformat.v4.new_output("error", ename="E", evalue="no", traceback=[])]
    nbformat.write(notebook, folder / "00_start_here.ipynb")
    with pytest.raises(InputError, match="00 Start here: ended in an error, no"):
        book.make_book(folder, tmp_path / "book")
    for broken in ("{", "{}"):
        (folder / "00_start_here.ipynb").write_text(broken)
        with pytest.raises(InputError, match=r"^\S+/00_start_here.ipynb: does not open as a notebook"):
            book.make_book(folder, tmp_path / "book")
    with pytest.raises(InputError, match=r"cannot be written to \(File exists\)"):
        book.make_book(executed, folder / "00_start_here.ipynb")
