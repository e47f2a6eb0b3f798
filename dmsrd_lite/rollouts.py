"""Rollouts of many policies in many environments at once: one simulator call per time step for all of them."""

import multiprocessing
import os
import signal
import sys
import threading
import types
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields
from functools import cache

import cloudpickle
import numpy as np

from dmsrd_lite.envs import Domain
from dmsrd_lite.networks import gaussian_log_density

simulated = {"steps": 0}  # environment steps of this process so far, for ``runs.hand_over``; decides nothing


@dataclass
class Rollouts:
    """Episodes of M policies, E each, T steps.

    observations (M, E, T+1, obs_dim) raw; actions (M, E, T, action_dim) as sampled (``domain.clip_action`` gives the
    executed ones); log_densities (M, E, T) of the sampled actions; rewards (M, E, T) up to and including the step at which
    the task as others run it is over, then 0; rewards_every_step (M, E, T) as the simulator pays them; reset_seeds (M, E).
    """

    domain: Domain
    observations: np.ndarray
    actions: np.ndarray
    log_densities: np.ndarray
    rewards: np.ndarray
    reset_seeds: np.ndarray
    rewards_every_step: np.ndarray

    @property
    def executed_actions(self) -> np.ndarray:
        return self.domain.clip_action(self.actions)

    @property
    def returns(self) -> np.ndarray:
        """Undiscounted return of each episode, (M, E)."""
        return self.rewards.sum(-1)

    @property
    def failed(self) -> np.ndarray:
        """Does the task fail at this step? (M, E, T) bool."""
        return self.domain.failed(self.observations[:, :, 1:], self.rewards)

    @property
    def n_steps(self) -> int:
        return self.rewards.size

    def select_episodes(self, indices: np.ndarray) -> "Rollouts":
        """The episodes ``indices`` (M, k) of each policy, in that order."""
        rows, arrays = np.arange(len(indices))[:, None], (getattr(self, f.name) for f in fields(self)[1:])
        return Rollouts(self.domain, *(array[rows, indices] for array in arrays))


def draw_reset_seeds(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.integers(0, 2**31 - 1, shape)


def _simulate(domain: Domain, actor, reset_seeds: np.ndarray, noise: np.ndarray, n_threads: int) -> tuple[np.ndarray, ...]:
    """Episodes from reset_seeds (M, e) with action noise (T, M, e, a): observations, actions, rewards, ended, time first."""
    (t_end, m, e, _), batch = noise.shape, domain.make_batch(reset_seeds.size, n_threads)
    observations, actions = np.empty((t_end + 1, m, e, domain.obs_dim)), np.empty_like(noise)
    rewards, ended = np.empty((t_end, m, e)), np.empty((t_end, m, e), dtype=bool)
    observations[0] = batch.reset(reset_seeds.ravel()).reshape(m, e, -1)
    for t in range(t_end):
        actions[t] = actor.mean(observations[t]) + noise[t]
        state, reward, over = batch.step(domain.clip_action(actions[t]).reshape(m * e, -1))
        observations[t + 1], rewards[t], ended[t] = state.reshape(m, e, -1), reward.reshape(m, e), over.reshape(m, e)
    return observations, actions, rewards, ended


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the caller's business
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()  # no worker outlives a killed program


@cache
def _workers(n: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(n, multiprocessing.get_context("spawn"), _start_worker)


def _call(pickled: bytes):
    function, *arguments = cloudpickle.loads(pickled)
    return function(*arguments)


def _in_workers(n: int, jobs: list[tuple]) -> list:
    """``_simulate`` of every job on ``n`` worker processes, which are kept for the next call and end with the program."""
    pickled = [cloudpickle.dumps((_simulate, *job)) for job in jobs]
    main = sys.modules["__main__"]
    try:
        try:
            sys.modules["__main__"] = types.ModuleType("__main__")  # a new worker would import the caller's script, and run it
            futures = [_workers(n).submit(_call, job) for job in pickled]
        finally:
            sys.modules["__main__"] = main
        return [future.result() for future in futures]
    except BrokenProcessPool:
        _workers.cache_clear()
        raise RuntimeError(
            "a simulator process ended before its rollouts were done; expected it to live: was it killed, or is the memory full?"
        ) from None


def rollout(domain: Domain, actor, n_episodes: int, seed, *, reset_seeds=None, horizon: int = 0, n_threads: int = 0) -> Rollouts:
    """Simulate ``n_episodes`` of every policy of ``actor`` (anything with ``mean``, ``sigma``, ``n_strategies``).

    ``a_t = mu_j(s_t) + sigma_j eps_t``; executed is ``clip(a_t)``. ``seed`` (int or list of ints) fixes starts and
    action noise; ``reset_seeds`` (M, E) fixes the starts alone. ``horizon`` 0 means the domain's own.
    The same seed gives the same bits for any ``n_threads`` (worker processes where the domain needs them; 0: all cores).
    """
    rng = np.random.default_rng(seed)
    m, e, t_end = actor.n_strategies, n_episodes, horizon or domain.horizon
    drawn = draw_reset_seeds(rng, m, e)
    reset_seeds = drawn if reset_seeds is None else np.asarray(reset_seeds)
    noise = rng.standard_normal((t_end, m, e, domain.action_dim), dtype=np.float32)
    log_densities = gaussian_log_density(noise, np.float32(0), np.float32(1)) - np.log(actor.sigma).sum(-1)
    noise *= actor.sigma
    # Always the same two halves, so that the bits are too; on two threads one half acts while the other is simulated.
    halves = [slice(0, e // 2), slice(e // 2, e)] if e > 1 and m * e >= 8 else [slice(0, e)]
    threads = n_threads or os.cpu_count() or 1
    n = min(threads, len(halves))
    each = max(1, min(threads // len(halves), m * e // 16))  # the simulator's own threads
    jobs = [(domain, actor, reset_seeds[:, some], noise[:, :, some], each) for some in halves]
    if domain.in_processes and n > 1:
        parts = _in_workers(n, jobs)
    else:
        with ThreadPoolExecutor(1 if domain.in_processes else n) as pool:
            parts = list(pool.map(lambda job: _simulate(*job), jobs))
    joined = (np.concatenate(arrays, axis=2) for arrays in zip(*parts, strict=True))
    observations, actions, rewards, ended = (np.moveaxis(array, 0, 2) for array in joined)
    simulated["steps"] += rewards.size
    over_before = (ended.cumsum(2) - ended) > 0
    paid_once = np.where(over_before, 0.0, rewards)
    return Rollouts(domain, observations, actions, np.moveaxis(log_densities, 0, 2), paid_once, reset_seeds, rewards)
