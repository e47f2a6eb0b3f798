"""Proximal policy optimisation (PPO) for many strategies at once.

PPO rather than TRPO: it is first-order and works on minibatches, so one batched gradient step serves all
strategies; TRPO's conjugate gradient and line search would have to run for each strategy apart.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.signal import lfilter

from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import SIGMA_FLOOR, BatchedMLP, GaussianPolicies, one_thread, to_tensor
from dmsrd_lite.learning.rollouts import Rollouts, rollout


@dataclass(frozen=True)
class PPOSettings:
    discount: float = 0.99  # gamma
    gae_lambda: float = 0.95
    clip: float = 0.2  # the ratio's bound
    learning_rate: float = 1e-3
    epochs: int = 2
    minibatch: int = 1000  # samples per strategy and gradient step
    sample_fraction: float = 1.0  # share of the samples that the gradient steps see in an epoch
    value_weight: float = 0.5
    gradient_norm: float = 1.0  # per strategy


def generalized_advantages(
    rewards: np.ndarray, values: np.ndarray, discount: float, gae_lambda: float
) -> np.ndarray:
    """``A_t = sum_k (gamma lambda)^k (r_{t+k} + gamma V_{t+k+1} - V_{t+k})``, bootstrapped at the horizon.

    rewards (..., T), values (..., T+1) -> (..., T). The horizon cuts an episode that would go on, so V(s_T)
    counts.
    """
    delta = rewards + discount * values[..., 1:] - values[..., :-1]
    return lfilter([1.0], [1.0, -discount * gae_lambda], delta[..., ::-1], axis=-1)[..., ::-1]


def clip_gradients(parameters: Sequence[torch.Tensor], largest: float) -> None:
    """Scale each strategy's gradient (leading axis) to a norm of at most ``largest``."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    norm = sum((g.flatten(1).square().sum(1) for g in gradients), torch.zeros(())).sqrt()
    factor = (largest / (norm + 1e-8)).clamp(max=1.0)
    for g in gradients:
        g.mul_(factor.view(-1, *[1] * (g.dim() - 1)))


class PolicyOptimizer:
    """Batched PPO on given rewards; strategies share nothing: M together equal each alone."""

    def __init__(self, policies: GaussianPolicies, settings: PPOSettings, seed: Seed):
        self.policies, self.settings = policies, settings
        d = policies.domain.obs_dim
        self.values = BatchedMLP(policies.n_strategies, (d, 32, 32, 1), seed)
        self.parameters = [*policies.parameters(), *self.values.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, lr=settings.learning_rate, eps=1e-5, fused=True)
        self._moments: np.ndarray | None = None  # running mean and variance of the reward, (M, 1, 1) each

    def _standardize(self, rewards: np.ndarray) -> np.ndarray:
        """Rewards to mean 0, deviation 1 per strategy: without termination a constant changes no policy."""
        now = np.stack([rewards.mean((1, 2), keepdims=True), rewards.var((1, 2), keepdims=True)])
        self._moments = now if self._moments is None else 0.8 * self._moments + 0.2 * now
        return (rewards - self._moments[0]) / np.sqrt(self._moments[1] + 1e-8)

    @torch.no_grad()
    def _evaluate(self, x: torch.Tensor, shape: tuple[int, ...]) -> np.ndarray:
        return self.values(x).numpy().reshape(shape).astype(np.float64) / (1 - self.settings.discount)

    @one_thread()
    def update(
        self,
        rollouts: Rollouts,
        rewards: np.ndarray,
        seed: Seed,
        *,
        demonstrations=None,
        cloning_weight: float = 0.0,
    ) -> None:
        """One PPO update of every policy on ``rewards`` (M, E, T), any per-step reward of these rollouts.

        Loss: ``-E[min(rho A, clip(rho) A)]`` with ``rho`` the ratio at the unclipped samples, plus the value
        loss, plus ``cloning_weight * E_demo[-log pi]`` when ``demonstrations = (x (M, n, d), actions (M, n,
        a))``.
        """
        s, rng = self.settings, np.random.default_rng(seed)
        m, e, t = rewards.shape
        x_all = to_tensor(rollouts.domain.network_input(rollouts.observations)).view(m, e * (t + 1), -1)
        values = self._evaluate(x_all, (m, e, t + 1))
        advantages = generalized_advantages(self._standardize(rewards), values, s.discount, s.gae_lambda)
        targets = to_tensor((advantages + values[..., :-1]) * (1 - s.discount)).view(m, -1)
        advantages -= advantages.mean((1, 2), keepdims=True)
        scaled = to_tensor(advantages / (advantages.std((1, 2), keepdims=True) + 1e-8)).view(m, -1)
        x = x_all.view(m, e, t + 1, -1)[:, :, :-1].reshape(m, e * t, -1)
        actions = to_tensor(rollouts.actions).view(m, e * t, -1)
        old = to_tensor(rollouts.log_densities).view(m, e * t)
        used = max(1, int(e * t * s.sample_fraction))
        for _ in range(s.epochs):
            order = torch.from_numpy(rng.permutation(e * t)[:used])
            for start in range(0, used, s.minibatch):
                pick = order[start : start + s.minibatch]
                new = self.policies.log_density(x[:, pick], actions[:, pick])
                ratio, a = (new - old[:, pick]).exp(), scaled[:, pick]
                loss = -torch.minimum(ratio * a, ratio.clamp(1 - s.clip, 1 + s.clip) * a).mean(1).sum()
                missed = (self.values(x[:, pick])[..., 0] - targets[:, pick]).square().mean(1).sum()
                loss = loss + s.value_weight * missed
                if cloning_weight:
                    some = torch.from_numpy(rng.integers(0, demonstrations[0].shape[1], s.minibatch // 2))
                    shown = self.policies.log_density(*(d[:, some] for d in demonstrations))
                    loss = loss - cloning_weight * shown.mean(1).sum()
                self._step(loss)

    def slow_down(self, share: float) -> None:
        """From here on learn with this share of the settings' rate."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * share

    def _step(self, loss: torch.Tensor) -> None:
        self.optimizer.zero_grad()
        loss.backward()
        clip_gradients(self.parameters, self.settings.gradient_norm)
        self.optimizer.step()
        with torch.no_grad():
            self.policies.log_sigma.clamp_(min=math.log(SIGMA_FLOOR))


@dataclass(frozen=True)
class TrainingSettings:
    """Training of policies from nothing on a given reward."""

    n_strategies: int = 10
    n_iterations: int = 120
    episodes: int = 8  # per policy and iteration; up to four times as many while they are short
    first_horizon: int = 100  # steps; grows to the domain's ...
    hold: float = 0.0  # ... from this share of the iterations ...
    growing: float = 0.6  # ... to this one
    first_sigma: float = 0.2  # share of half the action range
    last_sigma: float = 0.0  # sigma shrinks to this (action units) from 0.4 to 0.9 of the iterations; 0: free
    last_rate: float = 1.0  # the learning rate falls linearly to this share of itself
    last_discount: float = 0.0  # the discount grows to this, its distance from 1 by equal factors; 0: stays
    ppo: PPOSettings = PPOSettings()


def anneal(
    policies: GaussianPolicies, optimizer: PolicyOptimizer, settings: TrainingSettings, share: float
) -> None:
    """Lower the bound on sigma and the learning rate, raise the discount.

    With little noise left, what is rewarded is what a policy means to do; far sight is learned best from near
    sight.
    """
    if settings.last_discount:
        far, near = 1 - settings.ppo.discount, 1 - settings.last_discount
        optimizer.settings = replace(settings.ppo, discount=1 - far * (near / far) ** share)
    optimizer.slow_down(1 - (1 - settings.last_rate) * share)
    if settings.last_sigma:
        progress = min(1.0, max(0.0, (share - 0.4) / 0.5))
        with torch.no_grad():
            policies.log_sigma.clamp_(max=progress * math.log(settings.last_sigma))


def train_policies(
    domain: Domain, reward: Callable[[Rollouts, list[int]], np.ndarray], settings: TrainingSettings, seed: int
) -> Iterator[dict]:
    """Train M fresh policies on ``reward(rollouts, seed) -> (M, E, T)`` with episodes that grow to the full
    horizon.

    Yields a record per iteration: ``policies`` (live; copy with ``.actor()``), ``iteration``, ``horizon``,
    ``steps`` so far in all, and ``environment_return`` (M,) over ``horizon`` steps, which trains nothing
    unless ``reward`` is it.
    """
    s = settings
    policies = GaussianPolicies(domain, s.n_strategies, [seed, 0], s.first_sigma)
    optimizer = PolicyOptimizer(policies, s.ppo, [seed, 1])
    steps = 0
    for iteration in range(s.n_iterations):
        share = min(
            1.0, max(0.0, iteration - s.hold * s.n_iterations) / max(1, (s.growing - s.hold) * s.n_iterations)
        )
        first = min(s.first_horizon, domain.horizon)
        horizon = int(first * (domain.horizon / first) ** share)
        episodes = max(s.episodes, min(4 * s.episodes, s.episodes * domain.horizon // (2 * horizon)))
        data = rollout(domain, policies.actor(), episodes, [seed, 3, iteration], horizon=horizon)
        optimizer.update(data, reward(data, [seed, 4, iteration]), [seed, 5, iteration])
        anneal(policies, optimizer, s, (iteration + 1) / s.n_iterations)
        steps += data.n_steps
        record = {"policies": policies, "iteration": iteration, "horizon": horizon, "steps": steps}
        yield {**record, "environment_return": data.returns.mean(1)}
