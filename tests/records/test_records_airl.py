"""The recorded run of lesson 02, scored anew from the networks that it stored."""

import numpy as np
import pytest
import torch
from records import stored

from dmsrd_lite.domains import INVERTED_PENDULUM
from dmsrd_lite.evaluation.metrics import correlations_on, score_policies
from dmsrd_lite.learning.networks import GaussianPolicies, under
from dmsrd_lite.method.airl import Rewards
from dmsrd_lite.method.divergence import divergence_floor

pytestmark = pytest.mark.verify


@pytest.fixture
def results():
    return stored.record_of("02_airl_inverted_pendulum_seed0")[0]["results"]


def restored(module, name):
    tensors = under(name, stored.record_of("02_airl_inverted_pendulum_seed0")[1])
    module.load_state_dict({k: torch.tensor(v) for k, v in tensors.items()})
    return module


def test_airl_single_scores_as_recorded_and_as_claimed(results):
    shown, again = (
        stored.demonstrations("inverted_pendulum", kind) for kind in ("demonstrations", "second_take")
    )
    policies = restored(GaussianPolicies(INVERTED_PENDULUM, 10, 0), "single.policy")
    scores = score_policies(policies.actor(), shown, [0, 99])
    likelihood, recorded = scores["log_likelihood_per_step"], results["log_likelihood"]["AIRL Single"]
    assert likelihood == pytest.approx(recorded, abs=stored.LIKELIHOOD)
    assert scores["divergence"] == pytest.approx(results["kl"]["AIRL Single"], abs=stored.DIVERGENCE)
    floor = divergence_floor(shown, again)
    assert floor == pytest.approx(results["floor"], abs=stored.FLOOR)
    assert (scores["divergence"] <= floor + 1).sum() >= 9
    assert np.abs(likelihood - shown.log_likelihoods.mean(1) / shown.horizon).mean() <= 0.15
    assert scores["failure_share"].max() <= 0.05
    assert results["environment_steps"] <= 300_000


def test_airl_batch_reward_correlates_as_recorded(results):
    rewards = restored(Rewards(INVERTED_PENDULUM, 1, 0.99, [0]), "batch.reward")
    correlation = correlations_on(stored.rewards_test_set("inverted_pendulum"), rewards)[0]
    assert correlation == pytest.approx(results["correlation"]["AIRL Batch"], abs=stored.CORRELATION)
    assert correlation >= 0.9


def test_a_frozen_reward_teaches_fresh_policies(results):
    curves = np.array(results["fresh_curves"])
    assert curves.shape[1] == results["fresh_seeds"] == 10
    assert results["fresh_solved"] >= 8
    assert (np.median(curves[-15:], 0) > -0.06).sum() >= 8, (
        "curves end where the count says, single falls aside"
    )
