"""The metrics of every table by hand."""

import dataclasses

import numpy as np
import pytest
from helpers import make_truth
from scipy.stats import norm, pearsonr, spearmanr

from dmsrd_lite.demonstrations import RewardTestSet, demonstrations_from
from dmsrd_lite.domains import LUNAR_LANDER
from dmsrd_lite.evaluation import metrics
from dmsrd_lite.learning.networks import SIGMA_FLOOR, Actor, GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.divergence import demonstration_divergence, policy_divergences


@pytest.fixture
def actor(domain):
    return GaussianPolicies(domain, 2, 0).actor()


def test_log_likelihood_by_hand(small_set, domain, actor):
    states, actions, by_hand = small_set.observations[:, :, :50], small_set.actions, [0.0, 0.0]
    for j, k in np.ndindex(2, 2):
        mean = actor.mean(np.repeat(states[j, k][None], 2, 0))[j]
        by_hand[j] += norm.logpdf(actions[j, k], mean, actor.sigma[j]).sum() / 2
    assert metrics.demonstration_log_likelihood(actor, small_set) == pytest.approx(by_hand, rel=1e-4)
    own = demonstrations_from(rollout(domain, actor, 2, 0, horizon=50), actor)
    reached = metrics.demonstration_log_likelihood(actor, own)
    assert reached == pytest.approx(own.log_likelihoods.mean(1), rel=1e-5), "the demonstrator reaches its own"


def test_sigma_has_a_floor_in_the_likelihood(small_set, domain, actor):
    sigmas = (np.full((2, 1, 1), s, np.float32) for s in (1e-6, SIGMA_FLOOR))
    actors = [Actor(domain, actor.weights, actor.biases, sigma) for sigma in sigmas]
    narrow, floor = (metrics.demonstration_log_likelihood(some, small_set) for some in actors)
    assert np.array_equal(narrow, floor)


def test_scores_are_those_of_the_rollouts(small_set, domain, actor):
    scores = metrics.score_policies(actor, small_set, 5, n_rollouts=4, n_compared=3)
    data = rollout(domain, actor, 4, 5, horizon=50)
    assert scores["environment_return"] == pytest.approx(data.returns.mean(1))
    for j in (0, 1):
        by_hand = demonstration_divergence(domain, small_set.observations[j], data.observations[j, :3])
        assert scores["divergence"][j] == by_hand
    fell = (np.abs(data.observations[..., 1]) > 1).any(-1).mean(1)
    assert np.array_equal(scores["failure_share"], fell)
    each = metrics.demonstration_log_likelihood(actor, small_set) / 50
    assert np.array_equal(scores["log_likelihood_per_step"], each)


def test_lander_scores_use_matched_starts_for_the_divergence_only(lander_set):
    flown = dataclasses.replace(lander_set, domain=LUNAR_LANDER.on_threads(1))
    actor = GaussianPolicies(LUNAR_LANDER, 2, 3).actor()
    scores = metrics.score_policies(actor, flown, 5, n_rollouts=4, n_compared=2)
    assert np.array_equal(scores["divergence"], policy_divergences(actor, flown, [5, 1], n_rollouts=2))
    free = rollout(flown.domain, actor, 4, 5, horizon=50)
    assert np.array_equal(scores["environment_return"], free.returns.mean(1))
    assert np.array_equal(scores["failure_share"], free.failed.any(-1).mean(1))


def test_correlation_is_pearsons_of_each_part(domain):
    class Parts:
        def evaluate(self, observations, part="g"):
            truth = -np.abs(observations[..., 1])
            return np.stack({"task": [truth], "g": [-truth, truth], "total": [observations[..., 0]]}[part])

    test = make_truth(domain)
    assert metrics.correlations_on(test, Parts(), "task") == pytest.approx([1.0])
    assert metrics.correlations_on(test, Parts()) == pytest.approx([-1.0, 1.0])
    total = pearsonr(test.observations[..., 0].mean(1), test.returns).statistic
    assert metrics.correlations_on(test, Parts(), "total") == pytest.approx([total])
    assert np.isnan(metrics.reward_correlation(np.ones(30), test.returns)), (
        "the same everywhere knows nothing"
    )


def test_the_ceiling_is_what_a_state_reward_can_know(domain):
    known, test = make_truth(domain, 600), make_truth(domain, 600)
    held = dataclasses.replace(test, observations=test.observations[::-1], returns=test.returns[::-1])
    found = metrics.fit_reward(known, 0, 200)
    assert metrics.correlations_on(held, found)[0] > 0.95, "the return is a function of the states"
    noise = dataclasses.replace(known, returns=np.random.default_rng(1).normal(size=600))
    found = metrics.fit_reward(noise, 0, 100)
    assert abs(metrics.correlations_on(held, found)[0]) < 0.6, "nothing can be known about noise"


def test_three_correlations_tell_a_reward_that_only_knows_who_failed(domain):
    """Half of the set has failed: Pearson is near 1 for it, ranks among those who stand say nothing."""
    rng = np.random.default_rng(0)
    failed = np.repeat([1, 0], 50)[:, None] * np.ones((1, 5), dtype=int)
    returns = np.where(failed[:, 0], -1500.0, -rng.uniform(1, 60, 100))
    states = 0.3 * rng.normal(size=(100, 5, 4)).astype(np.float32)
    test_set = RewardTestSet(domain, states, returns, np.zeros(100), np.zeros(100), {}, failed=failed)
    knows_failure = metrics.one_line_rewards(test_set)["has not failed"]
    found = metrics.reward_correlations(test_set, knows_failure + 1e-6 * rng.normal(size=100))
    assert found.pearson > 0.99
    assert abs(found.spearman_of_good) < 0.3
    perfect = metrics.reward_correlations(test_set, returns**3)
    assert (perfect.spearman, perfect.spearman_of_good) == pytest.approx((1, 1))
    plain = metrics.reward_correlations(test_set, knows_failure)
    assert plain.spearman == pytest.approx(spearmanr(knows_failure, returns)[0])
    assert np.isnan(plain.spearman_of_good), "it is constant among those who stand"
    by_hand = spearmanr(knows_failure[50:] + states[50:, 0, 0], returns[50:])[0]
    assert metrics.reward_correlations(test_set, states[:, 0, 0]).spearman_of_good == pytest.approx(by_hand)
    unknown = dataclasses.replace(test_set, failed=None)
    assert np.isnan(metrics.reward_correlations(unknown, returns).spearman_of_good)
    x, whole = metrics.one_line_rewards(test_set)["-|x|"], metrics.one_line_rewards(test_set)["-|s|^2"]
    assert x == pytest.approx(-np.abs(states[..., 0]).mean(1))
    assert whole[3] == pytest.approx(
        -np.mean(np.sum((states[3] / domain.observation_scale) ** 2, 1)), rel=1e-5
    )


def test_the_authors_scores_by_hand(lander_set):
    """Their sigma, their floor, all trajectories together, and rewards on every step."""
    flown = dataclasses.replace(lander_set, domain=LUNAR_LANDER.on_threads(1))
    actor = GaussianPolicies(LUNAR_LANDER, lander_set.n_demonstrations, 3).actor()
    scores = metrics.published_scores(actor, flown, 5)
    data = rollout(flown.domain, actor, 20, 5, horizon=lander_set.horizon)
    assert np.array_equal(scores["published_return"], data.rewards_every_step.sum(-1).mean(1))
    for j, (observations, actions) in enumerate(
        zip(lander_set.observations, lander_set.actions, strict=True)
    ):
        total = 0.0
        for states, acted in zip(observations, actions, strict=True):
            mean = actor.select([j]).mean(states[None, :-1])[0]
            density = np.prod(
                np.exp(-(((acted - mean) / 0.0628) ** 2) / 2) / (0.0628 * np.sqrt(2 * np.pi)), -1
            )
            total += np.log(np.maximum(density, 1e-37)).sum()
        assert scores["published_log_likelihood"][j] == pytest.approx(total, rel=1e-5)
