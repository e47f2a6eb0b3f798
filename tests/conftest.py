import matplotlib
import numpy as np
import pytest

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.envs import INVERTED_PENDULUM, LUNAR_LANDER
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.rollouts import rollout

matplotlib.use("Agg")


@pytest.fixture
def domain():
    return INVERTED_PENDULUM


def untrained_set(domain):
    """Two demonstrations of two trajectories and 50 steps, by untrained policies."""
    actor = GaussianPolicies(domain, 2, 0).actor()
    data = rollout(domain, actor, 2, 0, horizon=50)
    likelihoods = np.zeros((2, 2))
    return DemonstrationSet(domain, data.observations, data.executed_actions, data.rewards, np.arange(2), data.reset_seeds, likelihoods)


@pytest.fixture
def small_set(domain):
    return untrained_set(domain)


@pytest.fixture
def lander_set():
    return untrained_set(LUNAR_LANDER)


def assert_decisions_follow(records, n_strategies):
    """Every recorded decision of Algorithm 1 is the one that its own numbers ask for."""
    known = 0
    for r in records:
        if known and r["kl_mix"] <= r["threshold"]:
            assert (r["branch"], r["steps"]["airl"]) == ("mixture", 0)
        elif known and r["kl_mix"] < r["kl_new"]:
            assert r["branch"] == "mixture, better than a new strategy"
        else:
            assert r["branch"] == "new strategy"
            known += 1
        assert r["n_strategies"] == known
    assert known == n_strategies
