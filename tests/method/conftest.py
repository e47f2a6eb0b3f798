import pytest
import torch
from tiny import PENDULUM, TINY, three_users

from dmsrd_lite.method import dmsrd
from dmsrd_lite.method.state import State

torch.set_num_threads(1)  # faster for small networks


@pytest.fixture(scope="session")
def three():
    return three_users()


@pytest.fixture(scope="session")
def states(three):
    """What is known after none, one, two and three demonstrations, two strategies after the second."""
    found = [State(PENDULUM, 0), *dmsrd.learn(State(PENDULUM, 0), three, TINY)]
    assert found[2].n_strategies == 2
    return found
