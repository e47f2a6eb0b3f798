"""Every number in one place: settings of each lesson, domain and preset, and what may change them."""

from dataclasses import replace

import pytest

from dmsrd_lite.domains import DOMAINS, InputError
from dmsrd_lite.workbook import presets
from dmsrd_lite.workbook.lessons import lessons
from dmsrd_lite.workbook.presets import KNOBS, LESSONS, choose

EVERY_KNOB = [(lesson, name) for lesson, knobs in KNOBS.items() for name in knobs]


def at(settings, path):
    for name in path.split("."):
        settings = getattr(settings, name)
    return settings


def put(settings, path, value):
    first, _, rest = path.partition(".")
    return replace(settings, **{first: put(getattr(settings, first), rest, value) if rest else value})


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("lesson", LESSONS)
def test_every_lesson_has_quick_and_full_in_both_domains(lesson, domain):
    quick, full = (choose(lesson, domain, preset) for preset in presets.PRESETS)
    assert type(quick) is type(full)
    assert quick != full
    assert hash(quick) == hash(choose(lesson, domain, "quick")), "frozen through and through"
    for name in dir(type(full)):  # variants (``batch``, ``paid``) are settings, too
        assert getattr(full, name) is not None or not isinstance(getattr(type(full), name), property)


def test_every_notebook_has_settings_and_nothing_else_has():
    assert {path.stem for path in lessons()} == set(LESSONS) >= set(KNOBS)
    for table in (presets.DEMONSTRATORS, presets.TEST_SETS, presets.METHODS):
        assert list(table) == list(DOMAINS)
    with pytest.raises(InputError, match="unknown preset 'huge': expected one of quick, full"):
        choose("02_airl", "inverted_pendulum", "huge")


@pytest.mark.parametrize("preset", presets.PRESETS)
@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize(("lesson", "name"), EVERY_KNOB)
def test_a_parameter_changes_its_own_setting_and_nothing_at_its_default(lesson, name, domain, preset):
    knob, usual = KNOBS[lesson][name], choose(lesson, domain, preset)
    now = at(usual, knob.path)
    assert choose(lesson, domain, preset, **{name: knob.default}) == usual
    assert not knob.default or now == knob.default, "a default that is a number is the preset's"
    for value in {knob.least, knob.most} - {knob.default}:
        changed = choose(lesson, domain, preset, **{name: value})
        assert changed == put(usual, knob.path, value)
        assert type(at(changed, knob.path)) is type(now)


@pytest.mark.parametrize(("lesson", "name"), EVERY_KNOB)
def test_what_it_may_not_be_is_one_sentence(lesson, name):
    knob = KNOBS[lesson][name]
    now = at(LESSONS[lesson]("lunar_lander", True), knob.path)
    halves, switches = [knob.least + 0.5] * isinstance(now, int), [True] * (not isinstance(now, bool))
    for bad in (-7, knob.most * 2 + 1, "many", None, float("nan"), *halves, *switches):
        with pytest.raises(
            InputError, match=f"^{name} {bad!r}: expected a (whole )?number from .* to [^\n]*$"
        ):
            choose(lesson, "lunar_lander", "quick", **{name: bad})
