"""Who demonstrates: of the trained policies those that can do the task and differ, in kind first of all."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, demonstrations_from, plain
from dmsrd_lite.demonstrators.diayn import DiaynSettings, diversity_of
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import Actor, Policies
from dmsrd_lite.learning.rollouts import draw_reset_seeds, rollout
from dmsrd_lite.method.airl import clone_demonstrations
from dmsrd_lite.method.divergence import divergence_floor, divergence_table, policy_divergences
from dmsrd_lite.method.policy_mixture import Mixtures, MixtureSettings, likeliest_weights, search_mixture

OUTSIDE = 1.0  # nats above the own second take: who is nearer to mixtures of the others is one of them
DRAWS, FINALISTS = 5000, 4  # of sets of people
TRIALS = 20  # from fresh starts, in which nobody may fail


def good_flights(
    domain: Domain, actor: Policies, settings: DiaynSettings, n_shown: int, seed: int
) -> tuple[np.ndarray, list[DemonstrationSet]]:
    """Which starts are good, (m, starts) bool, and two takes of every policy from its first ``n_shown`` good
    ones.

    A start is good if the trajectories of both takes return at least ``domain.success_return`` and do not
    fail.
    """
    starts = draw_reset_seeds(
        np.random.default_rng([seed, 7]), actor.n_strategies, n_shown * settings.attempts
    )
    tried = [rollout(domain, actor, starts.shape[1], [seed, 8, take], reset_seeds=starts) for take in (0, 1)]
    good = np.all([(data.returns >= domain.success_return) & ~data.failed.any(-1) for data in tried], axis=0)
    first = np.argsort(~good, axis=1, kind="stable")[:, :n_shown]
    return good, [demonstrations_from(data.select_episodes(first), actor) for data in tried]


def distances(
    takes: list[DemonstrationSet], actor: Policies, seed: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """How far demonstration i is from person j, (m, m) nats above its own second take, and that, (m,).

    Against the other's demonstration; in a domain with ``matched_starts`` against rollouts of every policy
    from the demonstration's own starts.
    """
    shown, second = takes
    floor = divergence_floor(shown, second)
    if not shown.domain.comparison.matched_starts:
        return divergence_table(shown.domain, shown.observations) - floor[:, None], floor
    n, k = shown.observations.shape[:2]
    rows = [policy_divergences(actor, shown.select([i]), [*seed, i], n_rollouts=k) for i in range(n)]
    return np.array(rows) - floor[:, None], floor


def draw_in_turn(
    kinds: list[str], distance: np.ndarray, least: float, n_kept: int, rng: np.random.Generator
) -> list[int]:
    """People in a random order in which each is of the kind that is rarest so far, and nobody is too near.

    distance (m, m), nats: nobody is nearer than ``least`` to the others, in either direction.
    """
    apart, kept = np.minimum(distance, distance.T), list[int]()
    while len(kept) < n_kept:
        count = Counter(kinds[i] for i in kept)
        near = apart[:, kept].min(1, initial=np.inf)
        free = [i for i in range(len(kinds)) if i not in kept and near[i] >= least]
        if not free:
            break
        rarest = min(count[kinds[i]] for i in free)
        kept.append(int(rng.choice([i for i in free if count[kinds[i]] == rarest])))
    return kept


def choose_different(
    kinds: list[str],
    distance: np.ndarray,
    least: float,
    n_kept: int,
    outside: Callable[[list[int]], np.ndarray],
    seed: Seed,
) -> list[int]:
    """Of many draws (``draw_in_turn``) the one in which most people are no mixture of the others.

    Asked of the ``FINALISTS`` that are the most even in kinds, and then the farthest apart; ``outside(kept)``
    (len(kept),): nats from mixtures of the others. Fewer than ``n_kept`` where no draw finds so many.
    """
    rng = np.random.default_rng(seed)
    drawn = [draw_in_turn(kinds, distance, least, n_kept, rng) for _ in range(DRAWS)]
    apart = np.where(np.eye(len(kinds), dtype=bool), np.inf, np.minimum(distance, distance.T))

    def rank(kept: list[int]) -> tuple:
        counts = sorted(Counter(kinds[i] for i in kept).values(), reverse=True)
        return -len(kept), counts, -apart[np.ix_(kept, kept)].min(initial=np.inf)

    finalists = sorted({frozenset(kept): kept for kept in drawn}.values(), key=rank)[:FINALISTS]
    whole = [kept for kept in finalists if len(kept) == n_kept]
    return max(whole, key=lambda kept: (outside(kept) >= OUTSIDE).sum()) if whole else finalists[0]


def choose_demonstrators(
    domain: Domain, actor: Actor, settings: DiaynSettings, seed: int, n_kept: int, n_trajectories: int = 3
) -> tuple[np.ndarray, list[DemonstrationSet], dict]:
    """The most different of the successful policies: their indices, two takes of them, and the choice for the
    metadata.

    Success: ``n_trajectories`` good starts (``good_flights``), no failure in ``TRIALS`` (without
    ``matched_starts``), and a clone that fails no more often than 1 time in 20. Then ``choose_different``.
    ``InputError`` when too few are left.
    """
    comparison, describe = domain.comparison, diversity_of(domain).describe
    good, takes = good_flights(domain, actor, settings, n_trajectories, seed)
    fits = good.sum(1) >= n_trajectories
    fails = rollout(domain, actor, TRIALS, [seed, 9]).failed.any(-1).mean(1)
    clones = clone_demonstrations(takes[0], [seed, 11], n_steps=2000)[0].actor()
    clones_fail = rollout(domain, clones, TRIALS, [seed, 12]).failed.any(-1).mean(1)
    fits &= clones_fail - fails <= 0.05
    if not comparison.matched_starts:
        fits &= fails == 0
    able = np.flatnonzero(fits)
    takes, clones = [take.select(able) for take in takes], clones.select(able)
    people = [describe(shown) for shown in takes[0].observations]
    table, floor = (
        distances(takes, actor.select(able), [seed, 10]) if len(able) else (np.zeros((0, 0)), np.zeros(0))
    )

    def without(kept: list[int], row: int) -> tuple[list[int], Actor, DemonstrationSet]:
        others = [j for j in range(len(kept)) if j != row]
        return others, clones.select([kept[j] for j in others]), takes[0].select([kept[row]])

    def outside(kept: list[int]) -> np.ndarray:
        weights = np.zeros((len(kept), len(kept)))
        for row in range(len(kept)):
            others, known, one = without(kept, row)
            weights[row, others] = likeliest_weights(known, one)
        mixtures, shown = Mixtures(clones.select(kept), weights), takes[0].select(kept)
        return policy_divergences(mixtures, shown, [seed, 13]) - floor[kept]

    kinds = [str(person["kind"]) for person in people]
    kept = choose_different(kinds, table, comparison.others_at_least, n_kept, outside, [seed, 15])
    if len(kept) < n_kept:
        found = ", ".join(f"{n} {kind}" for kind, n in Counter(kinds).items())
        raise InputError(
            f"only {len(kept)} of {len(fits)} demonstrators of {domain.name} with seed {seed} succeed "
            f"({found}) and are {comparison.others_at_least} nats apart; expected {n_kept}"
        )
    chosen = table[np.ix_(kept, kept)] + np.where(np.eye(n_kept, dtype=bool), np.inf, 0.0)
    best = outside(kept)
    for row in range(n_kept):  # what its actions point at need not be the nearest
        _, known, one = without(kept, row)
        found = (
            search_mixture(known, one, MixtureSettings(24, 16), [seed, 14, row]).divergence - floor[kept[row]]
        )
        best[row] = min(best[row], found)
    choice = {
        "trained": len(fits),
        "successful": able,
        "kept": able[kept],
        "kind": [kinds[i] for i in kept],
        "people": [people[i] for i in kept],
        "own_divergence": floor[kept],
        "nearest_other": chosen.min(1),
        "above_mixtures_of_others": best,
        "good_starts": good[able[kept]].mean(1),
    }
    shown = [replace(take.select(kept), strategy_labels=np.arange(n_kept)) for take in takes]
    rounded = json.loads(json.dumps(plain(choice)), parse_float=lambda number: round(float(number), 3))
    return able[kept], shown, rounded
