"""Benchmark: training speed over raw simulator speed, measured in one run, so that ratios compare."""

import dataclasses
import os
import time
from collections.abc import Sequence

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, load_shipped
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER
from dmsrd_lite.domains.inverted_pendulum import PendulumBatch
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.airl import AIRL
from dmsrd_lite.workbook import presets

THREADS = sorted({1, 2, os.cpu_count() or 1})  # the best of these counts


def simulator_speed(
    shown: DemonstrationSet, n_environments: int, n_threads: int, n_steps: int = 300
) -> float:
    """Raw control steps per second, with the demonstrators' own actions: poles stand, as in training."""
    assert shown.reset_seeds is not None
    wrap = np.arange(n_environments) % shown.reset_seeds.size
    actions = shown.actions.reshape(-1, shown.horizon, shown.domain.action_dim)[wrap].swapaxes(0, 1).copy()
    batch = PendulumBatch(n_environments, n_threads)
    batch.reset(shown.reset_seeds.ravel()[wrap])
    start = time.perf_counter()
    for t in range(n_steps):
        batch.simulate(actions[t])
    return n_environments * n_steps / (time.perf_counter() - start)


def worker_speedup(seed: int, n_repeats: int = 3) -> dict[str, float]:
    """Lander rollouts, policies included, in one process and in two by turns: median steps/s, their ratio."""
    actor = GaussianPolicies(LUNAR_LANDER, 10, seed).actor()
    speeds: dict[int, list[float]] = {1: [], 2: []}
    rollout(LUNAR_LANDER.on_threads(2), actor, 2, seed, horizon=10)  # starts the workers
    for n in [1, 2] * n_repeats:
        start = time.perf_counter()
        steps = rollout(LUNAR_LANDER.on_threads(n), actor, 8, seed).n_steps
        speeds[n].append(steps / (time.perf_counter() - start))
    one, two = (float(np.median(speeds[n])) for n in speeds)
    return {"one_process": round(one), "two_processes": round(two), "ratio": round(two / one, 2)}


def from_nothing(people: Sequence[int], seed: int, n_iterations: int = 0) -> dict[str, float | None]:
    """AIRL Single from nothing on the pendulum: speed with every update, and the time to balance.

    Every fifth iteration 20 rollouts of each policy are tried; who falls in none of them at three such checks
    in a row balances. The checks are not in the seconds or steps (of one person). None: not everybody
    balanced within the iterations (``n_iterations``, 0: as in the lessons). Ratio: to the simulator, timed at
    the same number of environments after every fifth iteration.
    """
    domain, shown = INVERTED_PENDULUM, load_shipped(INVERTED_PENDULUM).select(people)
    settings = presets.METHODS_FROM_NOTHING[domain.name].airl
    settings = dataclasses.replace(settings, n_iterations=n_iterations or settings.n_iterations)
    learner, seconds, raw_seconds, in_a_row = AIRL(shown, settings, seed), 0.0, 0.0, np.zeros(len(people))
    balances, to_balance, before = np.zeros(len(people), dtype=bool), None, 0
    for record in learner.train():
        seconds += sum(record["seconds"].values())
        if record["iteration"] % 5 == 4 or record["iteration"] == settings.n_iterations - 1:
            n_steps, before = (record["steps"] - before) * len(people), record["steps"]
            n_environments = len(people) * record["episodes"]
            raw = max(simulator_speed(shown, n_environments, n) for n in THREADS)
            raw_seconds += n_steps / raw
            trial = rollout(domain, learner.policies.actor(), 20, [seed, 97, record["iteration"]])
            in_a_row = np.where(trial.failed.any((1, 2)), 0, in_a_row + 1)
            balances |= in_a_row >= 3
            if balances.all():
                to_balance = round(seconds, 1), record["steps"]
                break
    return {
        "steps_per_s": round(learner.steps * len(people) / seconds),
        "ratio": round(raw_seconds / seconds, 3),
        "balance": int(balances.sum()),
        "seconds_to_balance": to_balance and to_balance[0],
        "steps_to_balance": to_balance and to_balance[1],
        "seconds": round(seconds, 1),
    }


def bench(seed: int = 0, n_iterations: int = 6, n_from_nothing: int = 0) -> dict:
    """AIRL on the shipped pendulum demonstrations with the settings of ``full``: steps per second with every
    update included.

    The simulator is timed after every iteration (each thread count; the best one's median counts) at the same
    number of environments, so that a change in the machine's load falls on both sides. ``start_up_seconds``
    (cloning, coverage and the first iteration) is what the steady state leaves out.
    """
    usual = presets.METHODS[INVERTED_PENDULUM.name].airl
    shown, settings = load_shipped(INVERTED_PENDULUM), dataclasses.replace(usual, n_iterations=n_iterations)
    start = time.perf_counter()
    learner = AIRL(shown, settings, seed)
    n_environments = len(learner.x) * settings.episodes
    training = learner.train()
    next(training)
    start_up = time.perf_counter() - start
    speeds: dict[int, list[float]] = {n: [] for n in THREADS}
    records = []
    for record in training:
        records.append(record["seconds"])
        for n, measured in speeds.items():
            measured.append(simulator_speed(shown, n_environments, n))
    simulator = round(max(float(np.median(measured)) for measured in speeds.values()))
    seconds = {part: float(sum(r[part] for r in records)) for part in records[0]}
    steps, total = len(records) * n_environments * learner.horizon, sum(seconds.values())
    print(f"{'of which simulator alone':26} {steps / simulator:7.2f} s  {steps / simulator / total:6.1%}")
    for part, value in seconds.items():
        print(f"{part:26} {value:7.2f} s  {value / total:6.1%}")
    return {
        "simulator_steps_per_s": simulator,
        "training_steps_per_s": round(steps / total),
        "ratio": round(round(steps / total) / simulator, 3),
        "simulator_by_threads": {str(n): round(float(np.median(m))) for n, m in speeds.items()},
        "start_up_seconds": round(start_up, 2),
        "lander": worker_speedup(seed),
        "from_nothing": {
            name: from_nothing(people, seed, n_from_nothing)
            for name, people in {"one": [1], "ten": range(len(shown.actions))}.items()
        },
        "settings": {**dataclasses.asdict(settings), "n_environments": n_environments, "seed": seed},
    }
