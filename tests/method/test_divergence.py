from dataclasses import replace

import numpy as np
import pytest

from dmsrd_lite.domains import LUNAR_LANDER
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import divergence
from dmsrd_lite.method.divergence import demonstration_divergence, knn_divergence, own_divergence


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def gaussian_kl(shift, width, d):
    """``D_KL(N(0, I) || N(shift, width^2 I))`` in nats."""
    return d * 0.5 * (np.log(width**2) + (1 + shift**2) / width**2 - 1)


@pytest.mark.parametrize(
    ("d", "shift", "width"), [(1, 1.0, 1.0), (2, 0.8, 1.3), (4, 0.5, 1.0), (4, 0.6, 1.4), (6, 0.5, 1.2)]
)
def test_overlapping_gaussians_within_15_percent(d, shift, width, rng):
    estimate = knn_divergence(rng.normal(0, 1, (20000, d)), rng.normal(shift, width, (20000, d)))
    assert estimate == pytest.approx(gaussian_kl(shift, width, d), rel=0.15)


def test_collapsed_rollout_grows_with_n_and_stays_below_the_truth(rng):
    pairs = [(rng.normal(0, 1, (n, 4)), rng.normal(0, 0.3, (n, 4))) for n in (1000, 3000, 20000)]
    estimates = [knn_divergence(*pair) for pair in pairs]
    assert 1.0 < estimates[0] < estimates[1] < estimates[2] < gaussian_kl(0.0, 0.3, 4)


def test_by_hand():
    """With k = 1; in the plane the distance is along the farther axis."""
    p, q = np.array([[0.0], [1.0], [3.0]]), np.array([[0.5], [5.0]])  # nu = 0.5, 0.5, 2 and rho = 1, 1, 2
    truth = np.mean(np.log([0.5, 0.5, 2.0]) - np.log([1.0, 1.0, 2.0])) + np.log(2 / 2)
    assert knn_divergence(p, q, k=1) == pytest.approx(truth)
    p, q = np.array([[0.0, 0.0], [1.0, 4.0]]), np.array([[0.5, 1.0]])  # nu = 1, 3 and rho = 4, 4
    assert knn_divergence(p, q, k=1) == pytest.approx(np.log(1 / 4) + np.log(3 / 4) + np.log(1 / 1))


def test_direction_expert_is_queried(rng):
    """A rollout that misses half of the demonstration is far; one that covers it and more is near."""
    alike = rng.normal(size=(2, 5000, 4))
    assert abs(knn_divergence(*alike)) < 0.1
    wide, narrow = rng.uniform(0, 2, (3000, 1)), rng.uniform(0, 1, (3000, 1))
    assert knn_divergence(narrow, wide) == pytest.approx(np.log(2), abs=0.1)
    assert knn_divergence(wide, narrow) > 2.0


def test_resolution_floors_repeated_states(rng):
    landed = np.concatenate([rng.normal(size=(300, 2)), np.zeros((700, 2))])
    assert np.isfinite(knn_divergence(landed, landed + 1e-6))
    assert abs(knn_divergence(landed, landed + 1e-6, resolution=1e-2)) < 1.0


def test_tables_are_made_of_the_single_estimate(domain, rng):
    sets = rng.normal(size=(2, 3, 101, 4)) + np.array([0.0, 1.0])[:, None, None, None]
    pairs = divergence.trajectory_divergences(domain, sets[0], sets[1])
    assert pairs[1, 2] == pytest.approx(knn_divergence(sets[0, 1, 1:], sets[1, 2, 1:]))
    assert demonstration_divergence(domain, sets[0], sets[1]) == pytest.approx(pairs.mean())
    table = divergence.divergence_table(domain, sets)
    assert table[0, 1] == pytest.approx(pairs.mean())
    own = divergence.trajectory_divergences(domain, sets[0], sets[0])
    assert table[0, 0] == own_divergence(domain, sets[0]) == pytest.approx((own.sum() - np.trace(own)) / 6)
    assert np.isnan(own_divergence(domain, sets[0, :1]))


def test_with_matched_starts_trajectories_are_pooled(rng):
    shown, flown = rng.normal(size=(3, 41, 8)), rng.normal(0.3, size=(6, 41, 8))
    shown[..., 6:] = flown[..., 6:] = 0.0
    flown[3:, :, 6:] = 100.0  # the legs' contacts must not count
    pooled, *groups = (part[:, 1:, :6].reshape(-1, 6) for part in (shown, flown[:3], flown[3:]))
    by_hand = [knn_divergence(pooled, group, resolution=0.01) for group in groups]
    assert demonstration_divergence(LUNAR_LANDER, shown, flown) == pytest.approx(np.mean(by_hand))
    assert demonstration_divergence(LUNAR_LANDER, shown, flown[:3]) == pytest.approx(by_hand[0])


def test_floor_from_second_take_or_own_trajectories(small_set, domain):
    shown = small_set.observations
    assert divergence.divergence_floor(small_set).tolist() == [own_divergence(domain, one) for one in shown]
    again = divergence.divergence_floor(small_set, small_set.select([1, 0]))
    assert again[0] == demonstration_divergence(domain, shown[0], shown[1])


def test_policy_divergences_are_those_of_fresh_rollouts(small_set, domain):
    """Demonstration j against policy j, or the only demonstration against every policy."""
    actor, shown = GaussianPolicies(domain, 2, 0).actor(), small_set.observations
    made = rollout(domain, actor, 3, [4, 1], horizon=50).observations
    paired = divergence.policy_divergences(actor, small_set, [4, 1], n_rollouts=3)
    assert paired.tolist() == [demonstration_divergence(domain, shown[j], made[j]) for j in range(2)]
    only = replace(small_set.select([1]), domain=domain.on_threads(1))
    found = divergence.policy_divergences(actor, only, [4, 1], n_rollouts=3)
    assert found.tolist() == [demonstration_divergence(domain, shown[1], made[j]) for j in range(2)]
    assert paired.tolist() != divergence.policy_divergences(actor, small_set, [4, 2], n_rollouts=3).tolist()


def test_lander_rollouts_start_as_the_demonstration_did(lander_set, monkeypatch):
    seen, lander = [], LUNAR_LANDER.on_threads(1)
    given, actor = replace(lander_set, domain=lander), GaussianPolicies(lander, 2, 3).actor()
    monkeypatch.setattr(divergence, "rollout", lambda *a, **k: seen.append(rollout(*a, **k)) or seen[-1])
    found = divergence.policy_divergences(actor, given, 0, n_rollouts=3)
    starts, shown, made = given.reset_seeds, given.observations, seen[0].observations
    assert seen[0].reset_seeds.tolist() == np.tile(starts, 2).tolist(), "3 of 2 starts: twice from each"
    assert np.array_equal(made[:, :2, 0], shown[:, :, 0])
    assert found.tolist() == [demonstration_divergence(lander, shown[j], made[j]) for j in range(2)]
    divergence.policy_divergences(actor, given.select([1]), 0, n_rollouts=1)
    assert seen[1].reset_seeds.tolist() == [starts[1].tolist()] * 2, "one demonstration, two policies"
    with pytest.warns(UserWarning, match="hold no reset_seeds"):
        divergence.policy_divergences(actor, replace(given, reset_seeds=None), 0)
    assert seen[2].rewards.shape[1] == 10
    for n, data in zip((3, 1, 10), seen, strict=True):
        assert divergence.rollouts_measured(given, n) == data.rewards.shape[1]
