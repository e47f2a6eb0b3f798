"""The smallest set of strategies that explains everybody. The paper: "Future work"."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import InputError
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.method.policy_mixture import MixtureSettings, check_weights, search_mixture


@dataclass(frozen=True)
class SpanningSet:
    kept: tuple[int, ...]  # strategies, in their order
    weights: np.ndarray  # (n, len(kept)): what explains each demonstration now
    divergences: dict[int, float]  # nats, of the demonstrations whose weights were searched anew
    steps: int  # environment steps spent, on failed attempts, too


def spanning_set(
    actor: Actor,
    demonstrations: DemonstrationSet,
    weights: ArrayLike,
    thresholds: ArrayLike,
    settings: MixtureSettings,
    seed: Seed,
) -> SpanningSet:
    """Strategies go one by one, those with the least total weight first, as long as mixtures of the others
    come below eps for everybody who used them.

    ``weights`` (n, M) explain the n demonstrations now; ``thresholds`` (n,) are their eps in nats. Backward
    elimination: each strategy is tried once; no strategy of the set that is found can go alone (as far as the
    search of ``settings`` sees), but a smaller one may exist. Whoever uses none of a strategy is not asked
    again when it goes.
    """
    w, eps = check_weights(weights, actor.n_strategies), np.asarray(thresholds, dtype=np.float64)
    if (n := demonstrations.n_demonstrations) != len(w) or eps.shape != (n,):
        found = f"{len(w)} rows of weights and thresholds of shape {eps.shape}"
        raise InputError(f"{found} for {n} demonstrations: expected one of each for each demonstration")
    kept, divergences, steps = list(range(actor.n_strategies)), dict[int, float](), 0
    for gone in np.argsort(w.sum(0), kind="stable").tolist():
        rest = [j for j in kept if j != gone]
        if not rest:
            break
        others, changed, measured = actor.select(rest), w.copy(), dict[int, float]()
        changed[:, gone] = 0
        for i in np.flatnonzero(w[:, gone] > 1e-6).tolist():
            own_seed = extend(seed, gone, i)
            fit = search_mixture(others, demonstrations.select([i]), settings, own_seed, enough=eps[i])
            steps += fit.steps
            if fit.divergence >= eps[i]:
                break
            changed[i], measured[i] = 0, fit.divergence
            changed[i, rest] = fit.weights
        else:
            kept, w, divergences = rest, changed / changed.sum(1, keepdims=True), divergences | measured
    return SpanningSet(tuple(kept), w[:, kept], divergences, steps)
