"""Gymnasium's continuous lunar lander with a fixed horizon."""

import numpy as np

from dmsrd_lite.domains.domain import Diversity, Domain, Drawing, Population, Simulator, StateComparison


class LanderBatch:
    """``n_environments`` of ``LunarLander-v3`` that go on after a crash or a landing (``domain.Batch``).

    One reset seed fixes terrain, first push and engine noise, as ``env.reset(seed=...)`` does there.
    ``n_threads`` is ignored: Box2D steps one world after the other, and ``rollout`` shares the work among
    processes.
    """

    def __init__(self, n_environments: int, n_threads: int = 0):
        from gymnasium.envs.box2d.lunar_lander import LunarLander

        self._landers = [LunarLander(continuous=True) for _ in range(n_environments)]

    def reset(self, seeds: np.ndarray) -> np.ndarray:
        starts = [lander.reset(seed=int(seed))[0] for lander, seed in zip(self._landers, seeds, strict=True)]
        return np.array(starts, dtype=np.float64)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        steps = [lander.step(action) for lander, action in zip(self._landers, actions, strict=True)]
        observations, rewards, ended, *_ = zip(*steps, strict=True)
        return np.array(observations, dtype=np.float64), np.array(rewards, dtype=np.float64), np.array(ended)


def draw(observation: np.ndarray, height: int = 120, width: int = 150) -> np.ndarray:
    """The lander from its state, (height, width, 3); the ground is flat: the terrain is not in the state."""
    from PIL import Image, ImageDraw

    x, y, angle, legs = float(observation[0]), float(observation[1]), float(observation[4]), observation[6:8]
    factor = 2  # drawn twice as large, then reduced: smooth edges
    image = Image.new("RGB", (width * factor, height * factor), "#16213A")
    pen, unit = ImageDraw.Draw(image), width * factor / 20  # the scene is 20 x 13.3 metres of the simulator
    ground = height * factor - 1.2 * unit
    pen.rectangle([0, ground, width * factor, height * factor], fill="#BBBBBB")
    pen.line([8 * unit, ground, 12 * unit, ground], fill="#E69F00", width=2 * factor)
    centre = np.array([(10 + 10 * x) * unit, ground - (6.67 * y + 0.6) * unit])
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    turn = turned * unit * 1.6  # larger than true

    def place(*points: tuple[float, float]) -> list[tuple[float, ...]]:
        return [tuple(centre + turn @ point) for point in np.array(points)]

    for side, touches in zip((-1, 1), legs, strict=True):
        pen.line(
            place((side * 0.35, 0.0), (side * 0.6, 0.6)),
            fill="#D55E00" if touches else "#56B4E9",
            width=2 * factor,
        )
    pen.polygon(
        place((-0.45, -0.3), (-0.3, -0.55), (0.3, -0.55), (0.45, -0.3), (0.4, 0.2), (-0.4, 0.2)),
        fill="#FFFFFF",
    )
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS))


def features(observations: np.ndarray) -> np.ndarray:
    """Where it is (half widths and heights), and when (of 500 steps): (..., T+1, 8) -> (..., T, 3)."""
    place = np.clip(observations[..., 1:, :2], -1.0, 1.5)
    time = np.broadcast_to(np.arange(1, place.shape[-2] + 1) / 500, place.shape[:-1])
    return np.concatenate([place, time[..., None]], axis=-1)


def describe(observations: np.ndarray) -> dict[str, float | str]:
    """What one sees of a pilot, in the mean over flights: (k, T+1, 8) -> numbers and a kind.

    From which side the pad is approached (mean x over the upper part of the way, half widths), how long it
    takes to the first touch (s), and how far the lander leans (largest angle in flight, rad).
    """
    touches = on_its_legs(observations)  # (k, T+1)
    steps = np.where(touches.any(1), touches.argmax(1), touches.shape[1] - 1)
    flights = [one[: step + 1] for one, step in zip(observations, steps, strict=True)]
    side = float(
        np.mean([one[one[:, 1] > 0.4][:, 0].mean() if (one[:, 1] > 0.4).any() else 0.0 for one in flights])
    )
    seconds = float(steps.mean() * 0.02)
    lean = float(np.mean([np.abs(one[:, 4]).max() for one in flights]))
    way = "from the left" if side < -0.05 else "from the right" if side > 0.05 else "from above"
    pace = "quick" if seconds < 2.75 else "slow" if seconds > 3.75 else "steady"
    return {
        "kind": f"{pace}, {way}",
        "side (half widths)": side,
        "first touch (s)": seconds,
        "largest angle (rad)": lean,
    }


def on_its_legs(observations: np.ndarray) -> np.ndarray:
    """Touches the ground with a leg: (..., 8) -> (...) bool."""
    return observations[..., 6:8].max(-1) > 0


_UNITS = (0.1, 0.2, 0.1)
LUNAR_LANDER = Domain(
    name="lunar_lander",
    title="Lunar Lander",
    horizon=500,
    seconds_per_step=0.02,
    observation_names=("x (half widths)", "y (half heights)", "vx", "vy", "angle (rad)", "angular velocity",
                       "left leg", "right leg"),
    observation_low=(-2.5, -2.5, -10.0, -10.0, -6.2831855, -10.0, 0.0, 0.0),  # Gymnasium's space
    observation_high=(2.5, 2.5, 10.0, 10.0, 6.2831855, 10.0, 1.0, 1.0),
    observation_scale=(0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0),
    action_names=("main engine", "side engines"),
    action_low=(-1.0, -1.0),
    action_high=(1.0, 1.0),
    reward_text="Gymnasium's shaping and fuel, -100 for a crash or leaving, +100 for coming to rest; then 0",
    failure_text="crashes",
    failed=lambda states, rewards: rewards == -100.0,  # no other step pays exactly this
    success_return=100.0,
    simulator=Simulator(LanderBatch, in_processes=True),
    comparison=StateComparison(
        coordinates=(0, 1, 2, 3, 4, 5),  # not the legs' contacts: they are 0 or 1
        resolution=0.01,
        matched_starts=True,
        alike=on_its_legs,
        others_at_least=1.0,
    ),
    exploration=((10.0, 0.0), (30.0, 0.0), (1.0, 2.0)),  # only failures: near misses hurt R_Task
    drawing=Drawing(draw, phase_axes=(0, 1), reward_axes=(0, 1), reward_window=((-1.0, 1.0), (-0.2, 1.5))),
    diversity=Diversity(
        features, ("x", "y", "time"), (Population(_UNITS, last_sigma=0.2),), Population(_UNITS), describe
    ),
)  # fmt: skip
