import numpy as np
import pytest

from dmsrd_lite.divergence import demonstration_divergence, divergence_table, knn_divergence, own_divergence, trajectory_divergences
from dmsrd_lite.envs import LUNAR_LANDER


def gaussian_kl(shift, width, d):
    """``D_KL(N(0, I) || N(shift, width^2 I))`` in nats."""
    return d * 0.5 * (np.log(width**2) + (1 + shift**2) / width**2 - 1)


@pytest.mark.parametrize(("d", "shift", "width"), [(1, 1.0, 1.0), (2, 0.8, 1.3), (4, 0.5, 1.0), (4, 0.6, 1.4), (6, 0.5, 1.2)])
def test_overlapping_gaussians_within_15_percent(d, shift, width):
    rng = np.random.default_rng(0)
    estimate = knn_divergence(rng.normal(0, 1, (20000, d)), rng.normal(shift, width, (20000, d)))
    assert estimate == pytest.approx(gaussian_kl(shift, width, d), rel=0.15)


def test_equal_distributions_are_at_zero():
    rng = np.random.default_rng(0)
    assert abs(knn_divergence(rng.normal(size=(5000, 4)), rng.normal(size=(5000, 4)))) < 0.1


def test_collapsed_rollout_grows_with_n_and_stays_below_the_truth():
    rng = np.random.default_rng(0)
    truth = gaussian_kl(0.0, 0.3, 4)
    estimates = [knn_divergence(rng.normal(0, 1, (n, 4)), rng.normal(0, 0.3, (n, 4))) for n in (1000, 3000, 20000)]
    assert 1.0 < estimates[0] < estimates[1] < estimates[2] < truth


def test_by_hand():
    """p = {0, 1, 3}, q = {0.5, 5}, k = 1: nu = 0.5, 0.5, 2 and rho = 1, 1, 2."""
    p, q = np.array([[0.0], [1.0], [3.0]]), np.array([[0.5], [5.0]])
    truth = np.mean(np.log([0.5, 0.5, 2.0]) - np.log([1.0, 1.0, 2.0])) + np.log(2 / 2)
    assert knn_divergence(p, q, k=1) == pytest.approx(truth)


def test_direction_expert_is_queried():
    """A rollout that misses half of the demonstration is far; one that covers it and more is near."""
    rng = np.random.default_rng(0)
    wide, narrow = rng.uniform(0, 2, (3000, 1)), rng.uniform(0, 1, (3000, 1))
    assert knn_divergence(narrow, wide) == pytest.approx(np.log(2), abs=0.1)
    assert knn_divergence(wide, narrow) > 2.0


def test_resolution_floors_repeated_states():
    rng = np.random.default_rng(0)
    landed = np.concatenate([rng.normal(size=(300, 2)), np.zeros((700, 2))])
    assert np.isfinite(knn_divergence(landed, landed + 1e-6))
    assert abs(knn_divergence(landed, landed + 1e-6, resolution=1e-2)) < 1.0


def test_tables_are_made_of_the_single_estimate(domain):
    rng = np.random.default_rng(0)
    sets = rng.normal(size=(2, 3, 101, 4)) + np.array([0.0, 1.0])[:, None, None, None]
    pairs = trajectory_divergences(domain, sets[0], sets[1])
    assert pairs[1, 2] == pytest.approx(knn_divergence(sets[0, 1, 1:], sets[1, 2, 1:]))
    assert demonstration_divergence(domain, sets[0], sets[1]) == pytest.approx(pairs.mean())
    table = divergence_table(domain, sets)
    assert table[0, 1] == pytest.approx(pairs.mean())
    own = trajectory_divergences(domain, sets[0], sets[0])
    assert table[0, 0] == own_divergence(domain, sets[0]) == pytest.approx((own.sum() - np.trace(own)) / 6)


def test_with_matched_starts_trajectories_are_pooled():
    rng = np.random.default_rng(0)
    shown, flown = rng.normal(size=(3, 41, 8)), rng.normal(0.3, size=(6, 41, 8))
    shown[..., 6:] = flown[..., 6:] = 0.0
    flown[3:, :, 6:] = 100.0  # the legs' contacts must not count
    pooled, first, second = (part[:, 1:, :6].reshape(-1, 6) for part in (shown, flown[:3], flown[3:]))
    by_hand = (knn_divergence(pooled, first, resolution=0.01) + knn_divergence(pooled, second, resolution=0.01)) / 2
    assert demonstration_divergence(LUNAR_LANDER, shown, flown) == pytest.approx(by_hand)
    assert demonstration_divergence(LUNAR_LANDER, shown, flown[:3]) == pytest.approx(knn_divergence(pooled, first, resolution=0.01))
