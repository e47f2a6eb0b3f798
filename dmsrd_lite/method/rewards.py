"""Rewards of the state: one per strategy, one that strategies share, and means of such functions."""

from collections.abc import Sequence

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.networks import BatchedMLP, one_thread, to_tensor


class StateReward(torch.nn.Module):
    """What gives a reward of the state: ``Rewards``, their mean, or one of your own (``evaluate``)."""

    domain: Domain

    def evaluate(self, observations: np.ndarray, part: str = "g") -> np.ndarray:
        """A ``part`` of the reward at raw observations (..., obs_dim): (M, ...)."""
        raise NotImplementedError

    def mean_rewards(self, demonstrations: DemonstrationSet) -> np.ndarray:
        """``eta_S-j(tau_i)``, the mean of g_j over demonstration i's states that tell who acts: (M, n)."""
        tells = demonstrations.domain.tells(demonstrations.observations)  # (n, k, T+1)
        values = self.evaluate(demonstrations.observations)  # (M, n, k, T+1)
        return (values * tells).sum((2, 3)) / tells.sum((1, 2))


class Rewards(StateReward):
    """Strategy rewards ``g_j(s)``, shaping terms ``h_j(s)`` and, where strategies share one, a task reward.

    ``R_j = g_j``, or ``R_j = R_Task + alpha g_j`` with ``alpha`` > 0 (Equation 1); each network is an MLP
    (32, 32) of the state. ``R_Task`` starts at zero. Rewards are bounded: unbounded they correlated with the
    true return as well, but none of ten fresh policies learned to balance on one frozen, with the same
    training that succeeds on a bounded one. Why is not settled.
    """

    bound = 5.0  # nats

    def __init__(self, domain: Domain, n_strategies: int, discount: float, seed: Seed, alpha: float = 0.0):
        super().__init__()
        self.domain, self.discount, self.alpha = domain, discount, alpha
        sizes = (domain.obs_dim, 32, 32, 1)
        self.strategy_reward = BatchedMLP(
            n_strategies, sizes, extend(seed, 0), last_gain=0.1 if alpha else 1.0
        )
        self.shaping = BatchedMLP(n_strategies, sizes, extend(seed, 1))
        if alpha:
            self.task_reward = BatchedMLP(1, sizes, extend(seed, 2), last_gain=0.0)

    def g(self, x: torch.Tensor) -> torch.Tensor:
        """``g_j(s) = b tanh(net_j(s) / b)``: network inputs (M, n, obs_dim) -> (M, n), within the bound b."""
        return self.bound * torch.tanh(self.strategy_reward(x)[..., 0] / self.bound)

    def task(self, x: torch.Tensor) -> torch.Tensor:
        """``R_Task(s)``, bounded as ``g`` is: (M, n, obs_dim) -> (M, n), one network for all M."""
        return self.bound * torch.tanh(
            self.task_reward(x.reshape(1, -1, x.shape[-1])).view(x.shape[:2]) / self.bound
        )

    def total(self, x: torch.Tensor) -> torch.Tensor:
        """``R_j(s) = R_Task(s) + alpha g_j(s)``, or ``g_j(s)`` where nothing is shared: (M, n)."""
        return self.task(x) + self.alpha * self.g(x) if self.alpha else self.g(x)

    def f(self, x: torch.Tensor, x_next: torch.Tensor) -> torch.Tensor:
        """``R_j(s) + gamma h_j(s') - h_j(s)``, (M, n)."""
        after, before = self.shaping(torch.cat([x_next, x], 1))[..., 0].chunk(2, 1)
        return self.total(x) + self.discount * after - before

    @one_thread()
    @torch.no_grad()
    def evaluate(self, observations: np.ndarray, part: str = "g") -> np.ndarray:
        """``g``, ``task`` or ``total`` at raw observations (..., obs_dim): (M, ...); the task (1, ...)."""
        x = to_tensor(self.domain.network_input(observations)).view(1, -1, self.domain.obs_dim)
        m = 1 if part == "task" else self.strategy_reward.n_strategies
        parts = x.split(100_000, dim=1)  # bounded memory
        values = [getattr(self, part)(some.expand(m, -1, -1)) for some in parts]
        return torch.cat(values, 1).numpy().reshape(m, *observations.shape[:-1])


class MeanRewards(StateReward):
    """The mean of several reward functions, not of their weights: what teaches fresh policies (lesson 02)."""

    def __init__(self, iterates: Sequence[Rewards]):
        super().__init__()
        self.each, self.iterates = list(iterates), torch.nn.ModuleList(iterates)
        self.domain, self.alpha = iterates[0].domain, iterates[0].alpha

    def evaluate(self, observations: np.ndarray, part: str = "g") -> np.ndarray:
        """As ``Rewards.evaluate``."""
        return np.mean([rewards.evaluate(observations, part) for rewards in self.each], 0)
