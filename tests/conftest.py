import matplotlib
import pytest
from helpers import untrained_set

from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER

matplotlib.use("Agg")


@pytest.fixture
def domain():
    return INVERTED_PENDULUM


@pytest.fixture
def small_set(domain):
    return untrained_set(domain)


@pytest.fixture
def lander_set():
    return untrained_set(LUNAR_LANDER)
