"""Demonstrations as files: ten people, and a stream of five people and mixtures of them."""

import functools
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, check_folder, save_demonstrations
from dmsrd_lite.demonstrators.choice import choose_demonstrators, good_flights
from dmsrd_lite.demonstrators.diayn import DiaynSettings, train_all_demonstrators
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.method.divergence import divergence_floor
from dmsrd_lite.method.policy_mixture import Mixtures

LIFELONG_SEED = 5000  # added to a generation's seed for the mixtures


def generate_demonstrations(
    domain: Domain,
    settings: DiaynSettings,
    seed: int,
    folder: Path,
    *,
    n_kept: int = 10,
    n_trajectories: int = 3,
    progress: Callable = iter,
) -> dict:
    """Train demonstrators, choose among them (``choose_demonstrators``), write their demonstrations and a
    second take.

    Returns the choice as written into the files' metadata; ``InputError`` if too few are left (nothing is
    written then).
    """
    takes = ("demonstrations", "second_take")
    paths = {take: check_folder(folder / f"{domain.name}_{take}.npz") for take in takes}
    actor = train_all_demonstrators(domain, settings, seed, progress)
    _, shown, choice = choose_demonstrators(domain, actor, settings, seed, n_kept, n_trajectories)
    metadata = {
        "seed": seed,
        "choice": choice,
        "settings": asdict(settings),
        "made_by": f"python -m dmsrd_lite generate {domain.name} --seed {seed}",
    }
    for (take, path), some in zip(paths.items(), shown, strict=True):
        save_demonstrations(path, replace(some, metadata={**metadata, "take": take}))
    return choice


def draw_mixtures(
    domain: Domain,
    actor: Actor,
    settings: DiaynSettings,
    seed: int,
    n_mixtures: int,
    least_return: float,
    n_trajectories: int = 3,
) -> tuple[np.ndarray, list[DemonstrationSet], int]:
    """Users who are mixtures of an actor's policies: weights (n, M) from Dirichlet(1), two takes, how many
    were redrawn.

    Redrawn is who has too few good starts (``good_flights``) or a mean return below ``least_return``.
    """
    rng, n_redrawn = np.random.default_rng([seed, 20]), 0
    weights, parts = np.zeros((0, actor.n_strategies)), []
    while len(weights) < n_mixtures:
        drawn = rng.dirichlet(np.ones(actor.n_strategies), n_mixtures - len(weights))
        good, shown = good_flights(
            domain, Mixtures(actor, drawn), settings, n_trajectories, seed + 1 + n_redrawn
        )
        returns = shown[0].returns
        assert returns is not None
        fits = (good.sum(1) >= n_trajectories) & (returns.mean(1) >= least_return)
        if not fits.any() and n_redrawn > 10 * n_mixtures:
            text = "failed one after the other; expected base policies that mix well"
            raise InputError(f"{n_redrawn} mixtures of {domain.name} {text}")
        weights, n_redrawn = np.vstack([weights, drawn[fits]]), n_redrawn + int((~fits).sum())
        parts.append([take.select(np.flatnonzero(fits)) for take in shown])
    takes = [functools.reduce(DemonstrationSet.joined, some) for some in zip(*parts, strict=True)]
    return weights, takes, n_redrawn


def generate_lifelong(
    domain: Domain,
    settings: DiaynSettings,
    seed: int,
    folder: Path,
    *,
    n_base: int = 5,
    n_mixtures: int = 95,
    progress: Callable = iter,
) -> dict:
    """Train demonstrators, choose ``n_base`` of them, write their demonstrations and those of mixtures of
    them: a stream.

    Beside the choice, the file's metadata holds what is for evaluation only: the true ``weights`` (n,
    n_base), the demonstrators' ``floor`` (n,) in nats (from a second take) and ``returns`` (n,).
    """
    path = check_folder(folder / f"{domain.name}_lifelong.npz")
    actor = train_all_demonstrators(domain, settings, seed, progress)
    kept, takes, choice = choose_demonstrators(domain, actor, settings, seed, n_base, spanning=True)
    assert takes[0].returns is not None
    returns = takes[0].returns.mean(1)
    least = returns.min() - np.ptp(returns)  # clearly below the worst: by more than the best is above it
    drawn = draw_mixtures(domain, actor.select(kept), settings, seed + LIFELONG_SEED, n_mixtures, least)
    weights, mixed, n_redrawn = drawn
    shown, again = (base.joined(more) for base, more in zip(takes, mixed, strict=True))
    assert shown.returns is not None
    labels = {
        "weights": np.vstack([np.eye(n_base), weights]),
        "floor": divergence_floor(shown, again),
        "returns": shown.returns.mean(1),
    }
    metadata = {
        "seed": seed,
        "choice": {**choice, "redrawn": n_redrawn},
        "settings": asdict(settings),
        "made_by": f"python -m dmsrd_lite generate {domain.name} --lifelong --seed {seed}",
    }
    metadata |= {name: np.round(value, 4).tolist() for name, value in labels.items()}
    small = {
        name: array.astype(np.float32) for name, array in shown.arrays().items()
    }  # half the size of the file
    save_demonstrations(
        path,
        replace(
            shown,
            observations=small["observations"],
            actions=small["actions"],
            rewards=None,
            strategy_labels=None,
            metadata=metadata,
        ),
    )
    return {**choice, "redrawn": n_redrawn}
