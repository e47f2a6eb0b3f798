"""Demonstrators by joint training on task reward + diversity (DIAYN): ``r + lambda (log q(z|s) - log 1/M)``.

Eysenbach, Gupta, Ibarz and Levine (2019).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.domains.domain import Diversity, Population, Seed
from dmsrd_lite.learning.networks import BatchedMLP, one_thread, to_tensor
from dmsrd_lite.learning.policy_optimization import TrainingSettings, train_policies
from dmsrd_lite.learning.rollouts import Rollouts

POPULATION_SEED = 3000  # added to a generation's seed for each further population: they share nothing


@dataclass(frozen=True)
class DiaynSettings:
    diversity_weight: float = 0.05  # lambda
    discriminator_steps: int = 20
    discriminator_batch: int = 200  # states of each strategy per step
    discriminator_rate: float = 1e-3
    training: TrainingSettings = TrainingSettings(
        n_strategies=20, n_iterations=160, episodes=4, last_rate=0.1
    )
    acting_noise: float = 0.8  # demonstrators act with this share of the sigma they were trained with
    attempts: int = 1  # starts that are tried for each one that is shown: nobody shows an attempt that failed


def diversity_of(domain: Domain) -> Diversity:
    """How people differ in a domain; ``InputError`` where nobody has said."""
    if domain.diversity is None:
        raise InputError(
            f"{domain.name}: says nothing of how people differ; expected a domain with a diversity"
        )
    return domain.diversity


class StrategyDiscriminator:
    """``q(z|s)``: which of M strategies was here, seen through ``Diversity.features`` in a population's
    units.

    Unit noise keeps strategies from settling for differences that nobody would see.
    """

    def __init__(self, n_features: int, n_strategies: int, settings: DiaynSettings, seed: Seed):
        self.settings = settings
        self.network = BatchedMLP(1, (n_features, 64, 64, n_strategies), seed)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=settings.discriminator_rate, fused=True
        )

    @one_thread()
    def update(self, features: np.ndarray, seed: Seed) -> tuple[np.ndarray, float]:
        """Cross-entropy steps on features (M, n, k): ``log q(z = j | s)`` (M, n) and the accuracy."""
        rng, s = np.random.default_rng(seed), self.settings
        m, n, d = features.shape
        x = to_tensor(features + rng.standard_normal(features.shape, dtype=np.float32))
        labels = torch.arange(m).repeat_interleave(s.discriminator_batch)
        for _ in range(s.discriminator_steps):
            pick = torch.from_numpy(rng.integers(0, n, s.discriminator_batch))
            logits = self.network(x[:, pick].reshape(1, -1, d))[0]
            self.optimizer.zero_grad()
            torch.nn.functional.cross_entropy(logits, labels).backward()
            self.optimizer.step()
        with torch.no_grad():
            log_q = torch.log_softmax(self.network(x.view(1, m * n, d))[0], 1).view(m, n, m)
        return log_q[torch.arange(m), :, torch.arange(m)].numpy(), float(
            (logits.argmax(1) == labels).float().mean()
        )


class DiversityReward:
    """``r + lambda (log q(z|s) - log 1/M)``; updates q at every call and keeps its ``accuracy``."""

    def __init__(self, population: Population, settings: DiaynSettings, seed: int):
        self.units, self.weight = np.array(population.feature_units), settings.diversity_weight
        m = settings.training.n_strategies
        self.discriminator = StrategyDiscriminator(len(self.units), m, settings, [seed, 2])
        self.accuracy = 1 / m

    def __call__(self, data: Rollouts, seed: Seed) -> np.ndarray:
        m, e, t = data.rewards.shape
        features = (diversity_of(data.domain).features(data.observations) / self.units).reshape(m, e * t, -1)
        log_q, self.accuracy = self.discriminator.update(features, seed)
        return data.rewards + self.weight * (log_q.reshape(m, e, t) + np.log(m))


def train_demonstrators(
    domain: Domain, population: Population, settings: DiaynSettings, seed: int
) -> Iterator[dict]:
    """Train M demonstrators together: the records of ``train_policies``, with the ``accuracy`` of q(z|s)."""
    reward = DiversityReward(population, settings, seed)
    training = replace(settings.training, last_sigma=population.last_sigma)
    for record in train_policies(domain, reward, training, seed):
        yield {**record, "accuracy": reward.accuracy}
