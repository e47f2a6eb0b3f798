"""What several tests use. Fixtures stand in ``conftest.py``."""

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, RewardTestSet
from dmsrd_lite.domains import INVERTED_PENDULUM
from dmsrd_lite.learning.networks import Actor, GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout


def balancers(places, sigma=0.1):
    """Linear policies ``k . (s - (place, 0, 0, 0))``, k by an LQR: the cart balances at ``place`` (m)."""
    gain = np.array([0.741, 6.023, 0.868, 1.012]) * INVERTED_PENDULUM.observation_scale
    shift = -0.741 * np.array(places)[:, None, None]
    weights = np.tile(gain[None, :, None], (len(places), 1, 1)).astype(np.float32)
    return Actor(
        INVERTED_PENDULUM, [weights], [shift.astype(np.float32)], np.full_like(shift, sigma, np.float32)
    )


def shown_by(actor, horizon=60, seed=1):
    """One demonstration of two trajectories by every policy."""
    data = rollout(actor.domain, actor, 2, seed, horizon=horizon)
    arrays = data.observations, data.executed_actions, data.rewards, np.arange(actor.n_strategies)
    return DemonstrationSet(actor.domain, *arrays, data.reset_seeds)


def untrained_set(domain):
    """Two demonstrations of two trajectories and 50 steps, by untrained policies."""
    data = rollout(domain, GaussianPolicies(domain, 2, 0).actor(), 2, 0, horizon=50)
    arrays = data.observations, data.executed_actions, data.rewards, np.arange(2), data.reset_seeds
    return DemonstrationSet(domain, *arrays, np.zeros((2, 2)))


def make_truth(domain, n=30):
    """A test set for rewards whose return is a function of the states."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(n, 5, domain.obs_dim)) * rng.uniform(0, 1, (n, 1, 1))
    returns = -np.abs(states[..., 1]).sum(1)
    return RewardTestSet(domain, states.astype(np.float32), returns, np.zeros(n), np.zeros(n), {})


def assert_decisions_follow(records, n_strategies):
    """Every recorded decision of Algorithm 1 is the one that its own numbers ask for."""
    known = 0
    for r in records:
        if known and r["kl_mix"] < r["threshold"]:
            assert (r["branch"], r["steps"]["airl"]) == ("mixture", 0)
        elif known and r["kl_mix"] < r["kl_new"]:
            assert r["branch"] == "mixture, better than a new strategy"
        else:
            assert r["branch"] == "new strategy"
            known += 1
        assert r["n_strategies"] == known
    assert known == n_strategies
