"""Demonstrations as files: ten people, and a stream of five of them and mixtures of these."""

import functools
import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from dmsrd_lite.demonstrations import (
    DemonstrationSet,
    check_folder,
    load_demonstrations,
    plain,
    save_demonstrations,
)
from dmsrd_lite.demonstrators.choice import N_SHOWN, choose_demonstrators, good_flights
from dmsrd_lite.demonstrators.diayn import POPULATION_SEED, DiaynSettings, diversity_of, train_demonstrators
from dmsrd_lite.demonstrators.people import load_demonstrators, save_demonstrators
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.method.divergence import divergence_floor
from dmsrd_lite.method.policy_mixture import Mixtures

LIFELONG_SEED = 5000  # added to a generation's seed for the mixtures


def train_all_demonstrators(
    domain: Domain, settings: DiaynSettings, seed: int, folder: Path, progress: Callable
) -> Actor:
    """The policies of all of the domain's populations, as they act when they demonstrate.

    A population that ``folder`` holds, trained with this seed and these settings, is not trained again.
    """
    actors = []
    for number, population in enumerate(diversity_of(domain).populations):
        made_with = json.dumps(plain({"seed": seed, "population": asdict(population), **asdict(settings)}))
        path = folder / f"{domain.name}_population_{number}.safetensors"
        known = load_demonstrators(path, domain) if path.exists() else None
        if known is None or known[1] != made_with:
            own_seed = seed + number * POPULATION_SEED
            *_, last = progress(train_demonstrators(domain, population, settings, own_seed))
            known = last["policies"].actor(), made_with
            save_demonstrators(path, *known)
        actors.append(known[0])
    actor = Actor.joined(actors)
    return actor.select(np.arange(actor.n_strategies), settings.acting_noise)


def generate_demonstrations(
    domain: Domain,
    settings: DiaynSettings,
    seed: int,
    folder: Path,
    *,
    n_kept: int = 10,
    progress: Callable = iter,
) -> dict:
    """Train demonstrators, choose among them (``choose_demonstrators``), write them, their demonstrations and
    a second take.

    Returns the choice as written into the files' metadata; ``InputError`` if too few are left (nothing is
    written then but the trained populations, which another call does not train again).
    """
    takes = ("demonstrations", "second_take")
    paths = {take: check_folder(folder / f"{domain.name}_{take}.npz") for take in takes}
    actor = train_all_demonstrators(domain, settings, seed, folder / ".populations", progress)
    kept, shown, choice = choose_demonstrators(domain, actor, settings, seed, n_kept)
    made_by = f"python -m dmsrd_lite generate {domain.name} --seed {seed}"
    metadata = {"seed": seed, "choice": choice, "settings": asdict(settings), "made_by": made_by}
    save_demonstrators(folder / f"{domain.name}_demonstrators.safetensors", actor.select(kept), made_by)
    for (take, path), some in zip(paths.items(), shown, strict=True):
        save_demonstrations(path, replace(some, metadata={**metadata, "take": take}))
    return choice


def draw_mixtures(
    domain: Domain, actor: Actor, settings: DiaynSettings, seed: int, n_mixtures: int, least_return: float
) -> tuple[np.ndarray, list[DemonstrationSet], int]:
    """Users who are mixtures of an actor's policies: weights (n, M) from Dirichlet(1), two takes, how many
    were redrawn.

    Redrawn is who has too few good starts (``good_flights``) or a mean return below ``least_return``.
    """
    rng, n_redrawn = np.random.default_rng([seed, 20]), 0
    weights, parts = np.zeros((0, actor.n_strategies)), []
    while len(weights) < n_mixtures:
        drawn = rng.dirichlet(np.ones(actor.n_strategies), n_mixtures - len(weights))
        good, shown = good_flights(domain, Mixtures(actor, drawn), settings, seed + 1 + n_redrawn)
        returns = shown[0].returns
        assert returns is not None
        fits = (good.sum(1) >= N_SHOWN) & (returns.mean(1) >= least_return)
        if not fits.any() and n_redrawn > 10 * n_mixtures:
            text = "failed one after the other; expected base policies that mix well"
            raise InputError(f"{n_redrawn} mixtures of {domain.name} {text}")
        weights, n_redrawn = np.vstack([weights, drawn[fits]]), n_redrawn + int((~fits).sum())
        parts.append([take.select(np.flatnonzero(fits)) for take in shown])
    takes = [functools.reduce(DemonstrationSet.joined, some) for some in zip(*parts, strict=True)]
    return weights, takes, n_redrawn


def generate_stream(
    domain: Domain, settings: DiaynSettings, seed: int, folder: Path, *, n_base: int = 5, n_mixtures: int = 95
) -> dict:
    """Write a stream: the first ``n_base`` of the people whose files ``folder`` holds, and mixtures of them.

    The choice puts different kinds first, so the base users are of as many kinds as there are.

    Its metadata holds what is for evaluation only: the true ``weights`` (n, n_base), the ``floor`` (n,) in
    nats (from a second take), the ``returns`` (n,) and the base users' ``kind``. Returns how many were
    redrawn.
    """
    path = check_folder(folder / f"{domain.name}_lifelong.npz")
    takes = [
        load_demonstrations(folder / f"{domain.name}_{take}.npz", domain)
        for take in ("demonstrations", "second_take")
    ]
    people, _ = load_demonstrators(folder / f"{domain.name}_demonstrators.safetensors", domain, n_base)
    base = range(n_base)
    kinds, takes = takes[0].metadata["choice"]["kind"][:n_base], [take.select(base) for take in takes]
    assert takes[0].returns is not None
    returns = takes[0].returns.mean(1)
    least = returns.min() - np.ptp(returns)  # clearly below the worst: by more than the best is above it
    drawn = draw_mixtures(domain, people.select(base), settings, seed + LIFELONG_SEED, n_mixtures, least)
    weights, mixed, n_redrawn = drawn
    shown, again = (base.joined(more) for base, more in zip(takes, mixed, strict=True))
    assert shown.returns is not None
    labels = {
        "weights": np.vstack([np.eye(n_base), weights]),
        "floor": divergence_floor(shown, again),
        "returns": shown.returns.mean(1),
    }
    made_by = f"python -m dmsrd_lite generate {domain.name} --seed {seed}"
    metadata = {"seed": seed, "kind": kinds, "redrawn": n_redrawn, "made_by": made_by}
    metadata |= {name: np.round(value, 4).tolist() for name, value in labels.items()}
    small = {name: array.astype(np.float32) for name, array in shown.arrays().items()}  # half the file's size
    shown = replace(shown, observations=small["observations"], actions=small["actions"], metadata=metadata)
    save_demonstrations(path, replace(shown, rewards=None, strategy_labels=None))
    return {"kind": kinds, "redrawn": n_redrawn}
