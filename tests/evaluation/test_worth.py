from dataclasses import replace

import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.domains import LUNAR_LANDER, InputError
from dmsrd_lite.evaluation import worth
from dmsrd_lite.learning.policy_optimization import TrainingSettings
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.rewards import MeanRewards, Rewards

SHORT = TrainingSettings(n_strategies=3, n_iterations=6, episodes=8, first_horizon=20, growing=1e9)


class Upright:
    """The true reward, as a reward of the state."""

    def __init__(self, domain, sign):
        self.domain, self.sign = domain, sign

    def evaluate(self, observations, part="g"):
        return -self.sign * np.abs(observations[..., 1])[None]


def test_fresh_policies_follow_the_reward_that_they_are_given(domain):
    """Paid to stay upright they last, paid to fall they fall: with the same seed and the same training."""
    settings = replace(SHORT, n_iterations=25)
    good, bad = (worth.reward_worth(Upright(domain, sign), domain, settings, 0) for sign in (1, -1))
    assert good["curves"].shape == (25, 3)
    assert (good["curves"][-5:].mean(0) > bad["curves"][-5:].mean(0) + 0.02).all()
    assert (bad["failure_share"] == 1).all()


def test_the_same_seed_the_same_worth_and_no_true_reward(domain, monkeypatch):
    rewards = Rewards(domain, 1, 0.99, 0)
    one = worth.reward_worth(rewards, domain, SHORT, 3)
    again = worth.reward_worth(MeanRewards([rewards]), domain, SHORT, 3)
    assert np.array_equal(one["curves"], again["curves"])
    assert np.array_equal(one["environment_return"], again["environment_return"])


def test_who_can_do_the_task(domain):
    actor = balancers([0.0, 0.0], sigma=0.05)
    data = rollout(domain, actor, 5, 0)
    row = {"environment_return": data.returns.mean(1), "failure_share": data.failed.any(-1).mean(1)}
    assert worth.able(domain, row).all()
    assert worth.able(domain, {**row, "failure_share": [0.05, 0.0]}).tolist() == [False, True]
    flown = {"environment_return": [120.0, 90.0], "failure_share": [0.3, 0.0]}
    assert worth.able(LUNAR_LANDER, flown).tolist() == [True, False]


def test_a_reward_of_another_domain_is_a_sentence(domain):
    with pytest.raises(InputError, match=r"^a reward of lunar_lander; expected one of inverted_pendulum$"):
        worth.reward_worth(Rewards(LUNAR_LANDER, 1, 0.99, 0), domain, SHORT, 0)
