import gymnasium
import numpy as np
import pytest

from dmsrd_lite.domains.inverted_pendulum import CAP, OMEGA, PendulumBatch
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


def test_the_swing_speed_knows_nothing_of_the_place(domain):
    """Constant on a swing at the feature's own frequency, zero for who holds still, and bounded."""
    t = np.arange(0, 40, 0.04)
    swing = 0.2 * OMEGA * np.cos(OMEGA * t)
    states = np.zeros((3, len(t), 4))
    states[0, :, 0] = 0.7  # holds still
    states[1, :, 0], states[1, :, 2] = -0.5 + 0.2 * np.sin(OMEGA * t), swing
    states[1, :, 1] = -0.2 * OMEGA**2 * np.sin(OMEGA * t) / 9.81  # x'' = g theta
    states[2, :, 1] = 1.5  # has fallen
    place, speed = np.moveaxis(domain.diversity.features(states), -1, 0)
    assert np.array_equal(place, states[:, 1:, 0])
    assert np.allclose(speed[0], 0)
    assert np.allclose(speed[1], 0.2 * OMEGA)
    assert speed[2].max() == speed.max() == pytest.approx(CAP)


@pytest.mark.parametrize(
    ("amplitude", "period", "kind"),
    [(0.3, 3, "swinger"), (0.1, 2, "rocker"), (0.1, 20, "holder"), (0.4, 20, "drifter"), (0.02, 1, "holder")],
)
def test_kinds_are_computed_from_movement(domain, amplitude, period, kind):
    states = np.zeros((2, 1001, 4))
    states[..., 0] = 0.5 + amplitude * np.sin(2 * np.pi / period * 0.04 * np.arange(1001))
    found = domain.diversity.describe(states)
    assert found["kind"] == kind
    assert found["deviation of x (m)"] == pytest.approx(amplitude / np.sqrt(2), rel=0.1)
    assert found["mean x (m)"] == pytest.approx(0.5, abs=0.1)
    assert found["period (s)"] == pytest.approx(period, rel=0.25)
