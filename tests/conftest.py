import matplotlib
import pytest
from helpers import untrained_set

from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER

matplotlib.use("Agg")


def pytest_collection_modifyitems(items):
    """Lessons first: the longest must not be the last, when only one of two workers has anything to do."""
    items.sort(key=lambda item: item.get_closest_marker("lesson") is None)


@pytest.fixture
def domain():
    return INVERTED_PENDULUM


@pytest.fixture
def small_set(domain):
    return untrained_set(domain)


@pytest.fixture
def lander_set():
    return untrained_set(LUNAR_LANDER)
