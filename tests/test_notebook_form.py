"""The form of a lesson: what a reader can rely on in every notebook. A failure says what to do."""

import ast
import re
import statistics

import nbformat
import papermill
import pytest

from dmsrd_lite.workbook.lessons import NOTEBOOKS, lessons
from dmsrd_lite.workbook.presets import KNOBS
from dmsrd_lite.workbook.records import ROOT

EXERCISES = sorted(NOTEBOOKS.glob("exercises/solutions/*/*.ipynb"))
COPIES = sorted(NOTEBOOKS.glob("exercises/0*/*.ipynb"))  # for students
SECTIONS = ("**Question.**", "**You will be able to**", "**Needs.**", "**Time.**", "**Predict first.**",
            "**Break it", "## What we claim", "## What this does not show", "## Go on")  # fmt: skip
LINK = r"(?<!!)\[[^\]]*\]\(([^)#]+)[^)]*\)"


def name(path):
    return str(path.relative_to(ROOT))


class Lesson:
    def __init__(self, path):
        self.path, self.name, self.notebook = path, name(path), nbformat.read(path, 4)
        self.code = [c for c in self.notebook.cells if c.cell_type == "code"]
        self.sources = "\n".join(c.source for c in self.code)
        self.text = "\n".join(c.source for c in self.notebook.cells if c.cell_type == "markdown")


@pytest.fixture(params=lessons(), ids=lambda p: p.stem)
def lesson(request):
    return Lesson(request.param)


def assert_none(faults, text):
    assert not faults, f"{text}:\n" + "\n".join(f"  {fault}" for fault in faults)


def test_sections(lesson):
    title = lesson.notebook.cells[0].source
    assert re.match(r"# \d\d \w+", title), f"{lesson.name}: the first cell begins with '# NN Topic'"
    plain = lesson.text.replace("### Break it", "**Break it")
    assert_none([s for s in SECTIONS if s not in plain], f"{lesson.name} lacks these sections")


@pytest.mark.parametrize("path", [*lessons(), *EXERCISES], ids=name)
def test_stored_without_outputs_and_with_a_plain_kernel(path):
    lesson = Lesson(path)
    outputs = any(c.outputs or c.execution_count for c in lesson.code)
    remedy = f"run .venv/bin/nbstripout {lesson.name}, or read in the copy that `make lab` makes"
    assert not outputs, f"{lesson.name} holds outputs: {remedy}"
    spec = lesson.notebook.metadata.get("kernelspec", {})
    kernel = (spec.get("name"), spec.get("language"))
    assert kernel == ("python3", "python"), f"{lesson.name}: set the kernel to python3, language python"


def test_parameters_are_commented_literals_and_those_of_the_presets(lesson):
    (cell,) = [c for c in lesson.code if "parameters" in c.metadata.get("tags", [])]
    lines, form = cell.source.splitlines(), r"\w+: (str|int|float|bool) = [^#]+  # .+"
    bad = [line for line in lines if not re.fullmatch(form, line)]
    assert_none(bad, f"{lesson.name}: write parameters as 'name: type = value  # what it is'")
    found = papermill.inspect_notebook(str(lesson.path))
    assert len(found) == len(lines), f"{lesson.name}: papermill does not see every parameter"
    usual = {k: ast.literal_eval(p["default"]) for k, p in found.items()}
    missing = [k for k in ("domain", "preset", "seed") if k not in usual]
    assert_none(missing, f"{lesson.name} lacks these parameters")
    knobs = {k: knob.default for k, knob in KNOBS.get(lesson.path.stem, {}).items()}
    wrong = [k for k, default in knobs.items() if usual.get(k) != default]
    assert_none(wrong, f"{lesson.name}: give these parameters the default of presets.KNOBS ({knobs})")


def test_the_frame(lesson):
    start = re.search(rf'lessons\.start\(\s*"{lesson.path.stem}",\s*domain,\s*preset,\s*seed', lesson.sources)
    call = f'lessons.start("{lesson.path.stem}", domain, preset, seed, ...)'
    assert start, f"{lesson.name}: begin with {call}"
    used = "\n".join(c.source for c in lesson.code if "parameters" not in c.metadata.get("tags", []))
    unused = [k for k in KNOBS.get(lesson.path.stem, {}) if not re.search(rf"\b{k}\b", used)]
    assert_none(unused, f"{lesson.name}: hand these parameters to lessons.start")
    for part in ("lesson.claim(", "lesson.hand_over("):
        assert part in lesson.sources, f"{lesson.name}: end with {part}...)"
    own = re.findall(r"\w+Settings\(.*", lesson.sources)
    assert_none(own, f"{lesson.name}: move these numbers to workbook/presets.py")


def test_cells_are_short(lesson):
    lines = [sum(bool(line.strip()) for line in c.source.splitlines()) for c in lesson.code]
    long = [c.source.splitlines()[0] for c, n in zip(lesson.code, lines, strict=True) if n > 25]
    assert_none(long, f"{lesson.name}: split the cells that begin so, they have more than 25 lines")
    median = statistics.median(lines)
    assert median <= 8, f"{lesson.name}: half of the cells have more than {median} lines; at most 8"


def test_no_magics_addresses_or_absolute_paths(lesson):
    magics = re.findall(r"^\s*[!%].*", lesson.sources, re.M)
    assert_none(magics, f"{lesson.name}: plain Python only")
    elsewhere = r"https?://\S+|(?<![\w.~])/(?:home|root|opt|tmp|work)/\S*"
    found = re.findall(elsewhere, lesson.text + "\n" + lesson.sources)
    assert_none(found, f"{lesson.name}: works offline and on any machine")


def test_every_figure_is_explained_fits_the_page_and_keeps_the_colours(lesson):
    for cell, following in zip(lesson.notebook.cells, [*lesson.notebook.cells[1:], None], strict=True):
        slides = "lessons.slider(" in cell.source and "return fig" in cell.source
        if cell.cell_type == "code" and ("plt.show()" in cell.source or slides):
            where = f"{lesson.name}: write **Reading the figure.** below\n{cell.source}"
            assert following is not None, where
            assert "**Reading" in following.source, where
    wide = [w for w in re.findall(r"figsize=\((\d[\d.]*),", lesson.sources) if float(w) > 9]
    assert_none(wide, f"{lesson.name}: figures are at most 9 inches wide")
    colours = re.findall(r"""["']#[0-9A-Fa-f]{6}["']|\bcolor=["'](?!black|white)\w+["']""", lesson.sources)
    assert_none(colours, f"{lesson.name}: take figures.INK, figures.INKS[k] or figures.strategy_style(k)")


TEXTS = [NOTEBOOKS / "START.md", NOTEBOOKS / "README.md"]


def test_what_was_to_be_predicted_is_answered_one_click_away(lesson):
    cells = [c.source for c in lesson.notebook.cells]
    asked = [i for i, text in enumerate(cells) if "**Predict first.**" in text]
    answered = [i for i, text in enumerate(cells) if text.startswith("<details><summary>Answer</summary>")]
    assert len(asked) == len(answered), "every question has one cell with its answer"
    for i, j, following in zip(asked, answered, [*asked[1:], len(cells)], strict=True):
        assert any(c.cell_type == "code" for c in lesson.notebook.cells[i:j]), "shown first, then told"
        assert j <= following + 3, f"the answer to cell {i} comes after the next question"


@pytest.mark.parametrize("path", [*lessons(), *COPIES, *TEXTS], ids=name)
def test_links_lead_somewhere(path):
    text = path.read_text() if path.suffix == ".md" else Lesson(path).text
    broken = [link for link in re.findall(LINK, text) if not (path.parent / link).exists()]
    assert_none(broken, f"{name(path)}: these links lead nowhere")


def test_needs_and_go_on_are_links(lesson):
    needs = re.search(r"\*\*Needs\.\*\*(.*?)\*\*Time\.\*\*", lesson.text, re.S)[1]
    go_on = lesson.text.split("## Go on")[1]
    bare = re.findall(r"\b\d\d_[a-z]\w*", re.sub(LINK, "", needs + go_on))
    assert_none(bare, f"{lesson.name}: write them as [02_airl](02_airl.ipynb)")
    assert re.search(LINK, go_on), f"{lesson.name}: 'Go on' leads to the next lesson or the exercise"


@pytest.mark.parametrize("page", ["README.md", "notebooks/START.md"])
def test_the_map_names_every_lesson(page):
    text = (ROOT / page).read_text()
    assert_none([path.name for path in lessons() if f"{path.name})" not in text], f"{page} has no link to")


def test_every_lesson_of_the_paper_has_an_exercise():
    assert [p.parent.name for p in EXERCISES] == [p.stem for p in lessons()][1:9]
