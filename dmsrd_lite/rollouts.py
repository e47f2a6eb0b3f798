"""Rollouts of many policies in many environments at once: one simulator call per time step for all of them."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from dmsrd_lite.envs import Domain
from dmsrd_lite.networks import gaussian_log_density


@dataclass
class Rollouts:
    """Episodes of M policies, E each, T steps.

    observations (M, E, T+1, obs_dim) raw; actions (M, E, T, action_dim) as sampled (``domain.clip_action`` gives the
    executed ones); log_densities (M, E, T) of the sampled actions; rewards (M, E, T); reset_seeds (M, E).
    """

    domain: Domain
    observations: np.ndarray
    actions: np.ndarray
    log_densities: np.ndarray
    rewards: np.ndarray
    reset_seeds: np.ndarray

    @property
    def executed_actions(self) -> np.ndarray:
        return self.domain.clip_action(self.actions)

    @property
    def returns(self) -> np.ndarray:
        """Undiscounted return of each episode, (M, E)."""
        return self.rewards.sum(-1)

    @property
    def n_steps(self) -> int:
        return self.rewards.size


def draw_reset_seeds(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.integers(0, 2**31 - 1, shape)


def rollout(domain: Domain, actor, n_episodes: int, seed, *, reset_seeds=None, horizon: int = 0, n_threads: int = 0) -> Rollouts:
    """Simulate ``n_episodes`` of every policy of ``actor`` (anything with ``mean``, ``sigma``, ``n_strategies``).

    ``a_t = mu_j(s_t) + sigma_j eps_t``; executed is ``clip(a_t)``. ``seed`` (int or list of ints) fixes starts and
    action noise; ``reset_seeds`` (M, E) fixes the starts alone. ``horizon`` 0 means the domain's own.
    The same seed gives the same bits for any ``n_threads``.
    """
    rng = np.random.default_rng(seed)
    m, e, t_end = actor.n_strategies, n_episodes, horizon or domain.horizon
    drawn = draw_reset_seeds(rng, m, e)
    reset_seeds = drawn if reset_seeds is None else np.asarray(reset_seeds)
    noise = rng.standard_normal((t_end, m, e, domain.action_dim), dtype=np.float32)
    log_densities = gaussian_log_density(noise, np.float32(0), np.float32(1)) - np.log(actor.sigma).sum(-1)
    noise *= actor.sigma
    observations = np.empty((t_end + 1, m, e, domain.obs_dim))
    actions = np.empty((t_end, m, e, domain.action_dim), dtype=np.float32)
    rewards = np.empty((t_end, m, e))

    def simulate(some: slice, threads: int) -> None:
        part = observations[:, :, some]
        batch, shape = domain.make_batch(part[0, ..., 0].size, threads), part.shape[1:3]
        part[0] = batch.reset(reset_seeds[:, some].ravel()).reshape(*shape, -1)
        for t in range(t_end):
            actions[t, :, some] = actor.mean(part[t]) + noise[t, :, some]
            state, reward = batch.step(domain.clip_action(actions[t, :, some]).reshape(-1, domain.action_dim))
            part[t + 1], rewards[t, :, some] = state.reshape(*shape, -1), reward.reshape(shape)

    # Always the same two halves, so that the bits are too; on two threads one half acts while the other is simulated.
    halves = [slice(0, e // 2), slice(e // 2, e)] if e > 1 and m * e >= 8 else [slice(0, e)]
    threads = n_threads or os.cpu_count() or 1
    with ThreadPoolExecutor(min(threads, len(halves))) as pool:
        list(pool.map(simulate, halves, [max(1, min(threads // len(halves), m * e // 16))] * len(halves)))
    parts = (np.moveaxis(array, 0, 2) for array in (observations, actions, log_densities, rewards))
    return Rollouts(domain, *parts, reset_seeds)
