"""Every record: its form, and the settings that made it."""

import pytest
from records import stored

from dmsrd_lite.workbook.records import RECORDS


def holding(settings, key):
    """The settings, or those within them, that hold ``key``."""
    found = [holding(value, key) for value in settings.values() if isinstance(value, dict)]
    return settings if key in settings else next(filter(None, found), None)


@pytest.mark.parametrize("name", sorted(path.stem for path in RECORDS.glob("*.json")))
def test_a_record_is_small_and_says_what_made_it(name):
    record, _ = stored.record_of(name)
    assert record["name"] == name
    assert {"domain", "preset", "seed"} <= set(record["parameters"])
    assert {"torch", "mujoco", "python"} <= set(record["versions"])
    assert holding(record["settings"], "discriminator_rate")["ppo"]["learning_rate"] > 0
    assert (RECORDS / f"{name}.safetensors").stat().st_size < 1_000_000
