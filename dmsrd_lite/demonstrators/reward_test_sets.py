"""Test sets for rewards: trajectories from failure to success, with their true returns."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dmsrd_lite.demonstrations import SCHEMA_VERSION, check_folder, write_atomically
from dmsrd_lite.demonstrators.diayn import DiaynSettings, diversity_of, train_demonstrators
from dmsrd_lite.domains import Domain
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.learning.rollouts import rollout

TEST_SEED, DEVELOPMENT_SEED = 1000, 2000  # added to a generation's seed, so that the trainings share nothing
PROBES = 4  # episodes that say how good a policy was at a moment of its training
AGAIN = 5  # a moment is flown at most so many times


def spread_moments(quality: np.ndarray, n_chosen: int) -> np.ndarray:
    """Moments of a training, as many of each quality: quality (T,) whole numbers -> (n_chosen,), in order.

    Evenly spaced among those of a quality; one with few moments gives each of them up to ``AGAIN`` times, and
    the others fill up.
    """
    groups, chosen = [np.flatnonzero(quality == q) for q in np.unique(quality)], list[int]()
    for left, group in enumerate(sorted(groups, key=len), start=-len(groups)):
        count = (n_chosen - len(chosen)) // -left
        count = count if left == -1 else min(count, AGAIN * len(group))
        chosen += group[np.linspace(0, len(group) - 1, count).astype(int)].tolist()
    return np.sort(chosen)


def generate_test_set(
    domain: Domain,
    settings: DiaynSettings,
    seed: int,
    path: Path,
    *,
    n_snapshots: int = 100,
    n_episodes: int = 10,
    stride: int = 10,
    progress: Callable = iter,
) -> Path:
    """Trajectories of new policies at ``n_snapshots`` moments of a separate training each: as many from the
    time of failure as from half and from full success (``spread_moments``).

    Failure: half of the probes fail, and they return less than ``domain.poor_return`` in the mean; success:
    at least ``domain.success_return``. Writes the arrays of ``RewardTestSet``, ``observations`` in half
    precision.
    """
    path, n = check_folder(path), settings.training.n_strategies
    actors, quality = list[Actor](), []
    for record in progress(train_demonstrators(domain, diversity_of(domain).test_population, settings, seed)):
        actors.append(record["policies"].actor())
        probe = rollout(domain, actors[-1], PROBES, [seed, 8, record["iteration"]])
        fails, returns = probe.failed.any(-1).mean(1) >= 0.5, probe.returns.mean(1)
        quality.append(
            np.where(fails & (returns < domain.poor_return), 0, 1 + (returns >= domain.success_return))
        )
    moments = np.array([spread_moments(q, n_snapshots) for q in np.transpose(quality)])  # (M, n_snapshots)
    parts: dict[str, list] = {"observations": [], "failed": [], "returns": [], "returns_every_step": []}
    for k in progress(range(n_snapshots)):
        actor = Actor.joined([actors[moment].select([j]) for j, moment in enumerate(moments[:, k])])
        data, steps = rollout(domain, actor, n_episodes, [seed, 9, k]), domain.horizon // stride
        kept = data.observations[:, :, stride::stride].reshape(-1, steps, domain.obs_dim)
        by_then = np.maximum.accumulate(data.failed, -1)[:, :, stride - 1 :: stride]
        parts["observations"].append(kept.astype(np.float16))
        parts["failed"].append(by_then.reshape(-1, steps).astype(np.uint8))
        parts["returns"].append(data.returns.reshape(-1).astype(np.float32))
        parts["returns_every_step"].append(data.rewards_every_step.sum(-1).reshape(-1).astype(np.float32))
    metadata = {"domain": domain.name, "schema_version": SCHEMA_VERSION, "stride": stride, "seed": seed,
                "settings": asdict(settings), "moments": moments.tolist()}  # fmt: skip
    arrays: dict[str, Any] = {name: np.concatenate(some) for name, some in parts.items()} | {
        "policy": np.tile(np.repeat(np.arange(n), n_episodes), n_snapshots).astype(np.uint8),
        "snapshot": np.repeat(np.arange(n_snapshots), n * n_episodes).astype(np.uint8),
        "metadata": np.array(json.dumps(metadata)),
    }
    return write_atomically(path, lambda file: np.savez_compressed(file, **arrays))
