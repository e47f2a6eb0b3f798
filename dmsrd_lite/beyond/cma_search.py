"""Mixture weights by CMA-ES. The paper: "Future work"; Hansen and Ostermeier (2001)."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.method.divergence import Measure, demonstration_divergence
from dmsrd_lite.method.policy_mixture import MixtureFit, MixtureSettings, Search


@dataclass(frozen=True)
class CMASettings:
    population: int = 12  # candidates of a generation, one batch of rollouts
    generations: int = 8
    first_step: float = 1.5  # deviation of the first generation's logits


def search_by_cma(
    actor: Actor,
    demonstration: DemonstrationSet,
    settings: MixtureSettings,
    seed: Seed,
    cma_settings: CMASettings = CMASettings(),
    *,
    measure: Measure = demonstration_divergence,
) -> MixtureFit:
    """Equation 3 by covariance matrix adaptation on logits z, ``w = softmax(z)``, from equal weights.

    Of ``settings`` the numbers of rollouts, the finalists and ``common`` count. Every generation is one batch
    of rollouts; the best are measured again at the end as in ``search_mixture``.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it looks for plotting packages when it is imported
        import cma

    search, s = Search(actor, demonstration, settings, seed, measure), cma_settings
    start = int(np.random.default_rng(seed).integers(1, 2**31 - 1))
    options = {"popsize": s.population, "seed": start, "verbose": -9, "tolfun": 0, "tolx": 0}
    strategy = cma.CMAEvolutionStrategy(np.zeros(actor.n_strategies), s.first_step, options)
    candidates, divergences = [], []
    for generation in range(s.generations):
        logits = strategy.ask()
        weights = softmax(np.array(logits), axis=1)
        part = 1 if settings.common else 10 + generation
        found = search.measure(weights, part, settings.search_rollouts)
        strategy.tell(logits, found.tolist())
        candidates.append(weights)
        divergences.append(found)
    return search.best(np.concatenate(candidates), np.concatenate(divergences))
