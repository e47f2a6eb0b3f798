"""What a domain is, and the small objects beside it: how it is compared, drawn, varied and explored."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

Seed = int | Sequence[int]  # of NumPy's generators: a number, or a path of numbers


class InputError(ValueError):
    """Input that cannot be used; the message is one sentence: what, where, what was expected."""

    def _render_traceback_(self) -> list[str]:
        return [f"{type(self).__name__}: {self}"]  # all that Jupyter shows of it


class Batch(Protocol):
    """Many copies of an environment, stepped together."""

    def reset(self, seeds: np.ndarray) -> np.ndarray:
        """Reset seeds (n,) -> observations (n, obs_dim)."""

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Actions (n, action_dim) within the bounds -> observations (n, obs_dim), rewards (n,), ended (n,).

        ``ended`` says that the task as others run it would be over; here it goes on.
        """


@dataclass(frozen=True)
class Simulator:
    """How to simulate. The bits do not depend on ``n_threads``."""

    make_batch: Callable[[int, int], Batch]  # (n_environments, n_threads)
    in_processes: bool = False  # in worker processes, because the simulator holds Python's lock
    n_threads: int = 0  # 0: all cores


@dataclass(frozen=True)
class StateComparison:
    """How the states of two people are compared (``method.divergence``)."""

    coordinates: tuple[int, ...] = ()  # those that count; (): all
    resolution: float = 1e-9  # distances below this are the noise of the recording
    # Starts differ more than strategies do: pool trajectories, roll out from the same starts.
    matched_starts: bool = False
    # States in which everybody is alike, as a lander on its legs: (..., obs_dim) -> (...) bool.
    alike: Callable[[np.ndarray], np.ndarray] | None = None
    own_at_most: float = 1.0  # nats between one demonstrator's own trajectories ...
    others_at_least: float = 3.0  # ... and between two demonstrators


@dataclass(frozen=True)
class Drawing:
    """How a state is drawn."""

    frame: Callable[[np.ndarray], np.ndarray]  # one observation -> (height, width, 3) uint8
    phase_axes: tuple[int, int]  # the two observations that show a strategy best
    reward_axes: tuple[int, int]  # the two over which a reward is drawn ...
    reward_window: tuple[tuple[float, float], tuple[float, float]]  # ... within these bounds


@dataclass(frozen=True)
class Population:
    """How a group of demonstrators is trained to differ."""

    feature_units: tuple[float, ...]  # smallest difference that counts, for each feature; inf: is not seen
    last_sigma: float = 0.0  # action noise at the end of training, action units; 0: left to the optimiser


@dataclass(frozen=True)
class Diversity:
    """How people differ (``demonstrators.diayn``)."""

    features: Callable[[np.ndarray], np.ndarray]  # (..., T+1, obs_dim) -> (..., T, n): what a spectator sees
    feature_names: tuple[str, ...]
    populations: tuple[Population, ...]  # demonstrators are chosen from all of these ...
    test_population: Population  # ... and the test sets for rewards are made by this one
    describe: Callable[[np.ndarray], dict[str, Any]]  # a person's (k, T+1, obs_dim) -> numbers, a ``kind``


@dataclass(frozen=True)
class Domain:
    """A task with a fixed horizon that never ends early."""

    name: str
    title: str
    horizon: int  # steps of every episode
    seconds_per_step: float
    observation_names: tuple[str, ...]  # with units
    observation_low: tuple[float, ...]  # networks see observations clipped to these bounds ...
    observation_high: tuple[float, ...]
    observation_scale: tuple[float, ...]  # ... and divided by this; files stay raw
    action_names: tuple[str, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    reward_text: str
    failure_text: str  # the word used in tables, as "falls"
    failed: Callable[[np.ndarray, np.ndarray], np.ndarray]  # new states (..., obs_dim), rewards -> (...) bool
    success_return: float  # whoever can do the task reaches at least this
    simulator: Simulator
    poor_return: float = float("inf")  # who fails and returns less has hardly begun to learn
    comparison: StateComparison = StateComparison()
    exploration: tuple[tuple[float, float], ...] = ((1.0, 0.0), (3.0, 0.0), (10.0, 0.0))  # learners explore
    # as clones that are disturbed by each of these levels (``Actor.disturbed``: noise, drift)
    drawing: Drawing | None = None
    diversity: Diversity | None = None

    @property
    def obs_dim(self) -> int:
        return len(self.observation_names)

    @property
    def action_dim(self) -> int:
        return len(self.action_names)

    @property
    def half_range(self) -> np.ndarray:
        """Half of the actions' range, (action_dim,)."""
        return (np.array(self.action_high) - np.array(self.action_low)) / 2

    def on_threads(self, n_threads: int) -> "Domain":
        """The same domain, simulated on ``n_threads`` threads or worker processes (0: all cores)."""
        return replace(self, simulator=replace(self.simulator, n_threads=n_threads))

    def tells(self, observations: np.ndarray) -> np.ndarray:
        """Does a state say something about who acts? (..., obs_dim) -> (...) bool."""
        alike = self.comparison.alike
        return ~alike(observations) if alike else np.ones(observations.shape[:-1], dtype=bool)

    def first_failure(self, states: np.ndarray, rewards: np.ndarray) -> int:
        """The step at which new states (T, obs_dim) and rewards (T,) first fail; T if they never do."""
        steps = np.flatnonzero(self.failed(states, rewards))
        return int(steps[0]) if len(steps) else len(states)

    def network_input(self, observations: np.ndarray) -> np.ndarray:
        """What a network sees: ``clip(s, low, high) / scale`` as float32, same shape as ``observations``."""
        x = np.clip(observations, self.observation_low, self.observation_high)
        return (x / np.asarray(self.observation_scale)).astype(np.float32)

    def clip_action(self, actions: np.ndarray) -> np.ndarray:
        """The executed action: ``clip(a, low, high)``, same shape."""
        return np.clip(actions, self.action_low, self.action_high)


def check_whole(value: object, name: str, least: int = 0) -> int:
    """``value`` as an int, or ``InputError`` when it is no whole number of at least ``least``."""
    try:
        number = int(str(value))
    except ValueError:
        number = least - 1
    if number < least:
        raise InputError(f"{name} {value!r}: expected a whole number of at least {least}")
    return number


def extend(seed: Seed, *more: int) -> list[int]:
    """A seed of its own for a part of the work: ``[*seed, *more]``.

    Not with 0 at the end of a short one: NumPy draws the same from ``[5]`` and ``[5, 0]``.
    """
    return [*np.atleast_1d(seed).tolist(), *more]
