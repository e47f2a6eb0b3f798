"""Domains: what a task is (``Domain``) and many copies of it at once (``make_batch``).

Everything else in the package takes a ``Domain``; a new task is one more description in ``DOMAINS``.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


class InputError(ValueError):
    """Input that cannot be used; the message is one sentence: what, where, what was expected."""


@dataclass(frozen=True)
class Population:
    """How a group of demonstrators is trained to differ (``diayn``)."""

    feature_units: tuple[float, ...]  # the smallest difference that counts, for each of the domain's diversity features
    last_sigma: float = 0.0  # action noise at the end of training, action units; 0: left to the optimiser


@dataclass(frozen=True)
class Domain:
    """A task with a fixed horizon that never ends early (shared by all modules and notebooks).

    ``make_batch(n_environments, n_threads)`` returns an object with
    ``reset(seeds (n,)) -> observations (n, obs_dim)`` and
    ``step(actions (n, action_dim)) -> observations (n, obs_dim), rewards (n,), ended (n,)``; actions must lie in the bounds.
    ``ended`` says that the task as others run it would be over; here it goes on.
    """

    name: str
    title: str
    horizon: int  # steps of every episode
    seconds_per_step: float
    observation_names: tuple[str, ...]  # with units
    action_names: tuple[str, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    observation_low: tuple[float, ...]  # networks see observations clipped to these bounds; files stay raw
    observation_high: tuple[float, ...]
    observation_scale: tuple[float, ...]  # ... and divided by this
    reward_text: str
    failure_text: str  # the word used in tables, e.g. "falls"
    failed: Callable[[np.ndarray, np.ndarray], np.ndarray]  # new states (..., obs_dim), rewards (...) -> bool (...): a failure?
    make_batch: Callable[[int, int], object]
    in_processes: bool  # simulated in worker processes, because its simulator holds Python's lock
    draw_frame: Callable[[np.ndarray], np.ndarray]  # one observation -> (height, width, 3) uint8
    phase_axes: tuple[int, int]  # the two observations that show a strategy best
    reward_axes: tuple[int, int]  # the two observations over which a reward is drawn ...
    reward_window: tuple[tuple[float, float], tuple[float, float]]  # ... within these bounds
    diversity_features: Callable[[np.ndarray], np.ndarray]  # (..., T+1, obs_dim) -> (..., T, n): what people would see
    demonstrators: tuple[Population, ...]  # the demonstrators are chosen from all of these ...
    test_population: Population  # ... and the test sets for rewards are made by this one
    success_return: float  # a demonstrator reaches at least this
    knn_coordinates: tuple[int, ...]  # the coordinates of a state that the divergence compares
    knn_resolution: float  # distances below this are the noise of the recording (divergence)
    matched_starts: bool  # starts differ more than strategies do: pool trajectories, compare rollouts from the same reset seeds
    kl_margin: float  # demonstrators of different strategies are at least this many nats apart ...
    coverage: tuple[tuple[float, float], ...]  # exploratory rollouts: clones disturbed so (``Actor.disturbed``: noise, drift)
    kl_threshold: float  # ... and one demonstrator's own trajectories at most this many

    @property
    def obs_dim(self) -> int:
        return len(self.observation_names)

    @property
    def action_dim(self) -> int:
        return len(self.action_names)

    def first_failure(self, states: np.ndarray, rewards: np.ndarray) -> int:
        """The step at which a trajectory, new states (T, obs_dim) and rewards (T,), first fails; T when it never does."""
        steps = np.flatnonzero(self.failed(states, rewards))
        return int(steps[0]) if len(steps) else len(states)

    def network_input(self, observations: np.ndarray) -> np.ndarray:
        """What a network sees: ``clip(s, low, high) / scale`` as float32, same shape as ``observations``."""
        x = np.clip(observations, self.observation_low, self.observation_high)
        return (x / np.asarray(self.observation_scale)).astype(np.float32)

    def clip_action(self, actions: np.ndarray) -> np.ndarray:
        """The executed action: ``clip(a, low, high)``, same shape."""
        return np.clip(actions, self.action_low, self.action_high)


class PendulumBatch:
    """``n_environments`` inverted pendulums on MuJoCo's own thread pool.

    Two physics steps of 0.02 s are one control step; the reward is ``-|theta|`` (rad) of the new state.
    The start is uniform in +-0.01 in all four coordinates, drawn as Gymnasium's ``InvertedPendulum-v5`` draws it,
    so a reset seed means the same there and here. The bits do not depend on ``n_threads`` (0: all cores).
    """

    def __init__(self, n_environments: int, n_threads: int = 0):
        import mujoco
        from gymnasium.envs import mujoco as gymnasium_mujoco
        from mujoco.batch import Batch

        folder = os.path.join(os.path.dirname(gymnasium_mujoco.__file__), "assets")
        model = mujoco.MjModel.from_xml_path(os.path.join(folder, "inverted_pendulum.xml"))
        self._batch = Batch(model, n_environments, n_threads)
        self._position, self._velocity, self._control = (self._batch.bind(f) for f in ("qpos", "qvel", "ctrl"))

    def reset(self, seeds: np.ndarray) -> np.ndarray:
        self._batch.reset(stage=0)
        start = np.array([np.random.default_rng(int(seed)).uniform(-0.01, 0.01, 4) for seed in seeds])
        self._position[:], self._velocity[:] = start[:, :2], start[:, 2:]
        return start

    def simulate(self, actions: np.ndarray) -> None:
        """One control step and nothing else: what the benchmark calls the raw simulator."""
        self._control[:] = actions
        self._batch.step(nstep=2)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.simulate(actions)
        state = np.concatenate([self._position, self._velocity], axis=1)
        return state, -np.abs(state[:, 1]), np.zeros(len(state), dtype=bool)


def draw_pendulum(observation: np.ndarray, height: int = 120, width: int = 240) -> np.ndarray:
    """Cart and pole drawn from the state (x in m, theta in rad), so that no GL library is needed: (height, width, 3)."""
    from PIL import Image, ImageDraw

    x, theta = float(observation[0]), float(observation[1])
    factor = 2  # drawn twice as large, then reduced: smooth edges
    image = Image.new("RGB", (width * factor, height * factor), "white")
    draw = ImageDraw.Draw(image)
    metre = width * factor / 2.9
    base_x, base_y = width * factor / 2 + x * metre, height * factor * 0.72
    rail = [width * factor / 2 - 1.05 * metre, width * factor / 2 + 1.05 * metre]
    draw.line([rail[0], base_y, rail[1], base_y], fill="#999999", width=3 * factor)
    draw.line([width * factor / 2, base_y + 8 * factor, width * factor / 2, base_y + 14 * factor], fill="#999999", width=factor)
    draw.rounded_rectangle(
        [base_x - 0.13 * metre, base_y - 8 * factor, base_x + 0.13 * metre, base_y + 8 * factor], radius=4 * factor, fill="#0072B2"
    )
    tip = (base_x + 0.6 * metre * np.sin(theta), base_y - 0.6 * metre * np.cos(theta))
    draw.line([base_x, base_y, *tip], fill="#D55E00", width=5 * factor)
    draw.ellipse([tip[0] - 4 * factor, tip[1] - 4 * factor, tip[0] + 4 * factor, tip[1] + 4 * factor], fill="#D55E00")
    return np.asarray(image.resize((width, height), Image.LANCZOS))


def pendulum_features(observations: np.ndarray, window: int = 75) -> np.ndarray:
    """What makes strategies look different: where the cart is, and the width of its movement within the last 3 s (m each)."""
    x = observations[..., 0]
    padded = np.concatenate([np.repeat(x[..., :1], window - 1, axis=-1), x], axis=-1)
    width = np.ptp(np.lib.stride_tricks.sliding_window_view(padded, window, axis=-1), axis=-1)
    return np.stack([x[..., 1:], width[..., 1:]], axis=-1)


INVERTED_PENDULUM = Domain(
    name="inverted_pendulum",
    title="Inverted Pendulum",
    horizon=1000,
    seconds_per_step=0.04,
    observation_names=("x (m)", "theta (rad)", "xdot (m/s)", "thetadot (rad/s)"),
    action_names=("force (control units)",),
    action_low=(-3.0,),
    action_high=(3.0,),
    observation_low=(-2.0, -2.0, -10.0, -20.0),
    observation_high=(2.0, 2.0, 10.0, 20.0),
    observation_scale=(1.0, 1.0, 2.0, 4.0),
    reward_text="-|theta| of the new state, in rad, every step",
    failure_text="falls",
    failed=lambda states, rewards: np.abs(states[..., 1]) > 1.0,
    make_batch=PendulumBatch,
    in_processes=False,
    draw_frame=draw_pendulum,
    phase_axes=(0, 2),
    reward_axes=(1, 0),
    reward_window=((-1.6, 1.6), (-1.0, 1.0)),
    diversity_features=pendulum_features,
    demonstrators=(Population((0.1, 0.05), last_sigma=0.15), Population((0.4, 0.02), last_sigma=0.3)),  # by place; by movement
    test_population=Population((0.25, 0.03)),
    success_return=-60.0,
    knn_coordinates=(0, 1, 2, 3),
    knn_resolution=1e-9,
    matched_starts=False,
    kl_margin=3.0,
    coverage=((1.0, 0.0), (3.0, 0.0), (10.0, 0.0)),
    kl_threshold=1.0,
)


class LanderBatch:
    """``n_environments`` of Gymnasium's continuous ``LunarLander-v3`` that go on after a crash or a landing.

    One reset seed fixes terrain, first push and engine noise, as ``env.reset(seed=...)`` does there.
    ``n_threads`` is ignored: Box2D steps one world after the other, and ``rollout`` shares the work among processes.
    """

    def __init__(self, n_environments: int, n_threads: int = 0):
        from gymnasium.envs.box2d.lunar_lander import LunarLander

        self._landers = [LunarLander(continuous=True) for _ in range(n_environments)]

    def reset(self, seeds: np.ndarray) -> np.ndarray:
        return np.array([lander.reset(seed=int(seed))[0] for lander, seed in zip(self._landers, seeds, strict=True)], dtype=np.float64)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        observations, rewards, ended, *_ = zip(*(e.step(a) for e, a in zip(self._landers, actions, strict=True)), strict=True)
        return np.array(observations, dtype=np.float64), np.array(rewards, dtype=np.float64), np.array(ended)


def draw_lander(observation: np.ndarray, height: int = 120, width: int = 150) -> np.ndarray:
    """The lander drawn from the state; the terrain is not in it, so the ground is drawn at the pad's height: (height, width, 3)."""
    from PIL import Image, ImageDraw

    x, y, angle, legs = float(observation[0]), float(observation[1]), float(observation[4]), observation[6:8]
    factor = 2  # drawn twice as large, then reduced: smooth edges
    image = Image.new("RGB", (width * factor, height * factor), "#16213A")
    draw = ImageDraw.Draw(image)
    unit = width * factor / 20  # the scene is 20 x 13.3 metres of the simulator
    ground = height * factor - 1.2 * unit
    draw.rectangle([0, ground, width * factor, height * factor], fill="#BBBBBB")
    draw.line([8 * unit, ground, 12 * unit, ground], fill="#E69F00", width=2 * factor)
    centre = np.array([(10 + 10 * x) * unit, ground - (6.67 * y + 0.6) * unit])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) * unit * 1.6  # larger than true, to be seen

    def place(*points):
        return [tuple(centre + turn @ point) for point in np.array(points)]

    for side, touches in zip((-1, 1), legs, strict=True):
        draw.line(place((side * 0.35, 0.0), (side * 0.6, 0.6)), fill="#D55E00" if touches else "#56B4E9", width=2 * factor)
    draw.polygon(place((-0.45, -0.3), (-0.3, -0.55), (0.3, -0.55), (0.45, -0.3), (0.4, 0.2), (-0.4, 0.2)), fill="#FFFFFF")
    return np.asarray(image.resize((width, height), Image.LANCZOS))


def lander_features(observations: np.ndarray) -> np.ndarray:
    """What makes flights look different: where the lander is (half widths, half heights), and when (share of 500 steps)."""
    place = np.clip(observations[..., 1:, :2], -1.0, 1.5)
    time = np.broadcast_to(np.arange(1, place.shape[-2] + 1) / 500, place.shape[:-1])
    return np.concatenate([place, time[..., None]], axis=-1)


LUNAR_LANDER = Domain(
    name="lunar_lander",
    title="Lunar Lander",
    horizon=500,
    seconds_per_step=0.02,
    observation_names=("x (half widths)", "y (half heights)", "vx", "vy", "angle (rad)", "angular velocity", "left leg", "right leg"),
    action_names=("main engine", "side engines"),
    action_low=(-1.0, -1.0),
    action_high=(1.0, 1.0),
    observation_low=(-2.5, -2.5, -10.0, -10.0, -6.2831855, -10.0, 0.0, 0.0),  # the observation space of Gymnasium
    observation_high=(2.5, 2.5, 10.0, 10.0, 6.2831855, 10.0, 1.0, 1.0),
    observation_scale=(0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0),
    reward_text="Gymnasium's shaping and fuel, -100 for a crash or leaving the scene, +100 for coming to rest; nothing after that",
    failure_text="crashes",
    failed=lambda states, rewards: rewards == -100.0,  # what the simulator pays for it; no other step pays exactly this
    make_batch=LanderBatch,
    in_processes=True,
    draw_frame=draw_lander,
    phase_axes=(0, 1),
    reward_axes=(0, 1),
    reward_window=((-1.0, 1.0), (-0.2, 1.5)),
    diversity_features=lander_features,
    demonstrators=(Population((0.1, 0.2, 0.1), last_sigma=0.2),),
    test_population=Population((0.1, 0.2, 0.1)),
    success_return=100.0,
    knn_coordinates=(0, 1, 2, 3, 4, 5),  # not the legs' contacts: they are 0 or 1
    knn_resolution=0.01,
    matched_starts=True,
    kl_margin=1.0,
    coverage=((10.0, 0.0), (30.0, 0.0), (1.0, 2.0)),  # only such as fail: nearly good flights made the task reward worse
    kl_threshold=1.0,
)

DOMAINS = {domain.name: domain for domain in (INVERTED_PENDULUM, LUNAR_LANDER)}


def get_domain(name: str) -> Domain:
    """The ``Domain`` called ``name``; ``InputError`` for a name that is not in ``DOMAINS``."""
    if name not in DOMAINS:
        raise InputError(f"unknown domain {name!r}: expected one of {', '.join(DOMAINS)}")
    return DOMAINS[name]


def check_seed(seed: object, minimum: int = 0) -> int:
    """``seed`` as an int, or ``InputError`` when it is no whole number of at least ``minimum``."""
    try:
        value = int(str(seed))
    except ValueError:
        raise InputError(f"seed {seed!r}: expected a whole number of at least {minimum}") from None
    if value < minimum:
        raise InputError(f"seed {seed!r}: expected a whole number of at least {minimum}")
    return value
