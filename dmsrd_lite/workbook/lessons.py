"""The frame of every lesson: settings at the start, claims and results at the end, sliders between."""

import dataclasses
import inspect
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dmsrd_lite.demonstrations import plain
from dmsrd_lite.domains import Domain, get_domain
from dmsrd_lite.domains.domain import check_whole
from dmsrd_lite.workbook import figures, presets
from dmsrd_lite.workbook.records import MIME, NOTEBOOKS


@dataclasses.dataclass(frozen=True)
class Lesson:
    """One run of a lesson: what it runs with, and whether a claim that does not hold is an error."""

    name: str
    domain: Domain
    preset: str
    seed: int
    settings: Any  # of ``presets``
    is_default: bool  # shipped data and default parameters
    started: float

    @property
    def quick(self) -> bool:
        return self.preset == "quick"

    def claim(self, holds: bool, text: str, *, strict: bool | None = None) -> None:
        """Print ``holds`` or ``does not hold`` before a claim.

        One that does not hold is an error where we make it (``strict``): on the pendulum, shipped data,
        default parameters.
        """
        strict = self.is_default and self.domain.name == presets.PENDULUM if strict is None else strict
        print(("holds:         " if holds else "does not hold: ") + text)
        if strict and not holds:
            raise AssertionError(f"a claim of this lesson does not hold: {text}")

    def hand_over(self, *, environment_steps: int, **results: Any) -> None:
        """Put results into the executed notebook, as an output of the cell that shows one line.

        ``environment_steps``: those of the training that the lesson is about. Adds ``seconds`` since the
        start; what is called ``seconds`` or ``..._seconds`` is kept out of a run's metrics (``plans``): it is
        never the same twice.
        """
        from IPython.display import publish_display_data

        seconds = time.perf_counter() - self.started
        results = plain({**results, "environment_steps": environment_steps, "seconds": seconds})
        text = f"{self.name}: {environment_steps:,} environment steps, {seconds:.0f} s"
        publish_display_data({MIME: results, "text/plain": text})


def start(
    name: str, domain: str | Domain, preset: str, seed: int, *, custom: bool = False, **parameters: Any
) -> Lesson:
    """Check a lesson's parameters, choose its settings (``presets.choose``), set the figures' style, and
    print the settings.

    ``InputError``, one sentence, for a parameter that cannot be used; those that change no setting of
    ``presets`` are not given, but said by ``custom`` if they are not at their defaults (a file of your own).
    """
    found = domain if isinstance(domain, Domain) else get_domain(domain)  # run again, it is what it became
    number = check_whole(seed, "seed")
    settings = presets.choose(name, found.name, preset, **parameters)
    is_default = not custom and number == 0 and settings == presets.choose(name, found.name, preset)
    figures.use_style()
    print(f"{name}: {found.title}, preset {preset}, seed {number}")
    print(describe(settings))
    return Lesson(name, found, preset, number, settings, is_default, time.perf_counter())


def describe(settings: Any, path: str = "") -> str:
    """Settings as text: of each object what differs from the defaults of its class."""
    own, nested = [], []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value) and value != field.default:
            nested.append(describe(value, f"{path}.{field.name}".removeprefix(".")))
        elif value != field.default:
            own.append(f"{field.name} {value!r}")
    name = f"{path} ({type(settings).__name__}): " if path else ""
    text = textwrap.fill(name + (", ".join(own) or "as its class has it"), 88, subsequent_indent="    ")
    return "\n".join([text, *nested] if own or not nested else nested)


def slider(draw: Callable[..., Any], **controls: Any) -> None:
    """Sliders over ``draw``, which returns a figure or a text; its defaults are shown first.

    The figure is an output of its own: a notebook that is read without a kernel, or executed headless, keeps
    the last one. ``controls`` as in ipywidgets: ``(least, most, step)``, a list of values, or a widget.
    """
    import matplotlib.pyplot as plt
    from IPython.display import display
    from ipywidgets import HBox, Layout, interactive

    parameters = inspect.signature(draw).parameters.items()
    defaults = {name: p.default for name, p in parameters if p.kind is not p.VAR_KEYWORD}
    widgets = {
        name: interactive.widget_from_abbrev(control, defaults.get(name))
        for name, control in controls.items()
    }

    class Sliders(HBox):
        def __repr__(self) -> str:  # what a reader sees without a kernel
            return f"Run this cell to move its sliders: {', '.join(widgets)}."

    def shown() -> Any:
        answer = draw(**{**defaults, **{name: widget.value for name, widget in widgets.items()}})
        plt.close("all")  # or it would be shown twice
        return figures.Text(answer) if isinstance(answer, str) else answer

    for name, widget in widgets.items():
        widget.description, widget.continuous_update = name, False
        widget.layout.width, widget.style.description_width = "380px", "initial"
    display(Sliders(list(widgets.values()), layout=Layout(flex_flow="row wrap")))
    handle = display(shown(), display_id=True)
    for widget in widgets.values():
        widget.observe(lambda change: handle.update(shown()), "value")


def lessons() -> list[Path]:
    """The notebooks in the order in which they are read."""
    return sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))
