"""The executed lessons as a book: static pages with navigation, formulas and videos, read without a network.

Made with nbconvert, which comes with JupyterLab: Jupyter Book 2 needs Node and, for its theme, the network.
Formulas become MathML, which browsers draw themselves.
"""

import html
import posixpath
import re
from functools import partial
from pathlib import Path
from typing import Any

from dmsrd_lite.demonstrations import check_folder
from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook.lessons import NOTEBOOKS, lessons
from dmsrd_lite.workbook.records import ROOT

TEXTS = {  # page: source
    "index": "notebooks/START.md", "teaching": "notebooks/README.md", "workbook": "README.md",
    "results": "RESULTS.md", "data": "data/README.md", "environment": "environment.md",
}  # fmt: skip
READING = re.compile(r"\*\*Reading the \w+\.\*\*\s*(.+?)(?=\n\n|$)", re.DOTALL)


def make_book(executed: Path, output: Path) -> Path:
    """Write the pages into ``output``; returns the first one, ``index.html``.

    ``executed``: a folder with a copy of every lesson, as ``make workbook`` leaves it; exercises are shown
    without answers. ``InputError`` where a copy is missing, does not open or ended in an error.
    """
    missing = [path.stem for path in lessons() if not (executed / path.name).exists()]
    if missing:
        what = f"{executed}: expected an executed copy of every lesson"
        raise InputError(f"{what}, not found: {', '.join(missing)} ('make workbook' makes them)")
    exercises = sorted(NOTEBOOKS.glob("exercises/0*/*.ipynb"))
    sources = {f"exercise_{path.stem}": path.relative_to(ROOT).as_posix() for path in exercises}
    sources |= TEXTS | {path.stem: path.relative_to(ROOT).as_posix() for path in lessons()}
    pages = {source: f"{page}.html" for page, source in sources.items()}
    pages["notebooks/exercises"] = pages[exercises[0].relative_to(ROOT).as_posix()]
    check_folder(output / "any")
    order = ["index", *(path.stem for path in lessons()), *(f"exercise_{path.stem}" for path in exercises)]
    order += [page for page in TEXTS if page not in order]
    titles, bodies = {}, {}
    for page in order:
        source = ROOT / sources[page]
        link = partial(_page_of, pages, posixpath.dirname(sources[page]))
        if source.suffix == ".md":
            text = source.read_text()
            body = _markdown(text, source.parent, link)
        else:
            notebook, text = _read(executed / source.name if page == source.stem else source)
            body = _notebook(notebook, source.parent, link)
        (titles[page],) = re.findall(r"^# (.+)$", text, re.MULTILINE)[:1] or [page]
        bodies[page] = body
    for before, page, after in zip(["", *order], order, [*order[1:], ""], strict=False):
        (output / f"{page}.html").write_text(_page(titles, bodies[page], before, page, after))
    return output / "index.html"


def _read(path: Path) -> tuple[Any, str]:
    """A notebook, and the text of its first cell."""
    import nbformat

    try:
        notebook = nbformat.read(path, 4)
        return notebook, notebook.cells[0].source
    except Exception as error:
        text = f"{path}: does not open as a notebook ({type(error).__name__}); expected an executed lesson"
        raise InputError(text) from None


def _page_of(pages: dict[str, str], folder: str, url: str) -> str:
    """Where a link of a file in ``folder`` leads within the book; "" for a file that is not in it."""
    if re.match(r"[a-z]+:|#", url):
        return url
    path, _, anchor = url.partition("#")
    page = pages.get(posixpath.normpath(posixpath.join(folder, path)), "")
    return f"{page}#{anchor}" if page and anchor else page


def _markdown(text: str, folder: Path, link: Any) -> str:
    from latex2mathml.converter import convert
    from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

    class Renderer(IPythonRenderer):
        def block_math(self, body: str) -> str:
            return convert(_spaced(body), display="block")

        def inline_math(self, body: str) -> str:
            return convert(_spaced(body))

        def block_html(self, html: str) -> str:
            return html  # as it is: what stands between <details> and </details> is text of its own

        def link(self, text: str, url: str, title: str | None = None) -> str:
            return super().link(text, found, title) if (found := link(url)) else text

    renderer = Renderer(escape=False, embed_images=True, path=str(folder), exclude_anchor_links=True)
    return MarkdownWithMath(renderer=renderer).render(text)


def _spaced(formula: str) -> str:
    """MathML sets no space after a function's name."""
    return re.sub(r"\\log +", r"\\log \\, ", formula)


def _notebook(notebook: Any, folder: Path, link: Any) -> str:
    """Cells and outputs; a figure's text for those who do not see it is the one that tells how to read it."""
    import nbformat
    from nbconvert import HTMLExporter
    from nbconvert.exporters.html import contextfilter

    class Exporter(HTMLExporter):
        @contextfilter
        def markdown2html(self, context: Any, source: str) -> str:
            return _markdown(source, folder, link)

    for i, cell in enumerate(notebook.cells):  # what is folded in JupyterLab is folded here
        if cell.metadata.get("jupyter", {}).get("source_hidden"):
            text = f"<details><summary>The check</summary>\n\n```python\n{cell.source}\n```\n\n</details>"
            notebook.cells[i] = nbformat.v4.new_markdown_cell(text)
    following = ""
    for cell in reversed(notebook.cells):
        if found := READING.match(cell.source):
            following = re.sub(r"[$*`\\]", "", " ".join(found[1].split()))
        outputs = [o for o in cell.get("outputs", []) if o.get("name") != "stderr"]  # progress bars
        for output in outputs:
            if output.output_type == "error":
                raise InputError(
                    f"{notebook.cells[0].source.splitlines()[0]}: ended in an error, {output.evalue}"
                )
            output.get("data", {}).pop("application/vnd.jupyter.widget-view+json", None)
            if "image/png" in output.get("data", {}):
                output.metadata["image/png"] = {"alt": following or "a figure"}
        if cell.cell_type == "code":
            cell.outputs = outputs
    return Exporter(template_name="basic").from_notebook_node(notebook)[0]


def _page(titles: dict[str, str], body: str, before: str, page: str, after: str) -> str:
    def link(to: str, text: str) -> str:
        here = ' aria-current="page"' if to == page else ""
        return f'<a href="{to}.html"{here}>{html.escape(text)}</a>' if to else "<span></span>"

    contents = "\n".join(f"<li>{link(to, title)}</li>" for to, title in titles.items())
    turn = link(before, f"\N{LEFTWARDS ARROW} {titles.get(before, '')}")
    turn += link(after, f"{titles.get(after, '')} \N{RIGHTWARDS ARROW}")
    title, style = html.escape(titles[page]), _style()
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>{style}</style></head>
<body><nav><ul>
{contents}
</ul></nav>
<main>{body}<footer>{turn}</footer></main></body></html>
"""


def _style() -> str:
    from pygments.formatters import HtmlFormatter

    return (Path(__file__).parent / "book.css").read_text() + HtmlFormatter().get_style_defs(".highlight")
