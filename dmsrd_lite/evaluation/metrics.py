"""The metrics of every table: one function scores every method in the same way."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import norm, rankdata

from dmsrd_lite.demonstrations import DemonstrationSet, RewardTestSet
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.networks import SIGMA_FLOOR, Policies, one_thread, to_tensor
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.divergence import demonstration_divergence, policy_divergences
from dmsrd_lite.method.rewards import Rewards, StateReward


def demonstration_log_likelihood(actor: Policies, demonstrations: DemonstrationSet) -> np.ndarray:
    """``sum_t log pi_j(a_t|s_t)`` of demonstration j's executed actions under policy j, mean over
    trajectories: (n,) nats.

    With the policy's own sigma, at least ``SIGMA_FLOOR``. The demonstrator's own is
    ``log_likelihoods.mean(1)``.
    """
    n, k, t = demonstrations.actions.shape[:3]
    states = demonstrations.observations[:, :, :t].reshape(n, k * t, -1)
    log_pi = actor.log_density(states, demonstrations.actions.reshape(n, k * t, -1), SIGMA_FLOOR)
    return log_pi.astype(np.float64).sum(1) / k


def score_policies(
    actor: Policies,
    demonstrations: DemonstrationSet,
    seed: Seed,
    *,
    n_rollouts: int = 20,
    n_compared: int = 10,
) -> dict[str, np.ndarray]:
    """Score policy j against demonstration j by stochastic rollouts; each value is (n,).

    environment_return: mean undiscounted return. failure_share: share of rollouts that fail. divergence: KL
    in nats, against ``n_compared`` of these rollouts, or of others from the demonstration's starts
    (``policy_divergences``). log_likelihood_per_step: nats per step of the demonstration.
    """
    domain = demonstrations.domain
    data = rollout(domain, actor, n_rollouts, seed, horizon=demonstrations.horizon)
    if domain.comparison.matched_starts:
        divergences = policy_divergences(actor, demonstrations, extend(seed, 1), n_rollouts=n_compared)
    else:
        pairs = zip(demonstrations.observations, data.observations[:, :n_compared], strict=True)
        divergences = np.array([demonstration_divergence(domain, shown, flown) for shown, flown in pairs])
    return {
        "environment_return": data.returns.mean(1),
        "failure_share": data.failed.any(-1).mean(1),
        "divergence": divergences,
        "log_likelihood_per_step": demonstration_log_likelihood(actor, demonstrations)
        / demonstrations.horizon,
    }


PUBLISHED_SIGMA, PUBLISHED_FLOOR = 0.0628, 1e-37  # in the authors' code: of every action; of a density


def published_scores(actor: Policies, demonstrations: DemonstrationSet, seed: Seed) -> dict[str, np.ndarray]:
    """As the authors' published code scores, (n,) each; for a comparison with the paper's numbers alone.

    published_return: rewards of 20 rollouts, paid on every step, whether the task would be over or not.
    published_log_likelihood: ``sum log max(N(a; mu(s), 0.0628^2), 1e-37)`` over all trajectories together.
    """
    domain = demonstrations.domain
    data = rollout(domain, actor, 20, seed, horizon=demonstrations.horizon)
    n, _, t = demonstrations.actions.shape[:3]
    states = demonstrations.observations[:, :, :t].reshape(n, -1, domain.obs_dim)
    acted = demonstrations.actions.reshape(n, states.shape[1], -1)
    log_pi = norm.logpdf(acted, actor.mean(states), PUBLISHED_SIGMA).sum(-1)
    return {
        "published_return": data.rewards_every_step.sum(-1).mean(1),
        "published_log_likelihood": np.maximum(log_pi, np.log(PUBLISHED_FLOOR)).sum(1),
    }


def reward_correlation(trajectory_rewards: np.ndarray, returns: np.ndarray) -> float:
    """Pearson correlation of mean rewards (n,) with true returns (n,); NaN for a constant reward."""
    if np.ptp(trajectory_rewards) == 0:
        return float("nan")
    return float(np.corrcoef(trajectory_rewards, returns)[0, 1])


@dataclass(frozen=True)
class Correlations:
    """How a reward's trajectory means go with true returns."""

    pearson: float
    spearman: float  # of ranks: a reward that only says who failed does not get far
    spearman_of_good: float  # among those that never fail; NaN where the test set does not say


def reward_correlations(test_set: RewardTestSet, trajectory_rewards: np.ndarray) -> Correlations:
    """The three correlations of any reward, given as mean rewards (n,) of the test set's trajectories."""

    def ranked(some: np.ndarray) -> float:
        return reward_correlation(rankdata(trajectory_rewards[some]), rankdata(test_set.returns[some]))

    everybody = np.ones(len(test_set.returns), dtype=bool)
    good = everybody & (False if test_set.failed is None else test_set.failed[:, -1] == 0)
    among_good = ranked(good) if good.sum() > 1 else float("nan")
    pearson = reward_correlation(trajectory_rewards, test_set.returns)
    return Correlations(pearson, ranked(everybody), among_good)


def one_line_rewards(test_set: RewardTestSet) -> dict[str, np.ndarray]:
    """Mean rewards (n,) of what needs no learning: what any learned reward is to be compared with."""
    states = test_set.observations
    scaled = test_set.domain.network_input(states)
    found = {"-|x|": -np.abs(states[..., 0]).mean(1), "-|s|^2": -(scaled**2).sum(-1).mean(1)}
    return found if test_set.failed is None else {"has not failed": 1 - test_set.failed.mean(1), **found}


def correlations_on(test_set: RewardTestSet, rewards: StateReward, part: str = "g") -> np.ndarray:
    """Correlation of each reward, or a ``part`` of it (``Rewards.evaluate``), with the true return: (M,)."""
    means = rewards.evaluate(test_set.observations, part).mean(2)
    return np.array([reward_correlation(mean, test_set.returns) for mean in means])


@one_thread()
def fit_reward(known: RewardTestSet, seed: Seed, n_steps: int = 2000) -> Rewards:
    """A state reward, the same network as a learned one, fitted to true returns: what any state reward could
    know.

    Minimises ``(mean_t g(s_t) - standardised return)^2`` over trajectories; every fifth is held out, and the
    weights that correlate best with these are kept. Its correlation on a test set is the ceiling of the
    task-reward correlation.
    """
    rng, rewards = np.random.default_rng(seed), Rewards(known.domain, 1, 0.99, extend(seed, 1))
    x = to_tensor(known.domain.network_input(known.observations))
    target = to_tensor((known.returns - known.returns.mean()) / known.returns.std())
    held, batch = np.arange(len(target)) % 5 == 0, 128
    optimizer = torch.optim.Adam(rewards.strategy_reward.parameters(), lr=3e-3, fused=True)
    best, kept = -1.0, rewards.state_dict()
    for step in range(n_steps):
        pick = rng.choice(np.flatnonzero(~held), batch)
        loss = (rewards.g(x[pick].flatten(0, 1)[None]).view(batch, -1).mean(1) - target[pick]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 49:
            found = reward_correlation(
                rewards.evaluate(known.observations[held])[0].mean(1), known.returns[held]
            )
            if found > best:
                best, kept = found, {k: v.clone() for k, v in rewards.state_dict().items()}
    rewards.load_state_dict(kept)
    return rewards
