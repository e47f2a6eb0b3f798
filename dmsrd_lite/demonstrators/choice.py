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
SEARCH = MixtureSettings(24, 16)  # for the mixture of the others that is nearest to somebody
N_SHOWN = 3  # trajectories of each person
TRIALS = 20  # from fresh starts, in which nobody may fail


def good_flights(
    domain: Domain, actor: Policies, settings: DiaynSettings, seed: int
) -> tuple[np.ndarray, list[DemonstrationSet]]:
    """Which starts are good, (m, starts) bool, and two takes of every policy from its first ``N_SHOWN`` good
    ones.

    A start is good if the trajectories of both takes return at least ``domain.success_return`` and do not
    fail.
    """
    rng = np.random.default_rng([seed, 7])
    starts = draw_reset_seeds(rng, actor.n_strategies, N_SHOWN * settings.attempts)
    tried = [rollout(domain, actor, starts.shape[1], [seed, 8, take], reset_seeds=starts) for take in (0, 1)]
    good = np.all([(data.returns >= domain.success_return) & ~data.failed.any(-1) for data in tried], axis=0)
    first = np.argsort(~good, axis=1, kind="stable")[:, :N_SHOWN]
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
    kinds: list[str], apart: np.ndarray, least: float, n_kept: int, rng: np.random.Generator
) -> list[int]:
    """People in a random order in which each is of the kind that is rarest so far, and nobody is too near.

    apart (m, m), nats, symmetric: nobody is nearer than ``least`` to the others.
    """
    kept = list[int]()
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

    distance (m, m), nats: nobody is nearer than ``least`` to the others, in either direction. Asked are the
    ``FINALISTS`` that are the most even in kinds, and then the farthest apart; ``outside(kept)``
    (len(kept),): nats from mixtures of the others. Fewer than ``n_kept`` where no draw finds so many.
    """
    rng, apart = np.random.default_rng(seed), _between(np.minimum(distance, distance.T))
    drawn = [draw_in_turn(kinds, apart, least, n_kept, rng) for _ in range(DRAWS)]

    def rank(kept: list[int]) -> tuple:
        counts = sorted(Counter(kinds[i] for i in kept).values(), reverse=True)
        return -len(kept), counts, -apart[np.ix_(kept, kept)].min(initial=np.inf)

    finalists = sorted({frozenset(kept): kept for kept in drawn}.values(), key=rank)[:FINALISTS]
    whole = [kept for kept in finalists if len(kept) == n_kept]
    return max(whole, key=lambda kept: (outside(kept) >= OUTSIDE).sum()) if whole else finalists[0]


def _between(table: np.ndarray) -> np.ndarray:
    """A table (m, m) without its diagonal, which no minimum shall find."""
    return np.where(np.eye(len(table), dtype=bool), np.inf, table)


def successful(
    domain: Domain, actor: Actor, shown: DemonstrationSet, good: np.ndarray, seed: int
) -> tuple[np.ndarray, Actor]:
    """Who can do the task, indices, and clones of everybody.

    As many ``good`` starts (m, starts) as are shown, no failure in ``TRIALS`` (without ``matched_starts``),
    and a clone that fails no more often than 1 time in 20.
    """
    fails = rollout(domain, actor, TRIALS, [seed, 9]).failed.any(-1).mean(1)
    clones = clone_demonstrations(shown, [seed, 11], n_steps=2000).actor()
    clones_fail = rollout(domain, clones, TRIALS, [seed, 12]).failed.any(-1).mean(1)
    fits = (good.sum(1) >= shown.actions.shape[1]) & (clones_fail - fails <= 0.05)
    return np.flatnonzero(fits & (domain.comparison.matched_starts | (fails == 0))), clones


def _without(clones: Actor, row: int) -> tuple[list[int], Actor]:
    others = [j for j in range(clones.n_strategies) if j != row]
    return others, clones.select(others)


def pointed_at(clones: Actor, shown: DemonstrationSet, seed: Seed) -> np.ndarray:
    """KL of each demonstration under the mixture of the others' clones that its actions point at, (n,)."""
    weights = np.zeros((clones.n_strategies, clones.n_strategies))
    for row in range(clones.n_strategies):
        others, known = _without(clones, row)
        weights[row, others] = likeliest_weights(known, shown.select([row]))
    return policy_divergences(Mixtures(clones, weights), shown, seed)


def searched_for(clones: Actor, shown: DemonstrationSet, seed: list[int]) -> np.ndarray:
    """The same for the mixture that a search finds: what actions point at need not be the nearest."""
    each = (
        (_without(clones, row)[1], shown.select([row]), [*seed, row]) for row in range(clones.n_strategies)
    )
    return np.array([search_mixture(known, one, SEARCH, s).divergence for known, one, s in each])


def choose_demonstrators(
    domain: Domain, actor: Actor, settings: DiaynSettings, seed: int, n_kept: int
) -> tuple[np.ndarray, list[DemonstrationSet], dict]:
    """The most different of the successful policies: their indices, two takes of them, and the choice for the
    metadata.

    ``successful``, then ``choose_different``. ``InputError`` when too few are left.
    """
    good, takes = good_flights(domain, actor, settings, seed)
    able, clones = successful(domain, actor, takes[0], good, seed)
    takes, clones = [take.select(able) for take in takes], clones.select(able)
    people = [diversity_of(domain).describe(shown) for shown in takes[0].observations]
    kinds, least = [str(person["kind"]) for person in people], domain.comparison.others_at_least
    table, floor = np.zeros((0, 0)), np.zeros(0)
    if len(able):
        table, floor = distances(takes, actor.select(able), [seed, 10])

    def outside(kept: list[int]) -> np.ndarray:
        return pointed_at(clones.select(kept), takes[0].select(kept), [seed, 13]) - floor[kept]

    kept = choose_different(kinds, table, least, n_kept, outside, [seed, 15])
    if len(kept) < n_kept:
        found = ", ".join(f"{n} {kind}" for kind, n in Counter(kinds).items())
        raise InputError(
            f"only {len(kept)} of {len(good)} demonstrators of {domain.name} with seed {seed} succeed "
            f"({found}) and are {least} nats apart; expected {n_kept}"
        )
    searched = searched_for(clones.select(kept), takes[0].select(kept), [seed, 14]) - floor[kept]
    choice = {
        "trained": len(good),
        "successful": able,
        "kept": able[kept],
        "kind": [kinds[i] for i in kept],
        "people": [people[i] for i in kept],
        "own_divergence": floor[kept],
        "nearest_other": _between(table[np.ix_(kept, kept)]).min(1),
        "above_mixtures_of_others": np.minimum(outside(kept), searched),
        "good_starts": good[able[kept]].mean(1),
    }
    shown = [replace(take.select(kept), strategy_labels=np.arange(n_kept)) for take in takes]
    rounded = json.loads(json.dumps(plain(choice)), parse_float=lambda number: round(float(number), 3))
    return able[kept], shown, rounded
