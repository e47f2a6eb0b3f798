"""How near and how soon searches for mixture weights come: newcomers whose true weights are known (lesson
04)."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, demonstrations_from
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.divergence import divergence_floor, policy_divergences
from dmsrd_lite.method.policy_mixture import MixtureFit, Mixtures, likeliest_weights, weight_deviations

Finder = Callable[[Actor, DemonstrationSet, Seed], MixtureFit]


def newcomers(people: Actor, n: int, seed: Seed) -> tuple[DemonstrationSet, np.ndarray, np.ndarray]:
    """``n`` people who mix two or three of ``people``, with Dirichlet(1) weights (n, M): three trajectories
    each, and the floor of their KL (n,)."""
    rng, m = np.random.default_rng(extend(seed, 0)), people.n_strategies
    weights = np.zeros((n, m))
    for row in weights:
        parents = rng.permutation(m)[: min(m, 2 + int(rng.integers(2)))]
        row[parents] = rng.dirichlet(np.ones(len(parents)))
    acting = Mixtures(people, weights)
    first = rollout(people.domain, acting, 3, extend(seed, 1))
    second = rollout(people.domain, acting, 3, extend(seed, 2), reset_seeds=first.reset_seeds)
    shown, again = (demonstrations_from(data, acting) for data in (first, second))
    return shown, weights, divergence_floor(shown, again)


def compare(
    finders: dict[str, Finder], people: Actor, known: Actor, n: int, budgets: Sequence[int], seed: Seed
) -> Iterator[dict[str, Any]]:
    """A row for each newcomer, search and budget: ``known`` policies explain mixtures of ``people``.

    budget: so many of a search's candidates; the best of them by the search's own numbers is measured on
    fresh rollouts. steps: environment steps of these candidates; above_floor: its KL above the newcomer's
    floor (nats); error: largest difference to a true weight; deviation: largest Cramer-Rao bound of a weight
    among the parents (``weight_deviations``). One more row for the likeliest weights, which take no step.
    """
    shown, weights, floor = newcomers(people, n, seed)
    for i in range(n):
        one, rows = shown.select([i]), []
        parents = np.flatnonzero(weights[i])
        deviation = weight_deviations(known.select(parents), one, weights[i, parents]).max()
        for name, find in finders.items():
            fit = find(known, one, extend(seed, 3, i))
            for budget in budgets:
                best = fit.candidates[fit.divergences[:budget].argmin()]
                spent = fit.searched * min(budget, len(fit.candidates)) / len(fit.candidates)
                rows.append((name, budget, spent, best))
        rows.append(("likeliest actions", 0, 0.0, likeliest_weights(known, one)))
        candidates = np.array([best for *_, best in rows])
        kl = policy_divergences(Mixtures(known, candidates), one, extend(seed, 4, i))
        for (name, budget, steps, best), divergence in zip(rows, kl, strict=True):
            row = {"search": name, "newcomer": i, "budget": budget, "steps": steps}
            row["deviation"] = float(deviation)
            error = float(np.abs(best - weights[i]).max())
            yield {**row, "above_floor": float(divergence - floor[i]), "error": error}
