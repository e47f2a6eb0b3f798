"""The metrics of every table: one function scores every method in the same way."""

import warnings

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, RewardTestSet
from dmsrd_lite.divergence import demonstration_divergence, own_divergence
from dmsrd_lite.networks import SIGMA_FLOOR
from dmsrd_lite.rollouts import rollout


def demonstration_log_likelihood(actor, demonstrations: DemonstrationSet) -> np.ndarray:
    """``sum_t log pi_j(a_t|s_t)`` of demonstration j's executed actions under policy j, mean over its trajectories: (n,) nats.

    With the policy's own sigma, at least ``SIGMA_FLOOR``. The demonstrator's own is ``demonstrations.log_likelihoods.mean(1)``.
    """
    n, k, t = demonstrations.actions.shape[:3]
    states = demonstrations.observations[:, :, :t].reshape(n, k * t, -1)
    log_pi = actor.log_density(states, demonstrations.actions.reshape(n, k * t, -1), SIGMA_FLOOR)
    return log_pi.astype(np.float64).sum(1) / k


def divergence_floor(demonstrations: DemonstrationSet, second_take: DemonstrationSet | None = None) -> np.ndarray:
    """The KL that the demonstrator reaches against its own demonstration: (n,) nats.

    From the second take where there is one, else from the demonstration's own trajectories against each other.
    """
    domain, shown = demonstrations.domain, demonstrations.observations
    if second_take is None:
        return np.array([own_divergence(domain, d) for d in shown])
    return np.array([demonstration_divergence(domain, a, b) for a, b in zip(shown, second_take.observations, strict=True)])


def policy_divergences(actor, demonstrations: DemonstrationSet, seed, *, n_rollouts: int = 10, n_threads: int = 0) -> np.ndarray:
    """KL of demonstration j, or of the only one, against fresh rollouts of policy j: (n_strategies,) nats.

    In a domain with ``matched_starts`` the rollouts start as the demonstration did, ``n_rollouts / k`` times (rounded,
    at least once) from each of its k starts; where the demonstrations hold no reset seeds, from as many random starts.
    """
    domain, shown, starts = demonstrations.domain, demonstrations.observations, None
    if domain.matched_starts:
        repeats = max(1, round(n_rollouts / shown.shape[1]))
        n_rollouts = repeats * shown.shape[1]
        if demonstrations.reset_seeds is None:
            text = f"the demonstrations hold no reset_seeds: {domain.name} rolls out from other starts, which adds to the KL"
            warnings.warn(text, stacklevel=2)
        else:
            starts = np.tile(np.broadcast_to(demonstrations.reset_seeds, (actor.n_strategies, shown.shape[1])), repeats)
    data = rollout(domain, actor, n_rollouts, seed, reset_seeds=starts, horizon=demonstrations.horizon, n_threads=n_threads)
    pairs = zip(np.broadcast_to(shown, (actor.n_strategies, *shown.shape[1:])), data.observations, strict=True)
    return np.array([demonstration_divergence(domain, d, r) for d, r in pairs])


def score_policies(
    actor, demonstrations: DemonstrationSet, seed, *, n_rollouts: int = 20, n_compared: int = 10, n_threads: int = 0
) -> dict[str, np.ndarray]:
    """Score policy j against demonstration j by stochastic rollouts; each value is (n,).

    environment_return: mean undiscounted return. failure_share: share of rollouts that fail. divergence: KL in nats,
    against ``n_compared`` of these rollouts, or of others from the demonstration's starts (``policy_divergences``).
    log_likelihood_per_step: nats per step of the demonstration.
    """
    domain = demonstrations.domain
    data = rollout(domain, actor, n_rollouts, seed, horizon=demonstrations.horizon, n_threads=n_threads)
    if domain.matched_starts:
        seeds = [*np.atleast_1d(seed).tolist(), 1]
        divergences = policy_divergences(actor, demonstrations, seeds, n_rollouts=n_compared, n_threads=n_threads)
    else:
        pairs = zip(demonstrations.observations, data.observations[:, :n_compared], strict=True)
        divergences = np.array([demonstration_divergence(domain, d, r) for d, r in pairs])
    return {
        "environment_return": data.returns.mean(1),
        "failure_share": data.failed.any(-1).mean(1),
        "divergence": divergences,
        "log_likelihood_per_step": demonstration_log_likelihood(actor, demonstrations) / demonstrations.horizon,
    }


def reward_correlation(trajectory_rewards: np.ndarray, returns: np.ndarray) -> float:
    """Pearson correlation of mean rewards (n,) with true returns (n,); NaN for a reward that is the same everywhere."""
    if np.ptp(trajectory_rewards) == 0:
        return float("nan")
    return float(np.corrcoef(trajectory_rewards, returns)[0, 1])


def correlations_on(test_set: RewardTestSet, rewards, part: str = "g") -> np.ndarray:
    """Correlation of each learned reward, or of a ``part`` of it (``Rewards.evaluate``), with the true return on a test set, (M,)."""
    return np.array([reward_correlation(mean, test_set.returns) for mean in rewards.evaluate(test_set.observations, part).mean(2)])
