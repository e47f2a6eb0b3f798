import dataclasses

import numpy as np
import pytest

from dmsrd_lite.demonstrators import diayn
from dmsrd_lite.demonstrators.diayn import DiaynSettings, StrategyDiscriminator
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.policy_optimization import TrainingSettings
from dmsrd_lite.learning.rollouts import rollout

SHORT = TrainingSettings(n_strategies=2, n_iterations=2, episodes=1, first_horizon=20)
TINY = DiaynSettings(discriminator_steps=2, training=SHORT)


def test_discriminator_learns_separate_places_and_cannot_tell_what_is_alike():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(3, 500, 2)) * 0.1 + np.array([[-5.0, 0], [0, 5.0], [5.0, 0]])[:, None]
    q = StrategyDiscriminator(2, 3, DiaynSettings(discriminator_rate=1e-2), 0)
    for i in range(10):
        log_q, accuracy = q.update(features, i)
    assert accuracy > 0.95
    assert log_q.shape == (3, 500)
    assert np.exp(log_q).mean() > 0.9
    log_q, _ = StrategyDiscriminator(2, 2, DiaynSettings(), 0).update(rng.normal(size=(2, 2000, 2)), 0)
    assert np.exp(log_q).mean() == pytest.approx(0.5, abs=0.05)


def test_the_reward_as_written(domain):
    """``r + lambda (log q(z|s) - log 1/M)``, with q of the features in a population's units."""
    population, settings = domain.diversity.populations[1], dataclasses.replace(TINY, diversity_weight=0.7)
    data = rollout(domain, GaussianPolicies(domain, 2, 0).actor(), 3, 0, horizon=30)
    paid = diayn.DiversityReward(population, settings, 5)(data, 6)
    features = domain.diversity.features(data.observations) / population.feature_units
    log_q, _ = StrategyDiscriminator(2, 2, settings, [5, 2]).update(features.reshape(2, 90, 2), 6)
    assert np.allclose(paid, data.rewards + 0.7 * (log_q.reshape(2, 3, 30) - np.log(1 / 2)))
