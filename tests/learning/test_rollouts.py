"""Rollouts: what a seed fixes, and the worker processes of simulators that hold Python's lock."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from dmsrd_lite.domains import DOMAINS, LUNAR_LANDER
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout

ACTOR = GaussianPolicies(LUNAR_LANDER, 4, 0).actor()


def flights(actor=ACTOR, n_threads=2):
    return rollout(LUNAR_LANDER.on_threads(n_threads), actor, 2, 0, horizon=20).observations


@pytest.mark.parametrize("domain", DOMAINS.values(), ids=lambda d: d.name)
def test_same_seed_same_bits_for_any_number_of_threads_or_processes(domain):
    actor = GaussianPolicies(domain, 4, 0).actor()
    one, two, usual = (rollout(domain.on_threads(n), actor, 4, 1, horizon=60) for n in (1, 2, 0))
    for name in ("observations", "actions", "log_densities", "rewards", "rewards_every_step"):
        assert all(np.array_equal(getattr(one, name), getattr(again, name)) for again in (two, usual)), name
    assert one.n_steps == 4 * 4 * 60
    other = rollout(domain, actor, 4, 2, horizon=60)
    assert not np.array_equal(one.observations, other.observations)


def test_a_rollout_by_its_definition(domain):
    """Actions are means and noise, with the density of what is sampled; reset seeds fix the start alone."""
    actor, seeds = GaussianPolicies(domain, 2, 0, sigma=2.0).actor(), np.array([[11, 12, 13], [14, 15, 16]])
    data, again = (rollout(domain, actor, 3, s, reset_seeds=seeds, horizon=20) for s in (0, 1))
    states, actions = data.observations[:, :, :-1].reshape(2, 60, 4), data.actions.reshape(2, 60, 1)
    assert np.allclose(data.log_densities, actor.log_density(states, actions).reshape(2, 3, 20), atol=1e-4)
    assert np.abs(data.actions).max() > 3 == np.abs(data.executed_actions).max()
    assert np.array_equal(data.observations[:, :, 0], again.observations[:, :, 0])
    assert not np.array_equal(data.observations[:, :, 5], again.observations[:, :, 5])
    some = data.select_episodes(np.array([[2, 0], [1, 1]]))
    assert np.array_equal(some.observations[0], data.observations[0, [2, 0]])
    assert np.array_equal(some.reset_seeds, [[13, 11], [15, 15]])


NOTEBOOK = """
import os
import numpy as np

class NotebookActor:
    n_strategies, sigma = 4, np.full((4, 1, 2), 0.1, np.float32)

    def __init__(self, ends_in_workers):
        self.only = os.getpid() if ends_in_workers else 0

    def mean(self, observations):
        if self.only not in (0, os.getpid()):
            os._exit(1)
        return np.zeros((*observations.shape[:2], 2), np.float32)
"""


@pytest.fixture
def notebook_actor():
    """A class that a reader writes in a notebook: workers cannot import it."""
    exec(NOTEBOOK, namespace := {"__name__": "__main__"})
    return namespace["NotebookActor"]


def test_workers_take_a_class_that_they_cannot_import(notebook_actor):
    assert np.array_equal(*(flights(notebook_actor(False), n) for n in (1, 2)))


def workers():
    """The processes that simulate for this one."""
    children = psutil.Process().children()
    return {child.pid for child in children if "loky.backend.popen_loky_posix" in child.cmdline()}


@pytest.mark.verify
def test_workers_are_kept_and_a_dead_one_is_reported_and_replaced(notebook_actor):
    before, first = flights(), workers()
    assert len(first) == 2
    assert np.array_equal(flights(), before)
    assert workers() == first, "the same processes must serve the next call"
    with pytest.raises(
        RuntimeError, match=r"^a simulator process ended before its rollouts were done; expected"
    ):
        flights(notebook_actor(True))
    assert np.array_equal(flights(), before)
    assert workers().isdisjoint(first)
    os.kill(min(workers()), signal.SIGKILL)
    with contextlib.suppress(RuntimeError):  # whether this call notices, or the death was noticed before it
        flights()
    assert np.array_equal(flights(), before)


SCRIPT = """
import os, signal, sys
import psutil
from dmsrd_lite.domains import LUNAR_LANDER
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
rollout(LUNAR_LANDER.on_threads(2), GaussianPolicies(LUNAR_LANDER, 4, 0).actor(), 2, 0, horizon=20)
children = psutil.Process().children()
print(*[p.pid for p in children if "loky.backend.popen_loky_posix" in p.cmdline()], flush=True)
if sys.argv[1] == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.verify
@pytest.mark.parametrize("end", ["normal", "killed"])
def test_workers_end_with_the_program(end, tmp_path):
    """A script without ``if __name__ == "__main__"``, which spawned workers must not run again."""
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run([sys.executable, tmp_path / "script.py", end], capture_output=True, text=True)
    processes = [int(p) for p in done.stdout.split()]
    assert len(processes) == 2, done.stderr
    until = time.monotonic() + 30
    while alive := [p for p in processes if psutil.pid_exists(p) and psutil.Process(p).status() != "zombie"]:
        assert time.monotonic() < until, alive
        time.sleep(0.1)
