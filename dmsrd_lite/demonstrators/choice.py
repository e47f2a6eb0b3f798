"""Who demonstrates: of the trained policies those that can do the task and differ."""

from dataclasses import replace

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, demonstrations_from
from dmsrd_lite.demonstrators.diayn import DiaynSettings, diversity_of
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.networks import Actor, Policies
from dmsrd_lite.learning.rollouts import draw_reset_seeds, rollout
from dmsrd_lite.method.airl import clone_demonstrations
from dmsrd_lite.method.divergence import divergence_table, own_divergence, policy_divergences
from dmsrd_lite.method.policy_mixture import Mixtures, regress_weights

OUTSIDE = (
    1.0  # nats from any mixture of the others, for users who found strategies: twice what lesson 06 allows
)


def most_distinct(distance: np.ndarray, n_kept: int) -> list[int]:
    """Greedy choice of ``n_kept`` strategies: again and again drop one of the closest pair, the one nearer to
    the rest.

    distance (m, m): the diagonal is not read, a pair's distance is the smaller of its two directions.
    """
    distance = np.minimum(distance, distance.T).astype(float)
    np.fill_diagonal(distance, np.inf)
    left = list(range(len(distance)))
    while len(left) > n_kept:
        sub = distance[np.ix_(left, left)]
        pair = np.unravel_index(sub.argmin(), sub.shape)
        left.pop(min(pair, key=lambda i: tuple(np.sort(sub[i]))))
    return left


def visible_distance(domain: Domain, observations: np.ndarray) -> np.ndarray:
    """How different strategies look: the largest difference of their mean diversity features, in the finest
    units.

    observations (m, k, T+1, obs_dim) -> (m, m).
    """
    diversity = diversity_of(domain)
    units = np.min([population.feature_units for population in diversity.populations], axis=0)
    means = (diversity.features(observations) / units).mean((1, 2))
    return np.abs(means[:, None] - means[None]).max(-1)


def distances(shown: DemonstrationSet, actor: Policies, seed: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """How far strategies are apart, (m, m) nats, and each one's distance from itself, (m,).

    Demonstrations against each other; in a domain with ``matched_starts`` against rollouts of every policy
    from the demonstration's starts, less what its own policy reaches from there.
    """
    n, k = shown.observations.shape[:2]
    if not shown.domain.comparison.matched_starts:
        table = divergence_table(shown.domain, shown.observations)
        return table, np.diag(table)
    table = np.array(
        [policy_divergences(actor, shown.select([i]), [*seed, i], n_rollouts=k) for i in range(n)]
    )
    return table - np.diag(table)[:, None], np.diag(table)


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


def choose_demonstrators(
    domain: Domain,
    actor: Actor,
    settings: DiaynSettings,
    seed: int,
    n_kept: int,
    n_trajectories: int = 3,
    *,
    spanning: bool = False,
) -> tuple[np.ndarray, list[DemonstrationSet], dict]:
    """The most distinct of the successful policies: their indices, two takes of them, and the choice for the
    metadata.

    Success: ``n_trajectories`` good starts (``good_flights``), and (without ``matched_starts`` or
    ``spanning``) own trajectories within ``comparison.own_at_most`` of each other. Of the successful ones
    those are kept that look most different (with ``matched_starts``: are most nats apart),
    ``comparison.others_at_least`` nats apart (``distances``); or, with ``spanning``, those that are
    ``OUTSIDE`` nats from mixtures of each other (``farthest_from_mixtures``). ``InputError`` when too few are
    left.
    """
    comparison = domain.comparison
    good, shown = good_flights(domain, actor, settings, n_trajectories, seed)
    fits = good.sum(1) >= n_trajectories
    if not (comparison.matched_starts or spanning):
        fits &= np.array([own_divergence(domain, o) <= comparison.own_at_most for o in shown[0].observations])
    kept, smallest, own = np.flatnonzero(fits), 0.0, np.zeros(1)
    least = OUTSIDE if spanning else comparison.others_at_least
    pick: list[int] = []
    if len(kept) >= n_kept and spanning:
        pick, far, own = farthest_from_mixtures(actor.select(kept), shown[0].select(kept), n_kept, [seed, 10])
        kept, smallest = kept[pick], far.min() if len(pick) == n_kept else 0.0
    elif len(kept) >= n_kept:
        table, own = distances(shown[0].select(kept), actor.select(kept), [seed, 10])
        nearness = table / comparison.others_at_least - 1  # below 0: too near, and dropped first
        look = table if comparison.matched_starts else visible_distance(domain, shown[0].observations[kept])
        pick = most_distinct(np.where(np.minimum(nearness, nearness.T) < 0, nearness, look), n_kept)
        smallest = table[np.ix_(pick, pick)][~np.eye(n_kept, dtype=bool)].min()
        kept = kept[pick]
    if smallest < least or len(pick) < n_kept:
        raise InputError(
            f"only {fits.sum()} of {len(fits)} demonstrators of {domain.name} with seed {seed} succeeded, "
            f"the nearest two kept {smallest:.1f} nats apart; expected {n_kept} at least {least} apart"
        )
    choice = {
        "trained": len(fits),
        "good_starts": good.mean(1),
        "successful": np.flatnonzero(fits),
        "kept": kept,
        "smallest_divergence": smallest,
        "largest_own": own[pick].max(),
    }
    takes = [replace(everybody.select(kept), strategy_labels=np.arange(n_kept)) for everybody in shown]
    return kept, takes, {name: np.round(value, 3).tolist() for name, value in choice.items()}


def farthest_from_mixtures(
    actor: Actor, shown: DemonstrationSet, n_kept: int, seed: list[int]
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Demonstrators none of whom is a mixture of the others, judged as a learner would, by their clones:
    farthest first.

    Distance: KL of the demonstration under the mixture of the kept clones that its actions point at
    (``regress_weights``), less the KL under its own clone. Who comes within ``OUTSIDE`` of mixtures of those
    kept later is dropped again. Left out are those who cannot be imitated: whose clone is half of ``OUTSIDE``
    farther, or fails 1 time in 20 more often. Returns the indices, each one's distance from mixtures of the
    other kept ones, and the demonstrators' own KLs, all.
    """
    domain, everyone = shown.domain, np.arange(shown.n_demonstrations)
    cloned, _ = clone_demonstrations(shown, seed, n_steps=2000, streams=(3, 4))
    clones = cloned.actor()
    own, reached = (policy_divergences(some, shown, [*seed, 0]) for some in (actor, clones))
    fails, clones_fail = (
        rollout(domain, some, 20, [*seed, 5]).failed.any(-1).mean(1) for some in (actor, clones)
    )
    left = list(everyone[(reached - own <= OUTSIDE / 2) & (clones_fail - fails <= 0.05)])

    def distance(kept: list[int], who: list[int]) -> np.ndarray:
        known = clones.select(kept)
        weights = [regress_weights(known, shown.select([i])) for i in who]
        return policy_divergences(Mixtures(known, weights), shown.select(who), [*seed, 1]) - reached[who]

    kept: list[int] = []
    while left and len(kept) < n_kept:
        far = distance(kept or [left[0]], left)
        kept.append(left.pop(int(far.argmax())))
        for i in kept[:-1]:
            if len(kept) > 2 and distance([j for j in kept if j != i], [i])[0] < OUTSIDE:
                kept.remove(i)
    return kept, np.array([distance([j for j in kept if j != i], [i])[0] for i in kept]), own
