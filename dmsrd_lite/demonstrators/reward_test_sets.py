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
from dmsrd_lite.learning.rollouts import rollout

TEST_SEED, DEVELOPMENT_SEED = 1000, 2000  # added to a generation's seed, so that the trainings share nothing


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
    """Trajectories of new policies at ``n_snapshots`` moments of a separate training, from failure to
    success.

    Writes the arrays of ``RewardTestSet``, ``observations`` in half precision.
    """
    path = check_folder(path)
    moments = set(np.linspace(0, settings.training.n_iterations - 1, n_snapshots).astype(int).tolist())
    states, returns, every_step = [], [], []
    population, steps = diversity_of(domain).test_population, domain.horizon // stride
    for record in progress(train_demonstrators(domain, population, settings, seed)):
        if record["iteration"] in moments:
            data = rollout(domain, record["policies"].actor(), n_episodes, [seed, 9, record["iteration"]])
            kept = data.observations[:, :, stride::stride].reshape(-1, steps, domain.obs_dim)
            states.append(kept.astype(np.float16))
            returns.append(data.returns.reshape(-1))
            every_step.append(data.rewards_every_step.sum(-1).reshape(-1))
    n = settings.training.n_strategies
    metadata = {
        "domain": domain.name,
        "schema_version": SCHEMA_VERSION,
        "stride": stride,
        "seed": seed,
        "settings": asdict(settings),
    }
    arrays: dict[str, Any] = {
        "observations": np.concatenate(states),
        "returns": np.concatenate(returns).astype(np.float32),
        "returns_every_step": np.concatenate(every_step).astype(np.float32),
        "policy": np.tile(np.repeat(np.arange(n), n_episodes), len(states)).astype(np.uint8),
        "snapshot": np.repeat(np.arange(len(states)), n * n_episodes).astype(np.uint8),
        "metadata": np.array(json.dumps(metadata)),
    }
    return write_atomically(path, lambda file: np.savez_compressed(file, **arrays))
