import gymnasium
import numpy as np
import pytest

from dmsrd_lite.domains import LUNAR_LANDER
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout


def test_equals_gymnasium_and_goes_on():
    actions = np.random.default_rng(3).uniform(-1, 1, (500, 3, 2))
    batch = LUNAR_LANDER.simulator.make_batch(3, 1)
    start = batch.reset(np.array([5, 6, 7]))
    ours = [batch.step(a) for a in actions]
    env = gymnasium.make("LunarLander-v3", continuous=True).unwrapped
    for i, seed in enumerate((5, 6, 7)):
        assert np.array_equal(env.reset(seed=seed)[0], start[i]), "a reset seed must mean the same start"
        for t in range(500):
            observation, reward, ended, *_ = env.step(actions[t, i])
            assert np.array_equal(observation, ours[t][0][i])
            assert (reward, ended) == (ours[t][1][i], ours[t][2][i])
    assert sum(over for _, _, over in ours).min() > 100, "they must go on after the end, or this says nothing"


def test_the_return_is_paid_once():
    """By hand, episode by episode, with Gymnasium's own flag."""
    wrecks = rollout(LUNAR_LANDER, GaussianPolicies(LUNAR_LANDER, 2, 0).actor(), 3, 0)
    env = gymnasium.make("LunarLander-v3", continuous=True).unwrapped
    for m, e in ((0, 0), (1, 2)):
        env.reset(seed=int(wrecks.reset_seeds[m, e]))
        once, every_step, crashes, over = 0.0, 0.0, [], False
        for action in wrecks.executed_actions[m, e]:
            _, reward, ended, *_ = env.step(action)
            once += 0.0 if over else reward
            crashes.append(reward == -100 and not over)
            every_step, over = every_step + reward, over or ended
        assert (wrecks.returns[m, e], wrecks.rewards_every_step[m, e].sum()) == (once, every_step)
        assert wrecks.failed[m, e].tolist() == crashes
        assert sum(crashes) == 1
        new_states = wrecks.observations[m, e, 1:]
        assert LUNAR_LANDER.first_failure(new_states, wrecks.rewards[m, e]) == crashes.index(True)


def test_frame_shows_the_state():
    high, low = (LUNAR_LANDER.drawing.frame(np.array([0.0, y, 0, 0, 0, 0, 0, 0])) for y in (1.0, 0.0))
    body = [np.flatnonzero((f.astype(int).min(-1) > 240).any(1)) for f in (high, low)]
    assert high.shape == low.shape
    assert body[0].max() < body[1].min(), "a high lander is drawn above a low one"


def test_a_pilot_is_described_by_side_time_and_lean():
    states = np.zeros((2, 501, 8))
    states[..., 0] = -0.3
    states[..., 1] = np.maximum(1.4 - 0.01 * np.arange(501), 0)
    states[:, 50, 4], states[:, 200:, 6] = -0.4, 1
    states[:, 300:, 4] = 2.0  # after the first touch: is not counted
    found = LUNAR_LANDER.diversity.describe(states)
    assert found["kind"] == "slow, from the left"
    assert (found["first touch (s)"], found["largest angle (rad)"]) == pytest.approx((4.0, 0.4))
    assert found["side (half widths)"] == pytest.approx(-0.3)
