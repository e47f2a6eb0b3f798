"""How far apart two sets of states are: the k-nearest-neighbour estimate of ``D_KL(demonstration || rollout)``."""

import numpy as np
from scipy.spatial import cKDTree

from dmsrd_lite.envs import Domain

K_NEIGHBORS = 3


def _kth_distance(tree: cKDTree, points: np.ndarray, k: int, resolution: float) -> np.ndarray:
    return np.maximum(tree.query(points, k=[k], p=np.inf)[0][:, 0], resolution)


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


def trajectory_divergences(domain: Domain, experts: np.ndarray, rollouts: np.ndarray) -> np.ndarray:
    """``D_KL`` of each expert trajectory (a, T, obs_dim) against each rollout (b, T, obs_dim): (a, b) nats.

    The protocol of every number in this workbook: k = 3, Chebyshev norm, raw units, initial states left out.
    """
    trees = [cKDTree(r[1:]) for r in rollouts]
    result = np.empty((len(experts), len(rollouts)))
    for i, states in enumerate(experts):
        states = states[1:]
        log_rho = np.log(_kth_distance(cKDTree(states), states, K_NEIGHBORS + 1, domain.knn_resolution))
        for j, tree in enumerate(trees):
            log_nu = np.log(_kth_distance(tree, states, K_NEIGHBORS, domain.knn_resolution))
            result[i, j] = states.shape[1] * np.mean(log_nu - log_rho) + np.log(tree.n / (len(states) - 1))
    return result


def demonstration_divergence(domain: Domain, demonstration: np.ndarray, rollouts: np.ndarray) -> float:
    """Mean of ``trajectory_divergences`` over all pairs: one demonstration (a, T, d) against rollouts (b, T, d), nats."""
    return float(trajectory_divergences(domain, demonstration, rollouts).mean())


def own_divergence(domain: Domain, demonstration: np.ndarray) -> float:
    """The floor without a second take: a demonstration's own trajectories against each other, nats; NaN for a single one."""
    if len(demonstration) < 2:
        return float("nan")
    table = trajectory_divergences(domain, demonstration, demonstration)
    return float(table[~np.eye(len(table), dtype=bool)].mean())


def divergence_table(domain: Domain, demonstrations: np.ndarray) -> np.ndarray:
    """Every demonstration against every other's trajectories, (n, k, T, d) -> (n, n) nats; the diagonal is ``own_divergence``."""
    n = len(demonstrations)
    return np.array(
        [
            [
                own_divergence(domain, demonstrations[i])
                if i == j
                else demonstration_divergence(domain, demonstrations[i], demonstrations[j])
                for j in range(n)
            ]
            for i in range(n)
        ]
    )
