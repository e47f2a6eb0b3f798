"""Multi-strategy reward distillation (MSRD): what all demonstrators want, and what each of them wants
besides.

``R_j(s) = R_Task(s) + alpha R_S-j(s)``; the AIRL loss of every strategy under its R_j plus ``alpha E|R_S-j|``
on the policies' own states pushes what is common into R_Task. Paper: Equation 1; Chen, Paleja, Ghuy, Gombolay
(2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import InputError
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import to_tensor
from dmsrd_lite.method.airl import AIRL, AIRLSettings
from dmsrd_lite.method.between_class_discrimination import (
    between_class_loss,
    means_of_people,
    relative_to_own,
)

# States of all n (n, k, obs_dim), weights (n, M), pure (M,).
Between = tuple[np.ndarray, np.ndarray, Sequence[int] | np.ndarray]


@dataclass(frozen=True)
class MSRDSettings(AIRLSettings):
    alpha: float = 0.3  # of Equation 1, in the sum and in the penalty
    between_class_weight: float = 10.0  # of Equation 4, where there are weights to discriminate by
    between_class_relative: bool = True  # strategy rewards count from their own people (``relative_to_own``)
    between_class_batch: int = 128  # states of every demonstration per step
    between_class_extra: int = 10  # further updates of the strategy rewards after training (``settle``)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.alpha > 0:
            raise InputError(f"alpha {self.alpha!r}: expected a positive weight of the strategy rewards")


class MSRD(AIRL):
    """AIRL for labelled demonstrations, one per strategy, with a shared task reward: its gradient is the sum
    over strategies.

    ``between``: ``(states (n, k, obs_dim), weights (n, M), pure (M))`` adds between-class discrimination
    among all n people (``between_class_discrimination.states_of``).
    """

    settings: MSRDSettings

    def __init__(
        self,
        demonstrations: DemonstrationSet,
        settings: MSRDSettings,
        seed: Seed,
        *,
        networks: dict[str, torch.Tensor] | None = None,
        between: Between | None = None,
    ):
        self.alpha, self.between = settings.alpha, None
        super().__init__(demonstrations, settings, seed, networks=networks, task_learns=True)
        if between is not None:
            states, weights, pure = between
            x = to_tensor(self.domain.network_input(states))
            self.between = x, to_tensor(weights), torch.as_tensor(np.asarray(pure))

    def regularizer(self, x_samples: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """``alpha sum_j E|R_S-j|`` on the policies' states, and Equation 4 where there are weights."""
        loss = super().regularizer(x_samples, rng)
        if self.between is not None:
            x, weights, pure = self.between
            some = torch.from_numpy(rng.integers(0, x.shape[1], self.settings.between_class_batch))
            mean_rewards = means_of_people(self.rewards, x[:, some])
            if self.settings.between_class_relative:
                mean_rewards = relative_to_own(mean_rewards, pure)
            loss = (
                loss
                + self.settings.between_class_weight * between_class_loss(mean_rewards, weights, pure).sum()
            )
        return loss

    def settle(self) -> None:
        """A fixed number of further updates on the samples at hand, where there is something to discriminate.

        Strategy rewards learn; policies and R_Task rest, and nothing is simulated. Recognition is never
        asked: a number must not be its own stopping rule.
        """
        self.rewards.task_reward.requires_grad_(False)
        for update in range(self.settings.between_class_extra if self.between is not None else 0):
            self._discriminate([*self.seed, 20, update], self._log_densities())
            self._average()
        self.rewards.task_reward.requires_grad_(True)
