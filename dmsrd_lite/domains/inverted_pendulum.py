"""MuJoCo's inverted pendulum with a fixed horizon."""

import os

import numpy as np

from dmsrd_lite.domains.domain import Diversity, Domain, Drawing, Population, Simulator


class PendulumBatch:
    """``n_environments`` inverted pendulums on MuJoCo's own thread pool (``domain.Batch``).

    Two physics steps of 0.02 s are one control step; the reward is ``-|theta|`` (rad) of the new state. The
    start is uniform in +-0.01 in all four coordinates, drawn as Gymnasium's ``InvertedPendulum-v5`` draws it,
    so that a reset seed means the same there and here. The bits do not depend on ``n_threads`` (0: all
    cores).
    """

    def __init__(self, n_environments: int, n_threads: int = 0):
        import mujoco
        from gymnasium.envs import mujoco as gymnasium_mujoco
        from mujoco.batch import Batch

        folder = os.path.join(os.path.dirname(gymnasium_mujoco.__file__), "assets")
        model = mujoco.MjModel.from_xml_path(os.path.join(folder, "inverted_pendulum.xml"))
        self._batch = Batch(model, n_environments, n_threads)
        self._position, self._velocity, self._control = (
            self._batch.bind(f) for f in ("qpos", "qvel", "ctrl")
        )

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


def draw(observation: np.ndarray, height: int = 120, width: int = 240) -> np.ndarray:
    """Cart and pole from the state (x in m, theta in rad), without a GL library: (height, width, 3)."""
    from PIL import Image, ImageDraw

    x, theta = float(observation[0]), float(observation[1])
    factor = 2  # drawn twice as large, then reduced: smooth edges
    image = Image.new("RGB", (width * factor, height * factor), "white")
    pen, metre, middle = ImageDraw.Draw(image), width * factor / 2.9, width * factor / 2
    base_x, base_y = middle + x * metre, height * factor * 0.72
    pen.line([middle - 1.05 * metre, base_y, middle + 1.05 * metre, base_y], fill="#999999", width=3 * factor)
    pen.line([middle, base_y + 8 * factor, middle, base_y + 14 * factor], fill="#999999", width=factor)
    cart = [base_x - 0.13 * metre, base_y - 8 * factor, base_x + 0.13 * metre, base_y + 8 * factor]
    pen.rounded_rectangle(cart, radius=4 * factor, fill="#0072B2")
    tip = (base_x + 0.6 * metre * np.sin(theta), base_y - 0.6 * metre * np.cos(theta))
    pen.line([base_x, base_y, *tip], fill="#D55E00", width=5 * factor)
    pen.ellipse(
        [tip[0] - 4 * factor, tip[1] - 4 * factor, tip[0] + 4 * factor, tip[1] + 4 * factor], fill="#D55E00"
    )
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS))


def features(observations: np.ndarray, window: int = 75) -> np.ndarray:
    """Where the cart is, and how wide it moved in the last 3 s (m each): (..., T+1, 4) -> (..., T, 2)."""
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
    observation_low=(-2.0, -2.0, -10.0, -20.0),
    observation_high=(2.0, 2.0, 10.0, 20.0),
    observation_scale=(1.0, 1.0, 2.0, 4.0),
    action_names=("force (control units)",),
    action_low=(-3.0,),
    action_high=(3.0,),
    reward_text="-|theta| of the new state, in rad, every step",
    failure_text="falls",
    failed=lambda states, rewards: np.abs(states[..., 1]) > 1.0,
    success_return=-60.0,
    simulator=Simulator(PendulumBatch),
    drawing=Drawing(draw, phase_axes=(0, 2), reward_axes=(1, 0), reward_window=((-1.6, 1.6), (-1.0, 1.0))),
    diversity=Diversity(
        features,  # one population is told apart by place, one by movement
        populations=(Population((0.1, 0.05), last_sigma=0.15), Population((0.4, 0.02), last_sigma=0.3)),
        test_population=Population((0.25, 0.03)),
    ),
)
