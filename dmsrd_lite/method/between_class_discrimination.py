"""Between-class discrimination: a strategy reward must know its own. Paper: Theorem 1, Equation 4."""

from collections.abc import Sequence

import numpy as np
import torch

from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import one_thread, to_tensor
from dmsrd_lite.method.rewards import Rewards

N_STATES = 3000  # of each person, on which Equation 4 is asked
BATCH = 128  # of these, in an update by Equation 4 alone


def between_class_loss(mean_rewards: torch.Tensor, weights: torch.Tensor, pure: torch.Tensor) -> torch.Tensor:
    """``sum_i (exp(eta_S-j(tau_i)) - w_ij exp(eta_S-j(tau_m_j)))^2`` of each strategy j: (M,). Equation 4.

    mean_rewards (M, n): ``eta_S-j(tau_i)``, the mean of g_j over the states of demonstration i - the mean, so
    that long trajectories stay finite; weights (n, M), rows sum to one; pure (M,): the index ``m_j`` of the
    demonstration that created strategy j. No gradient flows through the pure demonstration's term.
    """
    own = mean_rewards.gather(1, pure[:, None]).detach().exp()  # (M, 1)
    return (mean_rewards.exp() - weights.T * own).square().sum(1)


def states_of(domain: Domain, observations: np.ndarray, seed: Seed, n_states: int = N_STATES) -> np.ndarray:
    """What Equation 4 is asked on: of each of n people (n, k, T+1, obs_dim) as many states that tell who
    acts, drawn at random; (n, n_states, obs_dim)."""
    rng = np.random.default_rng(seed)
    telling = (one[domain.tells(one)] for one in observations)  # one: (k, T+1, obs_dim)
    return np.stack([one[rng.integers(0, len(one), n_states)] for one in telling])


def relative_to_own(mean_rewards: torch.Tensor, pure: torch.Tensor) -> torch.Tensor:
    """Mean rewards counted from the strategy's own demonstration: ``eta_S-j(tau_i) - eta_S-j(tau_m_j)``, (M,
    n).

    With a fixed horizon a constant added to a reward changes no policy, and Theorem 1 speaks of ratios only.
    Equation 4 does feel it: beside a task reward that takes the constant over, all ``eta_S-j`` fall together
    until both of its terms vanish.
    """
    return mean_rewards - mean_rewards.gather(1, pure[:, None])


def means_of_people(rewards: Rewards, states: torch.Tensor) -> torch.Tensor:
    """``eta_S-j(tau_i)``, the mean of g_j over states of each of n people: network inputs (n, k, obs_dim) ->
    (M, n)."""
    m = rewards.strategy_reward.n_strategies
    return (
        rewards.g(states.reshape(1, -1, states.shape[-1]).expand(m, -1, -1)).view(m, len(states), -1).mean(2)
    )


@one_thread()
def train_rewards(
    rewards: Rewards,
    states: np.ndarray,
    weights: np.ndarray,
    pure: Sequence[int],
    seed: Seed,
    n_updates: int = 400,
    rate: float = 3e-3,
) -> None:
    """Updates of the strategy rewards by Equation 4 alone, counted from the own demonstration, in place.

    states (n, n_states, obs_dim) of all n people (``states_of``), ``BATCH`` of each per update; weights (n,
    M), pure (M,).
    """
    x, w = to_tensor(rewards.domain.network_input(states)), to_tensor(weights)
    own = torch.as_tensor(pure)
    optimizer = torch.optim.Adam(rewards.strategy_reward.parameters(), rate)
    for some in np.random.default_rng(seed).integers(0, x.shape[1], (n_updates, BATCH)):
        means = relative_to_own(means_of_people(rewards, x[:, some]), own)
        optimizer.zero_grad()
        between_class_loss(means, w, own).sum().backward()
        optimizer.step()


def recognized(mean_rewards: np.ndarray, pure: Sequence[int] | np.ndarray) -> np.ndarray:
    """Does strategy reward j rank its pure demonstration above all others? (M, n), pure (M,) -> (M,) bool."""
    own = np.take_along_axis(mean_rewards, np.asarray(pure)[:, None], 1)
    return (mean_rewards >= own).sum(1) == 1
