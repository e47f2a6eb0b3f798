"""Benchmark: training speed over raw simulator speed, both measured in one run (these ratios compare across machines)."""

import dataclasses
import time

import numpy as np

from dmsrd_lite.airl import AIRL, AIRLSettings
from dmsrd_lite.demonstrations import load_shipped
from dmsrd_lite.envs import INVERTED_PENDULUM, Domain
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.rollouts import rollout


def simulator_speed(domain: Domain, n_environments: int, n_threads: int, n_steps: int = 300) -> float:
    """Raw control steps per second: the batch is stepped with fixed upright-ish actions, nothing else is done."""
    actor = GaussianPolicies(domain, 1, 0).actor()
    data = rollout(domain, actor, n_environments, 0, horizon=30, n_threads=n_threads)
    batch, actions = domain.make_batch(n_environments, n_threads), data.executed_actions[0]
    batch.reset(np.arange(n_environments))
    start = time.perf_counter()
    for t in range(n_steps):
        batch.step(actions[:, t % 30])
    return n_environments * n_steps / (time.perf_counter() - start)


def bench(seed: int = 0, n_iterations: int = 6, quiet: bool = False) -> dict:
    """AIRL on the shipped pendulum demonstrations with the settings of ``full``: steps per second with every update included.

    The simulator is timed before, between and after (its best thread count, median of the rounds) at the same number of
    environments, so that a change in the machine's load falls on both sides.
    """
    domain, settings = INVERTED_PENDULUM, AIRLSettings(n_iterations=n_iterations)
    learner = AIRL(load_shipped(domain), settings, seed)
    n_environments = len(learner.x) * settings.episodes
    speeds = {n: [simulator_speed(domain, n_environments, n)] for n in (1, 2)}
    training = learner.train()
    next(training)  # coverage rollouts and the first iteration: start-up, not counted
    records = []
    for record in training:
        records.append(record["seconds"])
        for n, measured in speeds.items():
            measured.append(simulator_speed(domain, n_environments, n))
    simulator = max(float(np.median(measured)) for measured in speeds.values())
    seconds = {part: sum(r[part] for r in records) for part in records[0]}
    steps = len(records) * n_environments * learner.horizon
    training_speed = steps / sum(seconds.values())
    if not quiet:
        for part, value in {"simulator alone (estimate)": steps / simulator, **seconds}.items():
            print(f"{part:28} {value:7.2f} s  {value / sum(seconds.values()):6.1%}")
    return {
        "simulator_steps_per_s": round(simulator),
        "training_steps_per_s": round(training_speed),
        "ratio": round(training_speed / simulator, 3),
        "seconds": {k: round(v, 3) for k, v in seconds.items()},
        "simulator_by_threads": {str(n): round(float(np.median(m))) for n, m in speeds.items()},
        "settings": {**dataclasses.asdict(settings), "n_environments": n_environments, "seed": seed},
    }
