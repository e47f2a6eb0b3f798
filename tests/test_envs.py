import gymnasium
import numpy as np
import pytest

from dmsrd_lite.envs import InputError, PendulumBatch, check_seed, get_domain
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.rollouts import rollout


def test_pendulum_equals_gymnasium_to_the_last_bit():
    rng = np.random.default_rng(3)
    actions = rng.uniform(-3, 3, (1000, 3, 1))
    batch = PendulumBatch(3, 2)
    start = batch.reset(np.array([5, 6, 7]))
    ours = np.array([np.concatenate([s, -r[:, None]], 1) for s, r in (batch.step(a) for a in actions)])
    assert np.abs(ours[:, :, 1]).max() > 1.5, "the poles must have fallen, so that the stops are tested too"
    assert np.array_equal(ours[:, :, 4], np.abs(ours[:, :, 1]))
    env = gymnasium.make("InvertedPendulum-v5").unwrapped
    for i, seed in enumerate((5, 6, 7)):
        observation, _ = env.reset(seed=seed)
        assert np.array_equal(observation, start[i]), "a reset seed must mean the same start as in Gymnasium"
        for t in range(1000):
            observation = env.step(actions[t, i])[0]
            assert np.array_equal(observation, ours[t, i, :4]), f"environment {i}, step {t}"


def test_same_seed_same_bits_for_any_number_of_threads(domain):
    actor = GaussianPolicies(domain, 3, 0).actor()
    one, two, other = (rollout(domain, actor, 4, seed, horizon=200, n_threads=n) for seed, n in ((1, 1), (1, 2), (2, 2)))
    assert np.array_equal(one.observations, two.observations)
    assert np.array_equal(one.actions, two.actions)
    assert not np.array_equal(one.observations, other.observations)


def test_nothing_ends_early_and_reward_is_of_the_new_state(domain):
    data = rollout(domain, GaussianPolicies(domain, 1, 0).actor(), 3, 0)
    assert data.rewards.shape == (1, 3, domain.horizon)
    assert np.array_equal(data.rewards, -np.abs(data.observations[:, :, 1:, 1]))
    assert data.returns.max() < -1000


def test_reset_seeds_fix_the_start_and_not_the_noise(domain):
    actor = GaussianPolicies(domain, 1, 0).actor()
    seeds = np.array([[11, 12]])
    a, b = (rollout(domain, actor, 2, s, reset_seeds=seeds, horizon=20) for s in (0, 1))
    assert np.array_equal(a.observations[:, :, 0], b.observations[:, :, 0])
    assert not np.array_equal(a.observations[:, :, 5], b.observations[:, :, 5])


def test_frame_shows_the_state(domain):
    upright, fallen = (domain.draw_frame(np.array([0.0, angle, 0, 0])) for angle in (0.0, 1.5))
    assert upright.shape == fallen.shape
    assert upright.dtype == np.uint8
    pole = np.array([213, 94, 0])
    rows = [np.flatnonzero((np.abs(f.astype(int) - pole).sum(-1) < 30).any(1)) for f in (upright, fallen)]
    assert rows[0].min() < rows[1].min() - 20, "an upright pole reaches higher in the picture than a fallen one"


def test_unknown_domain_and_bad_seed():
    with pytest.raises(InputError, match=r"unknown domain 'cartpole': expected one of inverted_pendulum"):
        get_domain("cartpole")
    for bad in ("1.5", "x", -1, None):
        with pytest.raises(InputError, match="expected a whole number"):
            check_seed(bad)
    assert check_seed("7") == 7
