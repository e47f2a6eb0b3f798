import numpy as np
import pytest

from dmsrd_lite.demonstrations import load_test_set
from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.demonstrators.reward_test_sets import AGAIN, generate_test_set, spread_moments
from dmsrd_lite.learning.policy_optimization import TrainingSettings


def test_moments_are_spread_over_failure_half_and_full_success():
    quality = np.repeat([0, 1, 2], [80, 4, 60])
    chosen = spread_moments(quality, 100)
    counts = np.bincount(quality[chosen])
    assert len(chosen) == 100
    assert (np.diff(chosen) >= 0).all()
    assert counts[1] == 4 * AGAIN, "the few moments of half success, again and again"
    assert counts.tolist() == [40, 20, 40]
    assert spread_moments(np.zeros(50, dtype=int), 5).tolist() == [0, 12, 24, 36, 49]


def test_a_test_set_holds_every_policy_at_every_moment(domain, tmp_path):
    training = TrainingSettings(n_strategies=2, n_iterations=3, episodes=1, first_horizon=20)
    settings = DiaynSettings(discriminator_steps=2, training=training)
    path = generate_test_set(
        domain, settings, 1, tmp_path / "test.npz", n_snapshots=2, n_episodes=2, stride=10
    )
    test = load_test_set(path, domain)
    assert test.observations.shape == (2 * 2 * 2, 100, 4)
    assert test.policy.tolist() == [0, 0, 1, 1] * 2
    assert test.snapshot.tolist() == [0] * 4 + [1] * 4
    assert np.allclose(test.returns, test.returns_every_step), "nothing ends on the pendulum"
    sampled = -np.abs(test.observations[:, :, 1]).mean(1) * domain.horizon
    assert np.allclose(sampled, test.returns, rtol=0.05), "every tenth state of the same trajectories"
    fallen = np.abs(test.observations[:, :, 1]) > 1.0
    assert (test.failed >= fallen).all(), "failed from the first failure on, and for good"
    assert (np.diff(test.failed, axis=1) >= 0).all()
    assert test.failed.mean() == pytest.approx(np.maximum.accumulate(fallen, 1).mean(), abs=0.05)
    assert (test.metadata["stride"], test.metadata["seed"]) == (10, 1)
    assert np.array(test.metadata["moments"]).shape == (2, 2)
