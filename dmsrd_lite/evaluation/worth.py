"""Does a reward teach? Freeze it, and train fresh policies on it alone."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.policy_optimization import TrainingSettings, train_policies
from dmsrd_lite.learning.rollouts import Rollouts, rollout

TRIALS = 20


class StateReward(Protocol):
    """``Rewards``, ``MeanRewards``, or anything else that gives a reward of the state."""

    domain: Domain

    def evaluate(self, observations: np.ndarray, part: str = "g") -> np.ndarray:
        """Observations (..., obs_dim) -> (1, ...)."""


@dataclass(frozen=True)
class Worth:
    """What fresh policies do in ``TRIALS`` rollouts, (n,) each, and the true reward per step while they
    learned, (n_iterations, n): for reading only, nothing is chosen by it."""

    returns: np.ndarray
    failure_share: np.ndarray
    curves: np.ndarray
    steps: int

    def scores(self) -> dict[str, Any]:
        """A row of a table or record, named as ``metrics.score_policies`` names its own."""
        row = {"environment_return": self.returns, "failure_share": self.failure_share}
        return {**row, "curves": self.curves.round(4), "steps": self.steps}


def solves(domain: Domain, returns: np.ndarray, failure_share: np.ndarray) -> np.ndarray:
    """Mean returns and shares of failing rollouts (n,) -> who can do the task (n,) bool.

    Where starts decide as much as policies do (``matched_starts``) a failure is forgiven.
    """
    return (returns >= domain.success_return) & (domain.comparison.matched_starts | (failure_share == 0))


def able(domain: Domain, scores: dict[str, Any]) -> np.ndarray:
    """``solves`` for a row of a table or record, lists or arrays: (n,) bool."""
    return solves(domain, *(np.array(scores[key]) for key in ("environment_return", "failure_share")))


def reward_worth(
    rewards: StateReward,
    domain: Domain,
    settings: TrainingSettings,
    seed: int,
    part: str = "g",
    progress: Callable = iter,
) -> Worth:
    """Train ``settings.n_strategies`` fresh policies on one frozen reward (``part`` of it; one row) and try
    them.

    The same for every method and for the control, a reward fitted to true returns
    (``metrics.fit_reward``). ``progress`` wraps an iterable.
    """
    if rewards.domain.name != domain.name:
        raise InputError(f"a reward of {rewards.domain.name}; expected one of {domain.name}")

    def paid(data: Rollouts, _seed: list[int]) -> np.ndarray:
        return rewards.evaluate(data.observations[:, :, 1:], part)[0]

    curves, record = [], {}
    for record in progress(train_policies(domain, paid, settings, seed)):
        curves.append(record["environment_return"] / record["horizon"])
    trial = rollout(domain, record["policies"].actor(), TRIALS, [seed, 98])
    failures = trial.failed.any(-1).mean(1)
    return Worth(trial.returns.mean(1), failures, np.array(curves), record["steps"])
