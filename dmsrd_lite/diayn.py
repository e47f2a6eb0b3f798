"""Demonstrators by joint training on task reward + diversity (DIAYN): ``r + lambda (log q(z|s) - log 1/M)``."""

import dataclasses
import functools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dmsrd_lite.demonstrations import (
    SCHEMA_VERSION,
    DemonstrationSet,
    check_folder,
    demonstrations_from,
    save_demonstrations,
    write_atomically,
)
from dmsrd_lite.divergence import divergence_table, own_divergence
from dmsrd_lite.envs import Domain, InputError, Population
from dmsrd_lite.metrics import divergence_floor, policy_divergences
from dmsrd_lite.mixture import Mixtures, regress_weights
from dmsrd_lite.networks import Actor, BatchedMLP, GaussianPolicies, to_tensor
from dmsrd_lite.policy_optimization import TRAINING, TrainingSettings, clone_behavior, train_policies
from dmsrd_lite.rollouts import Rollouts, draw_reset_seeds, rollout

# Added to a generation's seed, so that the trainings share nothing.
TEST_SEED, DEVELOPMENT_SEED, POPULATION_SEED, LIFELONG_SEED = 1000, 2000, 3000, 5000
OUTSIDE = 1.0  # nats from any mixture of the others, for users who found strategies of their own: twice what lesson 06 allows


@dataclass(frozen=True)
class DiaynSettings:
    diversity_weight: float = 0.05  # lambda
    discriminator_steps: int = 20
    discriminator_batch: int = 200  # states of each strategy per step
    discriminator_rate: float = 1e-3
    training: TrainingSettings = TrainingSettings(n_strategies=20, n_iterations=160, episodes=4, last_rate=0.1)
    acting_noise: float = 0.8  # demonstrators act with this share of the sigma they were trained with
    attempts: int = 1  # starts that are tried for each one that is shown: nobody shows an attempt that failed


_FLIGHT = dataclasses.replace(TRAINING["lunar_lander"], n_strategies=20, n_iterations=240, last_rate=0.1)
SETTINGS = {"inverted_pendulum": DiaynSettings(), "lunar_lander": DiaynSettings(diversity_weight=0.06, training=_FLIGHT, attempts=4)}


class StrategyDiscriminator:
    """``q(z|s)``: which of M strategies was here, seen through ``domain.diversity_features`` in a population's units, with unit noise.

    The noise keeps strategies from settling for differences that nobody would see.
    """

    def __init__(self, n_features: int, n_strategies: int, settings: DiaynSettings, seed):
        self.settings = settings
        self.network = BatchedMLP(1, (n_features, 64, 64, n_strategies), seed)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=settings.discriminator_rate, fused=True)

    def update(self, features: np.ndarray, seed) -> tuple[np.ndarray, float]:
        """Cross-entropy steps on features (M, n, n_features); returns ``log q(z = j | s)`` (M, n) and the accuracy."""
        rng, s = np.random.default_rng(seed), self.settings
        m, n, d = features.shape
        x = to_tensor(features + rng.standard_normal(features.shape, dtype=np.float32))
        labels = torch.arange(m).repeat_interleave(s.discriminator_batch)
        for _ in range(s.discriminator_steps):
            pick = torch.from_numpy(rng.integers(0, n, s.discriminator_batch))
            logits = self.network(x[:, pick].reshape(1, -1, d))[0]
            self.optimizer.zero_grad()
            torch.nn.functional.cross_entropy(logits, labels).backward()
            self.optimizer.step()
        with torch.no_grad():
            log_q = torch.log_softmax(self.network(x.view(1, m * n, d))[0], 1).view(m, n, m)
        return log_q[torch.arange(m), :, torch.arange(m)].numpy(), float((logits.argmax(1) == labels).float().mean())


class DiversityReward:
    """``r + lambda (log q(z|s) - log 1/M)`` for the policy optimiser; updates q at every call and keeps its ``accuracy``."""

    def __init__(self, population: Population, settings: DiaynSettings, seed: int):
        self.units, self.weight, m = np.array(population.feature_units), settings.diversity_weight, settings.training.n_strategies
        self.discriminator = StrategyDiscriminator(len(self.units), m, settings, [seed, 2])
        self.accuracy = 1 / m

    def __call__(self, data: Rollouts, seed) -> np.ndarray:
        m, e, t = data.rewards.shape
        features = (data.domain.diversity_features(data.observations) / self.units).reshape(m, e * t, -1)
        log_q, self.accuracy = self.discriminator.update(features, seed)
        return data.rewards + self.weight * (log_q.reshape(m, e, t) + np.log(m))


def train_demonstrators(domain: Domain, population: Population, settings: DiaynSettings, seed: int, n_threads: int = 0) -> Iterator[dict]:
    """Train M demonstrators together: the records of ``train_policies``, with the ``accuracy`` of q(z|s)."""
    reward = DiversityReward(population, settings, seed)
    training = dataclasses.replace(settings.training, last_sigma=population.last_sigma)
    for record in train_policies(domain, reward, training, seed, n_threads):
        yield {**record, "accuracy": reward.accuracy}


def most_distinct(distance: np.ndarray, n_kept: int) -> list[int]:
    """Greedy choice of ``n_kept`` strategies: again and again drop one of the closest pair, the one nearer to the rest.

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
    """How different strategies look: the largest difference of their mean diversity features, in the finest units.

    observations (m, k, T+1, obs_dim) -> (m, m).
    """
    units = np.min([population.feature_units for population in domain.demonstrators], axis=0)
    means = (domain.diversity_features(observations) / units).mean((1, 2))
    return np.abs(means[:, None] - means[None]).max(-1)


def distances(domain: Domain, shown: DemonstrationSet, actor, seed) -> tuple[np.ndarray, np.ndarray]:
    """How far strategies are apart, (m, m) nats, and each one's distance from itself, (m,).

    Demonstrations against each other; in a domain with ``matched_starts`` against rollouts of every policy from the
    demonstration's starts, less what its own policy reaches from there.
    """
    if not domain.matched_starts:
        table = divergence_table(domain, shown.observations)
        return table, np.diag(table)
    k = shown.observations.shape[1]
    table = np.array([policy_divergences(actor, shown.select([i]), [*seed, i], n_rollouts=k) for i in range(shown.n_demonstrations)])
    return table - np.diag(table)[:, None], np.diag(table)


def good_flights(domain: Domain, actor: Actor, settings: DiaynSettings, n_shown: int, seed: int) -> tuple[np.ndarray, list]:
    """Which starts are good, (m, starts) bool, and two takes of ``n_shown`` trajectories of every policy from its first good ones.

    A start is good if the trajectories of both takes return at least ``domain.success_return`` and do not fail.
    """
    starts = draw_reset_seeds(np.random.default_rng([seed, 7]), actor.n_strategies, n_shown * settings.attempts)
    tried = [rollout(domain, actor, starts.shape[1], [seed, 8, take], reset_seeds=starts) for take in (0, 1)]
    good = np.all([(data.returns >= domain.success_return) & ~data.failed.any(-1) for data in tried], axis=0)
    first = np.argsort(~good, axis=1, kind="stable")[:, :n_shown]
    return good, [demonstrations_from(data.select_episodes(first), actor) for data in tried]


def train_all_demonstrators(domain: Domain, settings: DiaynSettings, seed: int, progress=iter) -> Actor:
    """The policies of all of the domain's populations, as they act when they demonstrate."""
    actors = []
    for number, population in enumerate(domain.demonstrators):
        *_, last = progress(train_demonstrators(domain, population, settings, seed + number * POPULATION_SEED))
        actors.append(last["policies"].actor())
    actor = Actor.joined(actors)
    return actor.select(np.arange(actor.n_strategies), settings.acting_noise)


def choose_demonstrators(
    domain: Domain, actor: Actor, settings: DiaynSettings, seed: int, n_kept: int, n_trajectories: int = 3, *, spanning: bool = False
) -> tuple[np.ndarray, list[DemonstrationSet], dict]:
    """The most distinct of the successful policies: their indices, two takes of them, and the choice for the metadata.

    Success: ``n_trajectories`` good starts (``good_flights``), and (without ``matched_starts`` or ``spanning``) a demonstrator's
    own trajectories within ``domain.kl_threshold`` of each other. Of the successful ones those are kept that look most
    different (with ``matched_starts``: are most nats apart), at least ``domain.kl_margin`` nats apart (``distances``); or, with
    ``spanning``, those that are at least ``OUTSIDE`` nats from mixtures of each other (``farthest_from_mixtures``).
    ``InputError`` when too few are left.
    """
    good, shown = good_flights(domain, actor, settings, n_trajectories, seed)
    fits = good.sum(1) >= n_trajectories
    if not (domain.matched_starts or spanning):
        fits &= np.array([own_divergence(domain, o) <= domain.kl_threshold for o in shown[0].observations])
    kept, smallest, own, least = np.flatnonzero(fits), 0.0, np.zeros(1), OUTSIDE if spanning else domain.kl_margin
    if len(kept) >= n_kept and spanning:
        pick, far, own = farthest_from_mixtures(actor.select(kept), shown[0].select(kept), n_kept, [seed, 10])
        kept, smallest = kept[pick], far.min() if len(pick) == n_kept else 0.0
    elif len(kept) >= n_kept:
        table, own = distances(domain, shown[0].select(kept), actor.select(kept), [seed, 10])
        nearness = table / domain.kl_margin - 1  # below 0: too near, and dropped first
        look = table if domain.matched_starts else visible_distance(domain, shown[0].observations[kept])
        pick = most_distinct(np.where(np.minimum(nearness, nearness.T) < 0, nearness, look), n_kept)
        smallest = table[np.ix_(pick, pick)][~np.eye(n_kept, dtype=bool)].min()
        kept = kept[pick]
    if smallest < least:
        raise InputError(
            f"only {fits.sum()} of {len(fits)} demonstrators of {domain.name} with seed {seed} succeeded, the nearest two kept "
            f"{smallest:.1f} nats apart; expected {n_kept} at least {least} apart: train longer or take another seed"
        )
    choice = {"trained": len(fits), "good_starts": good.mean(1), "successful": np.flatnonzero(fits), "kept": kept,
              "smallest_divergence": smallest, "largest_own": own[pick].max()}  # fmt: skip
    takes = [dataclasses.replace(everybody.select(kept), strategy_labels=np.arange(n_kept)) for everybody in shown]
    return kept, takes, {name: np.round(value, 3).tolist() for name, value in choice.items()}


def farthest_from_mixtures(actor: Actor, shown: DemonstrationSet, n_kept: int, seed) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Demonstrators none of whom is a mixture of the others, judged as a learner would, by their clones: farthest first.

    Distance: KL of the demonstration under the mixture of the kept clones that its actions point at (``regress_weights``), less
    the KL under its own clone. Who comes within ``OUTSIDE`` of mixtures of those kept later is dropped again. Left out are
    those who cannot be imitated: whose clone is half of ``OUTSIDE`` farther, or fails 1 time in 20 more often, than they are.
    Returns the indices, each one's distance from mixtures of the other kept ones, and the demonstrators' own KLs, all.
    """
    domain, everyone = shown.domain, np.arange(shown.n_demonstrations)
    states, actions, _ = shown.transitions()
    cloned = GaussianPolicies(domain, len(everyone), [*seed, 3])
    clone_behavior(cloned, to_tensor(domain.network_input(states)), to_tensor(actions), [*seed, 4], n_steps=2000)
    clones = cloned.actor()
    own, reached = (policy_divergences(some, shown, [*seed, 0]) for some in (actor, clones))
    fails, clones_fail = (rollout(domain, some, 20, [*seed, 5]).failed.any(-1).mean(1) for some in (actor, clones))
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


def generate_demonstrations(
    domain: Domain,
    seed: int,
    folder: Path,
    *,
    settings: DiaynSettings | None = None,
    n_kept: int = 10,
    n_trajectories: int = 3,
    progress=iter,
) -> dict:
    """Train demonstrators, choose among them (``choose_demonstrators``), write their demonstrations and a second take.

    Returns the choice as written into the files' metadata; ``InputError`` when too few are left (nothing is written then).
    """
    settings = settings or SETTINGS[domain.name]
    paths = {take: check_folder(Path(folder) / f"{domain.name}_{take}.npz") for take in ("demonstrations", "second_take")}
    actor = train_all_demonstrators(domain, settings, seed, progress)
    _, shown, choice = choose_demonstrators(domain, actor, settings, seed, n_kept, n_trajectories)
    metadata = {"seed": seed, "choice": choice, "settings": dataclasses.asdict(settings),
                "made_by": f"python -m dmsrd_lite generate {domain.name} --seed {seed}"}  # fmt: skip
    for (take, path), some in zip(paths.items(), shown, strict=True):
        save_demonstrations(path, dataclasses.replace(some, metadata={**metadata, "take": take}))
    return choice


def draw_mixtures(
    domain: Domain, actor: Actor, settings: DiaynSettings, seed: int, n_mixtures: int, least_return: float, n_trajectories: int = 3
) -> tuple[np.ndarray, list[DemonstrationSet], int]:
    """Users who are mixtures of an actor's policies: weights (n, M) from Dirichlet(1), two takes, and how many were redrawn.

    A mixture is redrawn when too few of its starts are good (``good_flights``) or its mean return is below ``least_return``.
    """
    rng, weights, parts, n_redrawn = np.random.default_rng([seed, 20]), np.zeros((0, actor.n_strategies)), [], 0
    while len(weights) < n_mixtures:
        drawn = rng.dirichlet(np.ones(actor.n_strategies), n_mixtures - len(weights))
        good, shown = good_flights(domain, Mixtures(actor, drawn), settings, n_trajectories, seed + 1 + n_redrawn)
        fits = (good.sum(1) >= n_trajectories) & (shown[0].returns.mean(1) >= least_return)
        if not fits.any() and n_redrawn > 10 * n_mixtures:
            raise InputError(f"{n_redrawn} mixtures of {domain.name} failed one after the other; expected base policies that mix well")
        weights, n_redrawn = np.vstack([weights, drawn[fits]]), n_redrawn + int((~fits).sum())
        parts.append([take.select(np.flatnonzero(fits)) for take in shown])
    takes = [functools.reduce(DemonstrationSet.joined, some) for some in zip(*parts, strict=True)]
    return weights, takes, n_redrawn


def generate_lifelong(
    domain: Domain, seed: int, folder: Path, *, settings: DiaynSettings | None = None, n_base: int = 5, n_mixtures: int = 95, progress=iter
) -> dict:
    """Train demonstrators, choose ``n_base`` of them, and write their demonstrations and those of mixtures of them: a stream of users.

    Beside the choice, the file's metadata holds what is for evaluation only: the true ``weights`` (n, n_base), the
    demonstrators' ``floor`` (n,) in nats (from a second take) and ``returns`` (n,).
    """
    settings = settings or SETTINGS[domain.name]
    path = check_folder(Path(folder) / f"{domain.name}_lifelong.npz")
    actor = train_all_demonstrators(domain, settings, seed, progress)
    kept, takes, choice = choose_demonstrators(domain, actor, settings, seed, n_base, spanning=True)
    returns = takes[0].returns.mean(1)
    least = returns.min() - np.ptp(returns)  # clearly below the worst: by more than the best is above it
    weights, mixed, n_redrawn = draw_mixtures(domain, actor.select(kept), settings, seed + LIFELONG_SEED, n_mixtures, least)
    shown, again = (base.joined(more) for base, more in zip(takes, mixed, strict=True))
    labels = {"weights": np.vstack([np.eye(n_base), weights]), "floor": divergence_floor(shown, again), "returns": shown.returns.mean(1)}
    metadata = {"seed": seed, "choice": {**choice, "redrawn": n_redrawn}, "settings": dataclasses.asdict(settings),
                "made_by": f"python -m dmsrd_lite generate {domain.name} --lifelong --seed {seed}"}  # fmt: skip
    metadata |= {name: np.round(value, 4).tolist() for name, value in labels.items()}
    small = {name: getattr(shown, name).astype(np.float32) for name in ("observations", "actions")}  # half the size of the file
    shown = dataclasses.replace(shown, **small, rewards=None, strategy_labels=None, metadata=metadata)
    save_demonstrations(path, shown)
    return metadata["choice"]


def generate_test_set(
    domain: Domain,
    seed: int,
    path: Path,
    *,
    settings: DiaynSettings | None = None,
    n_snapshots: int = 100,
    n_episodes: int = 10,
    stride: int = 10,
    progress=iter,
) -> Path:
    """Trajectories of ten new policies at ``n_snapshots`` moments of a separate training, from failure to success.

    Writes the arrays of ``RewardTestSet``, ``observations`` in half precision.
    """
    path = check_folder(path)
    if settings is None:
        usual = SETTINGS[domain.name]
        training = dataclasses.replace(usual.training, n_strategies=10, n_iterations=120, last_rate=1.0)
        settings = dataclasses.replace(usual, training=training)
    moments = set(np.linspace(0, settings.training.n_iterations - 1, n_snapshots).astype(int).tolist())
    states, returns, every_step = [], [], []
    for record in progress(train_demonstrators(domain, domain.test_population, settings, seed)):
        if record["iteration"] in moments:
            data = rollout(domain, record["policies"].actor(), n_episodes, [seed, 9, record["iteration"]])
            states.append(data.observations[:, :, stride::stride].reshape(-1, domain.horizon // stride, domain.obs_dim).astype(np.float16))
            returns.append(data.returns.reshape(-1))
            every_step.append(data.rewards_every_step.sum(-1).reshape(-1))
    policy = np.tile(np.repeat(np.arange(settings.training.n_strategies), n_episodes), len(states))
    snapshot = np.repeat(np.arange(len(states)), settings.training.n_strategies * n_episodes)
    metadata = {
        "domain": domain.name,
        "schema_version": SCHEMA_VERSION,
        "stride": stride,
        "seed": seed,
        "settings": dataclasses.asdict(settings),
    }
    return write_atomically(
        path,
        lambda f: np.savez_compressed(
            f,
            observations=np.concatenate(states),
            returns=np.concatenate(returns).astype(np.float32),
            returns_every_step=np.concatenate(every_step).astype(np.float32),
            policy=policy.astype(np.uint8),
            snapshot=snapshot.astype(np.uint8),
            metadata=np.array(json.dumps(metadata)),
        ),
    )
