import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from dmsrd_lite.envs import LUNAR_LANDER, InputError, PendulumBatch, check_seed, get_domain
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.rollouts import _workers, rollout


def test_pendulum_equals_gymnasium_to_the_last_bit():
    rng = np.random.default_rng(3)
    actions = rng.uniform(-3, 3, (1000, 3, 1))
    batch = PendulumBatch(3, 2)
    start = batch.reset(np.array([5, 6, 7]))
    ours = np.array([np.concatenate([s, -r[:, None]], 1) for s, r, _ in (batch.step(a) for a in actions)])
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


def test_lander_equals_gymnasium_and_goes_on():
    rng = np.random.default_rng(3)
    actions = rng.uniform(-1, 1, (500, 3, 2))
    batch = LUNAR_LANDER.make_batch(3, 1)
    start = batch.reset(np.array([5, 6, 7]))
    ours = [batch.step(a) for a in actions]
    env = gymnasium.make("LunarLander-v3", continuous=True).unwrapped
    for i, seed in enumerate((5, 6, 7)):
        assert np.array_equal(env.reset(seed=seed)[0], start[i]), "a reset seed must mean the same start as in Gymnasium"
        for t in range(500):
            observation, reward, ended, *_ = env.step(actions[t, i])
            assert np.array_equal(observation, ours[t][0][i])
            assert reward == ours[t][1][i]
            assert ended == ours[t][2][i]
    assert sum(over for _, _, over in ours).min() > 100, "the episodes must go on after their end, or this test says nothing"


@pytest.fixture(scope="module")
def wrecks():
    return rollout(LUNAR_LANDER, GaussianPolicies(LUNAR_LANDER, 4, 0).actor(), 4, 0)


def test_the_return_is_paid_once(wrecks):
    """By hand, episode by episode, with Gymnasium's own flag."""
    env = gymnasium.make("LunarLander-v3", continuous=True).unwrapped
    for m, e in ((0, 0), (3, 2)):
        env.reset(seed=int(wrecks.reset_seeds[m, e]))
        once, every_step, crashes, over = 0.0, 0.0, [], False
        for action in wrecks.executed_actions[m, e]:
            _, reward, ended, *_ = env.step(action)
            once += 0.0 if over else reward
            crashes.append(reward == -100 and not over)
            every_step, over = every_step + reward, over or ended
        assert wrecks.returns[m, e] == pytest.approx(once)
        assert wrecks.rewards_every_step[m, e].sum() == pytest.approx(every_step)
        assert wrecks.failed[m, e].tolist() == crashes
        assert sum(crashes) == 1
        assert LUNAR_LANDER.first_failure(wrecks.observations[m, e, 1:], wrecks.rewards[m, e]) == crashes.index(True)


def test_lander_bits_do_not_depend_on_the_processes(wrecks):
    actor = GaussianPolicies(LUNAR_LANDER, 4, 0).actor()
    for n in (1, 2):
        again = rollout(LUNAR_LANDER, actor, 4, 0, n_threads=n)
        for name in ("observations", "actions", "rewards", "rewards_every_step"):
            assert np.array_equal(getattr(again, name), getattr(wrecks, name)), (n, name)


class NotebookActor:
    """Stands for a class that a reader writes in a notebook: workers cannot import it."""

    n_strategies, sigma = 4, np.full((4, 1, 2), 0.1, np.float32)

    def mean(self, observations):
        return np.zeros((*observations.shape[:2], 2), np.float32)


def test_workers_take_a_class_that_they_cannot_import():
    NotebookActor.__module__ = "__main__"
    one, two = (rollout(LUNAR_LANDER, NotebookActor(), 2, 0, horizon=20, n_threads=n) for n in (1, 2))
    assert np.array_equal(one.observations, two.observations)


def test_workers_are_kept_and_a_dead_one_is_reported():
    actor = GaussianPolicies(LUNAR_LANDER, 4, 0).actor()

    def workers():
        return set(_workers(2)._processes)

    rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)
    first = workers()
    before = rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)
    assert workers() == first, "the same processes must serve the next call"
    os.kill(min(first), signal.SIGKILL)

    def until_noticed():
        for _ in range(100):  # the death may be noticed a moment later
            rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)

    with pytest.raises(RuntimeError, match=r"^a simulator process ended before its rollouts were done; expected it to live"):
        until_noticed()
    after = rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)
    assert workers().isdisjoint(first)
    assert np.array_equal(before.observations, after.observations)


SCRIPT = """
import os, signal, sys
from dmsrd_lite.envs import LUNAR_LANDER
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.rollouts import _workers, rollout
rollout(LUNAR_LANDER, GaussianPolicies(LUNAR_LANDER, 4, 0).actor(), 2, 0, horizon=20, n_threads=2)
print(*_workers(2)._processes, flush=True)
if sys.argv[1] == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("end", ["normal", "killed"])
def test_workers_end_with_the_program(end, tmp_path):
    """A script without ``if __name__ == "__main__"``, which spawned workers must not run again."""
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run([sys.executable, tmp_path / "script.py", end], capture_output=True, text=True, timeout=60)
    processes = [int(p) for p in done.stdout.split()]
    assert len(processes) == 2, done.stderr
    for _ in range(100):
        stats = [Path(f"/proc/{p}/stat") for p in processes]
        alive = [path for path in stats if path.exists() and " Z " not in path.read_text()]
        if not alive:
            break
        time.sleep(0.1)
    assert not alive


def test_a_worker_that_died_between_calls_is_reported_and_replaced():
    actor = GaussianPolicies(LUNAR_LANDER, 4, 0).actor()
    rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)
    pool = _workers(2)
    os.kill(min(pool._processes), signal.SIGKILL)
    for _ in range(100):
        if pool._broken:
            break
        time.sleep(0.1)
    with pytest.raises(RuntimeError, match=r"^a simulator process ended before its rollouts were done; expected it to live"):
        rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)
    rollout(LUNAR_LANDER, actor, 2, 0, horizon=20, n_threads=2)


def test_lander_frame_shows_the_state():
    high, low = (LUNAR_LANDER.draw_frame(np.array([0.0, y, 0, 0, 0, 0, 0, 0])) for y in (1.0, 0.0))
    body = [np.flatnonzero((f.astype(int).min(-1) > 240).any(1)) for f in (high, low)]
    assert high.shape == low.shape
    assert body[0].max() < body[1].min(), "a high lander is drawn above a low one"
