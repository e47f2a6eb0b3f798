"""MuJoCo's inverted pendulum with a fixed horizon."""

import os

import numpy as np

from dmsrd_lite.domains.domain import Diversity, Domain, Drawing, Population, Simulator, StateComparison

OMEGA = 1.2  # rad/s: a swing of five seconds
CAP = 1.2  # m/s


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
        bits = mujoco.mjtDisableBit
        model.opt.disableflags |= int(bits.mjDSBL_CONTACT | bits.mjDSBL_ISLAND)  # nothing collides
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


def features(observations: np.ndarray) -> np.ndarray:
    """Where the cart is (m), and how fast it swings, at most CAP (m/s): (..., T+1, 4) -> (..., T, 2).

    The swing speed ``hypot(xdot, g theta / OMEGA)`` knows nothing of the place: 0 for whoever holds still
    anywhere, constant on a swing, because a balanced cart accelerates at about g theta. Without the bound,
    who falls differs most.
    """
    x, theta, speed = (observations[..., 1:, i] for i in range(3))
    return np.stack([x, np.minimum(np.hypot(speed, 9.81 * theta / OMEGA), CAP)], axis=-1)


def describe(observations: np.ndarray) -> dict[str, float | str]:
    """What one sees of a person, from x after the first 8 s: (k, T+1, 4) -> numbers and a kind.

    ``share``: of the power of x at periods of 0.5 to 6 s. With at least 0.6 of it, and by more than a tremor
    (a standard deviation of 0.03 m), somebody moves: a swinger from 0.15 m on, else a rocker. Who does not
    move is a holder (below 0.1 m) or a drifter.
    """
    x = observations[:, min(200, observations.shape[1] // 2) :, 0]
    power = (np.abs(np.fft.rfft(x - x.mean(1, keepdims=True), axis=1)) ** 2).mean(0)[1:]
    frequency = np.fft.rfftfreq(x.shape[1], 0.04)[1:]
    share = power[(frequency >= 1 / 6) & (frequency <= 2)].sum() / max(power.sum(), 1e-12)
    deviation = x.std(1).mean()
    still, moving = (
        ("holder" if deviation < 0.1 else "drifter"),
        ("swinger" if deviation >= 0.15 else "rocker"),
    )
    return {
        "kind": moving if share >= 0.6 and deviation >= 0.03 else still,
        "mean x (m)": float(x.mean()),
        "deviation of x (m)": float(deviation),
        "period (s)": float(1 / frequency[power.argmax()]),
        "share of power at 0.5 to 6 s": float(share),
    }


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
    success_return=-100.0,
    poor_return=-1400.0,  # who does nothing returns -1550
    simulator=Simulator(PendulumBatch),
    comparison=StateComparison(others_at_least=2.5),
    drawing=Drawing(draw, phase_axes=(0, 2), reward_axes=(1, 0), reward_window=((-1.6, 1.6), (-1.0, 1.0))),
    diversity=Diversity(
        features,  # populations that are told apart by place, by swing speed, and by both
        ("place (m)", "swing speed (m/s)"),
        populations=(
            Population((0.1, np.inf), last_sigma=0.15),
            Population((np.inf, 0.12), last_sigma=0.3),  # who swings widely must be used to much noise
            Population((np.inf, 0.12), last_sigma=0.3),
            Population((np.inf, 0.08), last_sigma=0.15),
            Population((np.inf, 0.08), last_sigma=0.2),
            Population((0.4, 0.08), last_sigma=0.15),
            Population((0.3, 0.12), last_sigma=0.3),
            Population((0.4, 0.08), last_sigma=0.2),
            Population((0.2, 0.1), last_sigma=0.25),
            Population((0.3, 0.12), last_sigma=0.25),
        ),
        test_population=Population((0.4, 0.08)),
        describe=describe,
    ),
)
