"""Records on disk, and the hash that says whether a number is still the number."""

from dataclasses import replace

import numpy as np
import pytest

from dmsrd_lite.domains import InputError
from dmsrd_lite.method.dmsrd import DMSRDSettings
from dmsrd_lite.workbook import presets, records
from dmsrd_lite.workbook.records import DECIDING, load_record, save_record, source_hash


def test_round_trip_without_pickle(tmp_path):
    settings, tensors = DMSRDSettings(kl_margin=0.7), {"a": np.arange(6, dtype=np.float32).reshape(2, 3)}
    results = {"kl": np.array([1.0, np.nan]), "n": np.int64(3), "table": [[1, 2], [3, 4]]}
    path = save_record("r", {"seed": 0}, settings, results, tensors, tmp_path)
    record, loaded = load_record("r", tmp_path)
    assert record["results"] == {"kl": [1.0, None], "n": 3, "table": [[1, 2], [3, 4]]}
    assert (record["parameters"], record["versions"]) == ({"seed": 0}, records.versions())
    assert (record["settings"], record["source"]) == (records.settings_of(settings), source_hash())
    assert record["settings"]["airl"]["ppo"]["learning_rate"] == 1e-4, "every number that made the record"
    assert np.array_equal(loaded["a"], tensors["a"])
    assert "[1, 2]" in path.read_text(), "a list a line"
    with pytest.raises(InputError, match=r"s\.json: cannot be read"):
        load_record("s", tmp_path)
    (tmp_path / "r.safetensors").write_bytes(b"cut")
    with pytest.raises(InputError, match=r"expected a record and its \.safetensors file"):
        load_record("r", tmp_path)


def test_a_field_that_a_record_does_not_know_counts_as_its_default():
    settings, same = DMSRDSettings(kl_margin=0.7), records.same_settings
    told = records.settings_of(settings)
    assert same(told, settings)
    assert not same(told, DMSRDSettings())
    assert not same(told | {"gone": 1}, settings), "what no field is called any more"
    del told["airl"]["growth"]
    assert same(told, settings)
    assert not same(told, replace(settings, airl=replace(settings.airl, growth=1.1)))
    assert not same([told], settings)
    assert same([told, 1], (settings, 1))
    assert not same([told], (settings, 1))


def test_a_record_of_one_form_outlives_a_change_of_the_other():
    lesson = presets.choose("08_lifelong_100", "inverted_pendulum", "full")
    told = records.settings_of(lesson.of("ours"))
    other, own = (replace(form, kl_margin=9.0) for form in (lesson.printed, lesson.ours))
    assert records.same_settings(told, replace(lesson, printed=other).of("ours"))
    assert not records.same_settings(told, replace(lesson, ours=own).of("ours"))
    assert not records.same_settings(told, lesson.of("as printed"))


SOURCE = '''"""A module."""


class A:
    """A class."""

    def twice(self, x):
        """Twice."""
        return 2 * x
'''
REWRITTEN = (
    SOURCE.replace('"""A', '"""Another').replace("Twice.", "").replace("2 * x", "(2\n   * x)  # twice")
)


@pytest.fixture
def package(tmp_path):
    """A package with the deciding parts of this one, and figures beside them."""
    for part in (*DECIDING, "workbook/figures.py"):
        path = tmp_path / part if part.endswith(".py") else tmp_path / part / "module.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(SOURCE)
    return tmp_path


@pytest.mark.parametrize("part", DECIDING)
def test_code_counts_and_what_is_written_about_it_does_not(part, package):
    path, before = (
        package / part if part.endswith(".py") else package / part / "module.py",
        source_hash(package=package),
    )
    path.write_text(REWRITTEN)
    assert source_hash(package=package) == before
    path.write_text(SOURCE.replace("2 * x", "3 * x"))
    assert source_hash(package=package) != before


def test_figures_do_not_count_a_new_module_does(package):
    before = source_hash(package=package)
    (package / "workbook" / "figures.py").write_text("x = 1\n")
    assert source_hash(package=package) == before
    (package / "method" / "another.py").write_text("x = 1\n")
    assert source_hash(package=package) != before


def test_cells_count_and_magics_are_accepted(package):
    found = source_hash(["x = 1", "%time y = 2\n!ls"], package)
    assert source_hash(["x = 1  # one", "%time y = 2\n!ls"], package) == found
    others = [[], ["x = 2", "%time y = 2\n!ls"], ["x = 1", "%time y = 3\n!ls"]]
    assert len({found, *(source_hash(cells, package) for cells in others)}) == 4


def test_every_deciding_part_is_there():
    assert all((records.PACKAGE / part).exists() for part in DECIDING)
