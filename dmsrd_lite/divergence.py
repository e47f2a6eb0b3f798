"""How far apart two sets of states are: the k-nearest-neighbour estimate of ``D_KL(demonstration || rollout)``."""

import numpy as np
from scipy.spatial import cKDTree

from dmsrd_lite.envs import Domain

K_NEIGHBORS = 3


def _kth_distance(tree: cKDTree, points: np.ndarray, k: int, resolution: float) -> np.ndarray:
    return np.maximum(tree.query(points, k=[k], p=np.inf, workers=-1)[0][:, 0], resolution)


def knn_divergence(expert: np.ndarray, rollout: np.ndarray, k: int = K_NEIGHBORS, resolution: float = 1e-9) -> float:
    """``d mean_i(log nu_k(x_i) - log rho_k(x_i)) + log(m / (n - 1))``, an estimate of ``D_KL(p || q)`` in nats.

    expert (n, d) ~ p, rollout (m, d) ~ q. ``nu_k(x_i)`` is the Chebyshev distance from expert state ``x_i`` to its k-th
    neighbour among the rollout's states, ``rho_k(x_i)`` the same among the other expert states. Distances below
    ``resolution`` count as ``resolution``, so repeated states do not decide the result. Wang, Kulkarni, Verdu (2009).
    """
    n, d = expert.shape
    nu = _kth_distance(cKDTree(rollout), expert, k, resolution)
    rho = _kth_distance(cKDTree(expert), expert, k + 1, resolution)  # the first neighbour is the state itself
    return float(d * np.mean(np.log(nu) - np.log(rho)) + np.log(len(rollout) / (n - 1)))


def _compared(domain: Domain, trajectories: np.ndarray) -> np.ndarray:
    return trajectories[:, 1:, list(domain.knn_coordinates)]


def trajectory_divergences(domain: Domain, experts: np.ndarray, rollouts: np.ndarray) -> np.ndarray:
    """``D_KL`` of each expert trajectory (a, T, obs_dim) against each rollout (b, T, obs_dim): (a, b) nats.

    The protocol of every number in this workbook: k = 3, Chebyshev norm, raw units, initial states left out.
    """
    experts, rollouts = _compared(domain, experts), _compared(domain, rollouts)
    a, t, d = experts.shape
    rho = np.concatenate([_kth_distance(cKDTree(e), e, K_NEIGHBORS + 1, domain.knn_resolution) for e in experts])
    result = np.empty((a, len(rollouts)))
    for j, rollout in enumerate(rollouts):
        nu = _kth_distance(cKDTree(rollout), experts.reshape(a * t, d), K_NEIGHBORS, domain.knn_resolution)
        result[:, j] = d * np.log(nu / rho).reshape(a, t).mean(1) + np.log(len(rollout) / (t - 1))
    return result


def demonstration_divergence(domain: Domain, demonstration: np.ndarray, rollouts: np.ndarray) -> float:
    """One demonstration (a, T, obs_dim) against rollouts (b, T, obs_dim), nats.

    The mean of ``trajectory_divergences`` over all pairs; in a domain with ``matched_starts`` instead all trajectories
    pooled against as many rollouts pooled, the mean over such groups of rollouts.
    """
    if not domain.matched_starts:
        return float(trajectory_divergences(domain, demonstration, rollouts).mean())
    groups = np.array_split(_compared(domain, rollouts), max(1, len(rollouts) // len(demonstration)))
    expert, *groups = (part.reshape(-1, part.shape[-1]) for part in (_compared(domain, demonstration), *groups))
    return float(np.mean([knn_divergence(expert, group, resolution=domain.knn_resolution) for group in groups]))


def own_divergence(domain: Domain, demonstration: np.ndarray) -> float:
    """The floor without a second take: a demonstration's own trajectories against each other, nats; NaN for a single one."""
    if len(demonstration) < 2:
        return float("nan")
    table = trajectory_divergences(domain, demonstration, demonstration)
    return float(table[~np.eye(len(table), dtype=bool)].mean())


def divergence_table(domain: Domain, demonstrations: np.ndarray) -> np.ndarray:
    """Every demonstration against every other's trajectories, (n, k, T, d) -> (n, n) nats; the diagonal is ``own_divergence``."""
    n = len(demonstrations)
    pairs = [
        own_divergence(domain, demonstrations[i]) if i == j else demonstration_divergence(domain, demonstrations[i], demonstrations[j])
        for i, j in np.ndindex(n, n)
    ]
    return np.reshape(pairs, (n, n))
