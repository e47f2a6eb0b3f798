"""Another divergence for Equation 3: the sliced Wasserstein distance. Bonneel et al. (2015)."""

import numpy as np
from scipy.stats import wasserstein_distance

from dmsrd_lite.domains import Domain

N_DIRECTIONS = 20


def sliced_wasserstein(domain: Domain, demonstration: np.ndarray, rollouts: np.ndarray) -> float:
    """``E_u W_1(u . x, u . y)`` over random directions u, of states x shown (a, T, obs_dim) and y (b, T,
    obs_dim).

    Of network inputs, so that coordinates have comparable units; the same coordinates as the KL. Unlike the
    KL it is finite and honest about how far away something is; it is blind to fine structure.
    """
    some = list(domain.comparison.coordinates or range(domain.obs_dim))
    x, y = (
        domain.network_input(part[:, 1:]).reshape(-1, domain.obs_dim)[:, some]
        for part in (demonstration, rollouts)
    )
    directions = np.random.default_rng(0).standard_normal((N_DIRECTIONS, len(some)))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return float(np.mean([wasserstein_distance(x @ u, y @ u) for u in directions]))
