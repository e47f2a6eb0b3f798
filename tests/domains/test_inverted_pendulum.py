import gymnasium
import numpy as np

from dmsrd_lite.domains.inverted_pendulum import PendulumBatch
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout


def test_equals_gymnasium_to_the_last_bit():
    actions = np.random.default_rng(3).uniform(-3, 3, (1000, 3, 1))
    batch = PendulumBatch(3, 2)
    start = batch.reset(np.array([5, 6, 7]))
    ours = np.array([np.concatenate([s, -r[:, None]], 1) for s, r, _ in (batch.step(a) for a in actions)])
    assert np.abs(ours[:, :, 1]).max() > 1.5, "the poles must have fallen, so that the stops are tested too"
    assert np.array_equal(ours[:, :, 4], np.abs(ours[:, :, 1]))
    env = gymnasium.make("InvertedPendulum-v5").unwrapped
    for i, seed in enumerate((5, 6, 7)):
        assert np.array_equal(env.reset(seed=seed)[0], start[i]), "a reset seed must mean the same start"
        for t in range(1000):
            assert np.array_equal(env.step(actions[t, i])[0], ours[t, i, :4]), f"environment {i}, step {t}"


def test_nothing_ends_early_and_reward_is_of_the_new_state(domain):
    data = rollout(domain, GaussianPolicies(domain, 1, 0).actor(), 3, 0)
    assert data.rewards.shape == (1, 3, domain.horizon)
    assert np.array_equal(data.rewards, -np.abs(data.observations[:, :, 1:, 1]))
    assert np.array_equal(data.failed, np.abs(data.observations[:, :, 1:, 1]) > 1)
    assert data.returns.max() < -1000


def test_frame_shows_the_state(domain):
    upright, fallen = (domain.drawing.frame(np.array([0.0, angle, 0, 0])) for angle in (0.0, 1.5))
    assert upright.shape == fallen.shape
    assert upright.dtype == np.uint8
    pole = np.array([213, 94, 0])
    rows = [np.flatnonzero((np.abs(f.astype(int) - pole).sum(-1) < 30).any(1)) for f in (upright, fallen)]
    assert rows[0].min() < rows[1].min() - 20, (
        "an upright pole reaches higher in the picture than a fallen one"
    )


def test_features_are_place_and_width_of_the_last_three_seconds(domain):
    states = np.zeros((1, 201, 4))
    states[0, :, 0] = np.where(np.arange(201) % 2, 0.3, 0.1)
    states[0, 100:, 0] = 0.5
    found = domain.diversity.features(states)
    assert found.shape == (1, 200, 2)
    assert found[0, [0, 98, 199]].tolist() == [[0.3, 0.3 - 0.1], [0.3, 0.3 - 0.1], [0.5, 0.0]]
