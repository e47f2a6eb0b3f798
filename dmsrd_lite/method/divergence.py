"""How far apart two people's states are: the k-nearest-neighbour estimate of ``D_KL(demonstration ||
rollout)``.

Paper: "Policy mixture optimisation"; Kozachenko and Leonenko (1987), Wang, Kulkarni and Verdu (2009).
"""

import warnings
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import Policies
from dmsrd_lite.learning.rollouts import rollout

K_NEIGHBORS = 3
N_ROLLOUTS = 10  # of a policy, for one KL
Measure = Callable[[Domain, np.ndarray, np.ndarray], float]  # of (a, T, obs_dim) shown and (b, T, obs_dim)


def _kth_distance(tree: cKDTree, points: np.ndarray, k: int, resolution: float) -> np.ndarray:
    distances, _ = tree.query(points, k=[k], p=np.inf, workers=-1)
    return np.maximum(np.asarray(distances)[:, 0], resolution)


def knn_divergence(
    expert: np.ndarray, rollout: np.ndarray, k: int = K_NEIGHBORS, resolution: float = 1e-9
) -> float:
    """``d mean_i(log nu_k(x_i) - log rho_k(x_i)) + log(m / (n - 1))``, an estimate of ``D_KL(p || q)`` in
    nats.

    expert (n, d) ~ p, rollout (m, d) ~ q. ``nu_k(x_i)`` is the Chebyshev distance from expert state ``x_i``
    to its k-th neighbour among the rollout's states, ``rho_k(x_i)`` the same among the other expert states.
    Distances below ``resolution`` count as ``resolution``, so that repeated states do not decide the result.
    """
    n, d = expert.shape
    nu = _kth_distance(cKDTree(rollout), expert, k, resolution)
    rho = _kth_distance(cKDTree(expert), expert, k + 1, resolution)  # the first neighbour is the state itself
    return float(d * np.mean(np.log(nu) - np.log(rho)) + np.log(len(rollout) / (n - 1)))


def _compared(domain: Domain, trajectories: np.ndarray) -> np.ndarray:
    return trajectories[:, 1:, list(domain.comparison.coordinates or range(domain.obs_dim))]


def trajectory_divergences(domain: Domain, experts: np.ndarray, rollouts: np.ndarray) -> np.ndarray:
    """``D_KL`` of each expert trajectory (a, T, obs_dim) against each rollout (b, T, obs_dim): (a, b) nats.

    The protocol of every number in this workbook: k = 3, Chebyshev norm, raw units, initial states left out.
    """
    experts, rollouts = _compared(domain, experts), _compared(domain, rollouts)
    (a, t, d), resolution = experts.shape, domain.comparison.resolution
    rho = np.concatenate([_kth_distance(cKDTree(e), e, K_NEIGHBORS + 1, resolution) for e in experts])
    result = np.empty((a, len(rollouts)))
    for j, flown in enumerate(rollouts):
        nu = _kth_distance(cKDTree(flown), experts.reshape(a * t, d), K_NEIGHBORS, resolution)
        result[:, j] = d * np.log(nu / rho).reshape(a, t).mean(1) + np.log(len(flown) / (t - 1))
    return result


def demonstration_divergence(domain: Domain, demonstration: np.ndarray, rollouts: np.ndarray) -> float:
    """One demonstration (a, T, obs_dim) against rollouts (b, T, obs_dim), nats.

    The mean of ``trajectory_divergences`` over all pairs; in a domain with ``matched_starts`` instead all
    trajectories pooled against as many rollouts pooled, the mean over such groups of rollouts.
    """
    if not domain.comparison.matched_starts:
        return float(trajectory_divergences(domain, demonstration, rollouts).mean())
    groups = np.array_split(_compared(domain, rollouts), max(1, len(rollouts) // len(demonstration)))
    expert, *pooled = (
        part.reshape(-1, part.shape[-1]) for part in (_compared(domain, demonstration), *groups)
    )
    resolution = domain.comparison.resolution
    return float(np.mean([knn_divergence(expert, group, resolution=resolution) for group in pooled]))


def own_divergence(domain: Domain, demonstration: np.ndarray) -> float:
    """A demonstration's own trajectories against each other, nats; NaN for one alone."""
    if len(demonstration) < 2:
        return float("nan")
    table = trajectory_divergences(domain, demonstration, demonstration)
    return float(table[~np.eye(len(table), dtype=bool)].mean())


def divergence_table(domain: Domain, demonstrations: np.ndarray) -> np.ndarray:
    """Every demonstration against every other: (n, k, T, d) -> (n, n) nats; diagonal ``own_divergence``."""
    n = len(demonstrations)
    table = np.diag([own_divergence(domain, shown) for shown in demonstrations])
    for i, j in np.ndindex(n, n):
        if i != j:
            table[i, j] = demonstration_divergence(domain, demonstrations[i], demonstrations[j])
    return table


def divergence_floor(
    demonstrations: DemonstrationSet, second_take: DemonstrationSet | None = None
) -> np.ndarray:
    """The KL that the demonstrator reaches against its own demonstration: (n,) nats.

    From the second take where there is one, else from the demonstration's own trajectories against each
    other.
    """
    domain, shown = demonstrations.domain, demonstrations.observations
    if second_take is None:
        return np.array([own_divergence(domain, one) for one in shown])
    pairs = zip(shown, second_take.observations, strict=True)
    return np.array([demonstration_divergence(domain, one, again) for one, again in pairs])


def rollouts_measured(demonstrations: DemonstrationSet, n_rollouts: int) -> int:
    """How many rollouts of a policy ``policy_divergences`` makes when it is asked for ``n_rollouts``: with
    ``matched_starts`` the same number from each of the k starts, ``n_rollouts / k`` (rounded, at least one).
    """
    if not demonstrations.domain.comparison.matched_starts:
        return n_rollouts
    k = demonstrations.observations.shape[1]
    return max(1, round(n_rollouts / k)) * k


def steps_measured(demonstrations: DemonstrationSet, n_rollouts: int = N_ROLLOUTS) -> int:
    """The environment steps of one of ``policy_divergences``' KL."""
    return demonstrations.horizon * rollouts_measured(demonstrations, n_rollouts)


def policy_divergences(
    actor: Policies,
    demonstrations: DemonstrationSet,
    seed: Seed,
    *,
    n_rollouts: int = N_ROLLOUTS,
    common: bool = False,
    measure: Measure = demonstration_divergence,
) -> np.ndarray:
    """KL of demonstration j, or of the only one, against fresh rollouts of policy j: (n_strategies,) nats.

    ``common`` as in ``rollout``; ``measure``: another divergence, "other divergences fit too" (the paper).

    In a domain with ``matched_starts`` the rollouts start as the demonstration did (``rollouts_measured``);
    where the demonstrations hold no reset seeds, from as many random starts.
    """
    domain, shown, starts = demonstrations.domain, demonstrations.observations, None
    n_rollouts = rollouts_measured(demonstrations, n_rollouts)
    if domain.comparison.matched_starts:
        if demonstrations.reset_seeds is None:
            text = f"{domain.name}: the demonstrations hold no reset_seeds; rollouts start elsewhere"
            warnings.warn(text, stacklevel=2)
        else:
            known = np.broadcast_to(demonstrations.reset_seeds, (actor.n_strategies, shown.shape[1]))
            starts = np.tile(known, n_rollouts // shown.shape[1])
    data = rollout(
        domain, actor, n_rollouts, seed, reset_seeds=starts, horizon=demonstrations.horizon, common=common
    )
    pairs = zip(
        np.broadcast_to(shown, (actor.n_strategies, *shown.shape[1:])), data.observations, strict=True
    )
    return np.array([measure(domain, one, flown) for one, flown in pairs])
