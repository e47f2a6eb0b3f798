"""Rollouts of many policies in many environments at once: one simulator call per time step for all."""

import os
import signal
import threading
import time
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
from threadpoolctl import threadpool_limits

from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import Policies, gaussian_log_density, one_thread


@dataclass
class Rollouts:
    """Episodes of M policies, E each, T steps.

    observations (M, E, T+1, obs_dim) raw; actions (M, E, T, action_dim) as sampled (``domain.clip_action``
    gives the executed ones); log_densities (M, E, T) of the sampled actions; rewards (M, E, T) up to and
    including the step at which the task as others run it is over, then 0; rewards_every_step (M, E, T) as the
    simulator pays them; reset_seeds (M, E).
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


def _simulate(
    domain: Domain, actor: Policies, reset_seeds: np.ndarray, noise: np.ndarray, n_threads: int
) -> tuple:
    """Episodes with action noise (T, M, e, a): observations, actions, rewards, ended, time first."""
    (t_end, m, e, _), batch = noise.shape, domain.simulator.make_batch(reset_seeds.size, n_threads)
    observations, actions = np.empty((t_end + 1, m, e, domain.obs_dim)), np.empty_like(noise)
    rewards, ended = np.empty((t_end, m, e)), np.empty((t_end, m, e), dtype=bool)
    observations[0] = batch.reset(reset_seeds.ravel()).reshape(m, e, -1)
    for t in range(t_end):
        actions[t] = actor.mean(observations[t]) + noise[t]
        state, reward, over = batch.step(domain.clip_action(actions[t]).reshape(m * e, -1))
        observations[t + 1], rewards[t], ended[t] = (
            state.reshape(m, e, -1),
            reward.reshape(m, e),
            over.reshape(m, e),
        )
    return observations, actions, rewards, ended


def _start_worker(parent: int) -> None:
    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)  # no worker outlives a killed program

    threadpool_limits(1)  # as in the caller (``one_thread``)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the caller's business
    threading.Thread(target=watch, daemon=True).start()


def _in_workers(n: int, jobs: list[tuple]) -> list:
    """``_simulate`` of every job on ``n`` worker processes, kept for the next call."""
    from loky import get_reusable_executor

    try:
        executor = get_reusable_executor(n, timeout=None, initializer=_start_worker, initargs=(os.getpid(),))
        return list(executor.map(_simulate, *zip(*jobs, strict=True)))
    except BrokenExecutor:
        raise RuntimeError(
            "a simulator process ended before its rollouts were done; expected it to live: "
            "was it killed, or is the memory full?"
        ) from None


@one_thread()
def rollout(
    domain: Domain,
    actor: Policies,
    n_episodes: int,
    seed: Seed,
    *,
    reset_seeds: np.ndarray | None = None,
    horizon: int = 0,
    common: bool = False,
) -> Rollouts:
    """Simulate ``n_episodes`` of every policy of ``actor``: ``a_t = mu_j(s_t) + sigma_j eps_t``, executed as
    ``clip(a_t)``.

    ``seed`` fixes starts and action noise; ``reset_seeds`` (M, E) fixes the starts alone. ``horizon`` 0 means
    the domain's own. ``common``: all policies meet the same starts and the same noise (common random
    numbers). The same seed gives the same bits however many threads or processes ``domain.simulator``
    uses.
    """
    rng = np.random.default_rng(seed)
    m, e, t_end = actor.n_strategies, n_episodes, horizon or domain.horizon
    n_draws = 1 if common else m
    drawn = draw_reset_seeds(rng, n_draws, e)
    reset_seeds = np.broadcast_to(drawn, (m, e)) if reset_seeds is None else np.asarray(reset_seeds)
    noise = rng.standard_normal((t_end, n_draws, e, domain.action_dim), dtype=np.float32)
    noise = np.repeat(noise, m, axis=1) if common else noise
    log_densities = gaussian_log_density(noise, np.float32(0), np.float32(1)) - np.log(actor.sigma).sum(-1)
    noise *= actor.sigma
    # Always the same two halves, and so the same bits; on two threads one acts while the other is simulated.
    halves = [slice(0, e // 2), slice(e // 2, e)] if e > 1 and m * e >= 8 else [slice(0, e)]
    threads = domain.simulator.n_threads or os.cpu_count() or 1
    n = min(threads, len(halves))
    each = max(1, min(threads // len(halves), m * e // 16))  # the simulator's own threads
    jobs = [(domain, actor, reset_seeds[:, some], noise[:, :, some], each) for some in halves]
    if domain.simulator.in_processes and n > 1:
        parts = _in_workers(n, jobs)
    else:
        with ThreadPoolExecutor(1 if domain.simulator.in_processes else n) as pool:
            parts = list(pool.map(_simulate, *zip(*jobs, strict=True)))
    joined = (np.concatenate(arrays, axis=2) for arrays in zip(*parts, strict=True))
    observations, actions, rewards, ended = (np.moveaxis(array, 0, 2) for array in joined)
    over_before = (ended.cumsum(2) - ended) > 0
    paid_once = np.where(over_before, 0.0, rewards)
    log_densities = np.moveaxis(log_densities, 0, 2)
    return Rollouts(domain, observations, actions, log_densities, paid_once, reset_seeds, rewards)
