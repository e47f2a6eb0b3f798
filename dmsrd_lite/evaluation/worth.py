"""Does a reward teach? Freeze it, and train fresh policies on it alone."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.policy_optimization import TrainingSettings, train_policies
from dmsrd_lite.learning.rollouts import Rollouts, rollout
from dmsrd_lite.method.rewards import StateReward

TRIALS = 20


def able(domain: Domain, scores: dict[str, Any]) -> np.ndarray:
    """Who can do the task, by a row of a table or record: mean returns and shares of failing rollouts, (n,)
    lists or arrays each -> (n,) bool.

    Where starts decide as much as policies do (``matched_starts``) a failure is forgiven.
    """
    returns, failures = (np.array(scores[key]) for key in ("environment_return", "failure_share"))
    return (returns >= domain.success_return) & (domain.comparison.matched_starts | (failures == 0))


def reward_worth(
    rewards: StateReward,
    domain: Domain,
    settings: TrainingSettings,
    seed: int,
    part: str = "g",
    progress: Callable = iter,
) -> dict[str, Any]:
    """Train ``settings.n_strategies`` fresh policies on one frozen reward (``part`` of it; one row) and try
    them, as a row of a table or record.

    environment_return, failure_share: of ``TRIALS`` rollouts, (n,) each, as ``metrics.score_policies`` names
    its own; curves: the true reward per step while they learned, (n_iterations, n), for reading only; steps.
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
    return {
        "environment_return": trial.returns.mean(1),
        "failure_share": trial.failed.any(-1).mean(1),
        "curves": np.array(curves).round(4),
        "steps": record["steps"],
    }
