import dataclasses

import numpy as np
import pytest
from scipy.stats import norm, pearsonr

from dmsrd_lite import metrics
from dmsrd_lite.demonstrations import RewardTestSet, demonstrations_from
from dmsrd_lite.divergence import demonstration_divergence, own_divergence
from dmsrd_lite.envs import LUNAR_LANDER
from dmsrd_lite.metrics import (
    correlations_on,
    demonstration_log_likelihood,
    divergence_floor,
    policy_divergences,
    reward_correlation,
    score_policies,
)
from dmsrd_lite.networks import SIGMA_FLOOR, Actor, GaussianPolicies
from dmsrd_lite.rollouts import rollout


def test_log_likelihood_by_hand(small_set, domain):
    actor = GaussianPolicies(domain, 2, 0).actor()
    states, actions = small_set.observations[:, :, :50], small_set.actions
    by_hand = [0.0, 0.0]
    for j in (0, 1):
        for k in (0, 1):
            mean = actor.mean(np.repeat(states[j, k][None], 2, 0))[j]
            by_hand[j] += norm.logpdf(actions[j, k], mean, actor.sigma[j]).sum() / 2
    assert demonstration_log_likelihood(actor, small_set) == pytest.approx(by_hand, rel=1e-4)


def test_the_demonstrator_reaches_its_own_log_likelihood(domain):
    actor = GaussianPolicies(domain, 2, 0).actor()
    shown = demonstrations_from(rollout(domain, actor, 2, 0, horizon=50), actor)
    assert demonstration_log_likelihood(actor, shown) == pytest.approx(shown.log_likelihoods.mean(1), rel=1e-5)


def test_sigma_has_a_floor_in_the_likelihood(small_set, domain):
    actor = GaussianPolicies(domain, 2, 0).actor()
    narrow, floor = (Actor(domain, actor.weights, actor.biases, np.full((2, 1, 1), s, np.float32)) for s in (1e-6, SIGMA_FLOOR))
    assert np.array_equal(demonstration_log_likelihood(narrow, small_set), demonstration_log_likelihood(floor, small_set))


def test_floor_from_second_take_or_own_trajectories(small_set, domain):
    own = divergence_floor(small_set)
    assert own[1] == own_divergence(domain, small_set.observations[1])
    again = divergence_floor(small_set, small_set.select([1, 0]))
    assert again[0] == demonstration_divergence(domain, small_set.observations[0], small_set.observations[1])


def test_scores_are_those_of_the_rollouts(small_set, domain):
    actor = GaussianPolicies(domain, 2, 0).actor()
    scores = score_policies(actor, small_set, 5, n_rollouts=4, n_compared=3)
    data = rollout(domain, actor, 4, 5, horizon=50)
    assert scores["environment_return"] == pytest.approx(data.returns.mean(1))
    assert scores["divergence"][0] == demonstration_divergence(domain, small_set.observations[0], data.observations[0, :3])
    fell = (np.abs(data.observations[..., 1]) > 1).any(-1).mean(1)
    assert np.array_equal(scores["failure_share"], fell)


def test_policy_divergences_are_those_of_fresh_rollouts(small_set, domain):
    """Demonstration j against policy j, or the only demonstration against every policy."""
    actor, shown = GaussianPolicies(domain, 2, 0).actor(), small_set.observations
    made = rollout(domain, actor, 3, [4, 1], horizon=50).observations
    paired = policy_divergences(actor, small_set, [4, 1], n_rollouts=3)
    assert paired.tolist() == [demonstration_divergence(domain, shown[j], made[j]) for j in range(2)]
    only = policy_divergences(actor, small_set.select([1]), [4, 1], n_rollouts=3, n_threads=1)
    assert only.tolist() == [demonstration_divergence(domain, shown[1], made[j]) for j in range(2)]
    assert paired.tolist() != policy_divergences(actor, small_set, [4, 2], n_rollouts=3).tolist()


def test_correlation_of_a_part_of_the_reward(domain):
    states = np.random.default_rng(0).normal(size=(50, 7, 4))
    test = RewardTestSet(domain, states, -np.abs(states[..., 1]).mean(1), np.zeros(50), np.zeros(50), {})

    class Parts:
        def evaluate(self, observations, part="g"):
            truth = -np.abs(observations[..., 1])
            return {"task": truth[None], "g": np.stack([-truth, truth]), "total": np.stack([observations[..., 0]])}[part]

    assert correlations_on(test, Parts(), "task") == pytest.approx([1.0])
    assert correlations_on(test, Parts()) == pytest.approx([-1.0, 1.0])
    assert correlations_on(test, Parts(), "total") == pytest.approx([pearsonr(states[..., 0].mean(1), test.returns).statistic])


def test_correlation_is_pearsons(domain):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 50))
    assert reward_correlation(a, b) == pytest.approx(pearsonr(a, b).statistic)
    states = rng.normal(size=(50, 7, 4))
    test = RewardTestSet(domain, states, -np.abs(states[..., 1]).mean(1), np.zeros(50), np.zeros(50), {})

    class Truth:
        def evaluate(self, observations, part="g"):
            return np.stack([-np.abs(observations[..., 1]), np.abs(observations[..., 1])])

    assert correlations_on(test, Truth()) == pytest.approx([1.0, -1.0])


def test_lander_rollouts_start_as_the_demonstration_did(lander_set, monkeypatch):
    seen = []

    def watched(*arguments, **keywords):
        seen.append(rollout(*arguments, **keywords))
        return seen[-1]

    monkeypatch.setattr(metrics, "rollout", watched)
    actor = GaussianPolicies(LUNAR_LANDER, 2, 3).actor()
    divergences = policy_divergences(actor, lander_set, 0, n_rollouts=5)
    (data,) = seen
    assert data.reset_seeds.tolist() == np.tile(lander_set.reset_seeds, 2).tolist(), "5 rollouts of 2 starts: twice from each"
    assert np.array_equal(data.observations[:, :2, 0], lander_set.observations[:, :, 0])
    for j in (0, 1):
        assert divergences[j] == demonstration_divergence(LUNAR_LANDER, lander_set.observations[j], data.observations[j])
    policy_divergences(actor, lander_set.select([1]), 0, n_rollouts=1)
    assert seen[1].reset_seeds.tolist() == [lander_set.reset_seeds[1].tolist()] * 2, "one demonstration, two policies"
    with pytest.warns(UserWarning, match="hold no reset_seeds"):
        policy_divergences(actor, dataclasses.replace(lander_set, reset_seeds=None), 0)


def test_lander_scores_use_matched_starts_for_the_divergence_only(lander_set):
    actor = GaussianPolicies(LUNAR_LANDER, 2, 3).actor()
    scores = score_policies(actor, lander_set, 5, n_rollouts=4, n_compared=2)
    assert np.array_equal(scores["divergence"], policy_divergences(actor, lander_set, [5, 1], n_rollouts=2))
    free = rollout(LUNAR_LANDER, actor, 4, 5, horizon=50)
    assert np.array_equal(scores["environment_return"], free.returns.mean(1))
    assert np.array_equal(scores["failure_share"], free.failed.any(-1).mean(1))
