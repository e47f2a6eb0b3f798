"""The frame of a lesson: parameters, claims, results, sliders, and how an error looks in a notebook."""

import dataclasses
import json

import IPython.display
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from dmsrd_lite.domains import INVERTED_PENDULUM, InputError
from dmsrd_lite.workbook import lessons, presets
from dmsrd_lite.workbook.lessons import MIME


def begin(**changes):
    return lessons.start(
        "03_msrd", **{"domain": "inverted_pendulum", "preset": "quick", "seed": 0, **changes}
    )


def test_a_lesson_prints_what_it_runs_with(capsys):
    lesson = begin(alpha=1.5)
    assert (lesson.quick, lesson.seed, lesson.domain) == (True, 0, INVERTED_PENDULUM)
    assert lesson.settings == presets.choose("03_msrd", "inverted_pendulum", "quick", alpha=1.5)
    first, *settings = capsys.readouterr().out.strip().splitlines()
    assert first == "03_msrd: Inverted Pendulum, preset quick, seed 0"
    assert "alpha 1.5" in " ".join(settings)
    again = begin(alpha=1.5, domain=lesson.domain)  # the cell run once more, after ``domain = lesson.domain``
    assert (again.domain, again.settings) == (lesson.domain, lesson.settings)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"domain": "cartpole"}, "unknown domain 'cartpole': expected one of"),
        ({"preset": "huge"}, "unknown preset 'huge': expected one of quick, full"),
        ({"seed": -1}, "seed -1: expected a whole number of at least 0"),
        ({"n_iterations": 1.5}, "n_iterations 1.5: expected a whole number from 1 to 10000, or 0: by preset"),
        ({"alpha": "a"}, "alpha 'a': expected a number from 1e-06 to 1000$"),
    ],
)
def test_a_wrong_parameter_is_one_sentence(changes, sentence):
    with pytest.raises(InputError, match=f"^{sentence}") as caught:
        begin(**changes)
    assert caught.value._render_traceback_() == [f"InputError: {caught.value}"]


@pytest.mark.parametrize(
    ("changes", "is_default", "strict"),
    [
        ({}, True, True),
        ({"preset": "full", "alpha": 0.3, "n_iterations": 0}, True, True),
        ({"seed": 1}, False, False),
        ({"alpha": 1.0}, False, False),
        ({"custom": True}, False, False),
        ({"domain": "lunar_lander"}, True, False),
    ],
)
def test_claims_raise_where_we_make_them(changes, is_default, strict, capsys):
    lesson = begin(**changes)
    capsys.readouterr()
    assert lesson.is_default == is_default
    lesson.claim(True, "one")
    lesson.claim(False, "two", strict=False)
    assert capsys.readouterr().out == "holds:         one\ndoes not hold: two\n"
    with pytest.raises(AssertionError, match="a claim of this lesson does not hold: three"):
        lesson.claim(False, "three", strict=None if strict else True)
    if not strict:
        lesson.claim(False, "four")


def test_what_is_handed_over_is_one_line_for_a_reader(monkeypatch):
    published = []
    monkeypatch.setattr(IPython.display, "publish_display_data", published.append)
    results = {f"a_long_name_{k}": np.arange(1000.0) for k in range(9)} | {"nothing": np.nan}
    begin().hand_over(environment_steps=1234567, **results)
    (data,) = published
    assert data["text/plain"] == "03_msrd: 1,234,567 environment steps, 0 s"
    assert data[MIME].keys() == {*results, "environment_steps", "seconds"}
    assert (data[MIME]["a_long_name_8"], data[MIME]["nothing"]) == (list(range(1000)), None)
    json.dumps(data, allow_nan=False)


@dataclasses.dataclass(frozen=True)
class Inner:
    size: int = 3


@dataclasses.dataclass(frozen=True)
class Outer:
    name: str
    speed: float = 0.5
    inner: Inner = Inner()


def test_settings_are_described_by_what_differs_from_their_class():
    assert lessons.describe(Outer("a", 0.7)) == "name 'a', speed 0.7"
    assert lessons.describe(Outer("a", inner=Inner(4))) == "name 'a'\ninner (Inner): size 4"
    assert lessons.describe(Inner()) == "as its class has it"
    for name in presets.LESSONS:
        text = lessons.describe(presets.choose(name, "lunar_lander", "full"))
        assert max(map(len, text.splitlines())) <= 88, name


class Page(list):
    """Stands for a notebook's page: everything that was displayed, and what it was changed to."""

    def display(self, output, display_id=False):
        self.append(output)
        return self if display_id else None

    update = list.append


def test_a_slider_changes_an_output_of_its_own(monkeypatch):
    page, calls = Page(), []
    monkeypatch.setattr(IPython.display, "display", page.display)

    def draw(value=3, other=None, name="a"):
        calls.append((value, other, name))
        return plt.figure()

    lessons.slider(draw, value=(0, 9, 1), name=["a", "b"])
    box, _ = page
    value, name = box.children
    assert (value.description, name.description) == ("value", "name")
    value.value = 5
    name.value = "b"
    assert calls == [(3, None, "a"), (5, None, "a"), (5, None, "b")], "its defaults are shown first"
    assert [type(output) for output in page[1:]] == [plt.Figure] * 3
    assert not plt.get_fignums(), "or it would be shown twice"
    lessons.slider(lambda value=3: f"value\n{value}", value=(0, 9, 1))
    assert repr(page[-1]) == "value\n3", "a text, without quotes"


NOTEBOOK = """
import matplotlib.pyplot as plt
from dmsrd_lite.workbook import lessons
lessons.slider(lambda value=3: plt.plot([value])[0].figure, value=(0, 9, 1))
###
def deeper():
    lessons.start("02_airl", "cartpole", "quick", 0)
deeper()
###
lesson = lessons.start("02_airl", "inverted_pendulum", "quick", 0)
lesson.hand_over(environment_steps=5, kl=[1.0, 2.0])
"""


def test_in_an_executed_notebook(tmp_path):
    """A slider keeps its last figure, an error is one line, and what is handed over shows as one."""
    cells = [nbformat.v4.new_code_cell(source.strip()) for source in NOTEBOOK.split("###")]
    client = NotebookClient(nbformat.v4.new_notebook(cells=cells), timeout=300, allow_errors=True)
    slider, error, end = (cell.outputs for cell in client.execute(cwd=str(tmp_path)).cells)
    kinds = [kind for output in slider for kind in output.get("data", {})]
    assert kinds.count("image/png") == kinds.count("application/vnd.jupyter.widget-view+json") == 1
    names = "inverted_pendulum, lunar_lander"
    assert [o.traceback for o in error] == [
        [f"InputError: unknown domain 'cartpole': expected one of {names}"]
    ]
    (shown,) = [o.data for o in end if MIME in o.get("data", {})]
    assert shown[MIME]["kl"] == [1.0, 2.0]
    assert shown["text/plain"].startswith("02_airl: 5 environment steps")
