"""Every number that a lesson, a plan or a record runs with: one frozen object for each lesson, domain and
preset.

What a setting means stands with its class (``AIRLSettings`` and so on). ``choose`` is the way in; a record
holds the answer.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.domains import InputError
from dmsrd_lite.evaluation.comparison import MethodSettings
from dmsrd_lite.learning.policy_optimization import PPOSettings, TrainingSettings
from dmsrd_lite.method.airl import AIRLSettings
from dmsrd_lite.method.dmsrd import DMSRDSettings
from dmsrd_lite.method.msrd import MSRDSettings
from dmsrd_lite.method.policy_mixture import MixtureSettings

PRESETS = ("quick", "full")  # small, for CI and classes; the scale of the claims
PENDULUM, LANDER = "inverted_pendulum", "lunar_lander"

# Policies trained on a given reward: on the lander, with the pendulum's settings, they crash or hover.
_FLIGHT = TrainingSettings(
    episodes=6,
    first_horizon=500,
    first_sigma=0.6,
    last_discount=0.998,
    ppo=PPOSettings(epochs=4, minibatch=500),
)
TRAINING = {PENDULUM: TrainingSettings(), LANDER: _FLIGHT}

# Demonstrators and test sets (``python -m dmsrd_lite generate``).
_PILOTS = replace(_FLIGHT, n_strategies=20, n_iterations=240, last_rate=0.1)
DEMONSTRATORS = {
    PENDULUM: DiaynSettings(
        diversity_weight=0.15,
        acting_noise=0.9,
        training=TrainingSettings(n_strategies=10, n_iterations=160, episodes=4, last_rate=0.1),
    ),
    LANDER: DiaynSettings(diversity_weight=0.06, training=_PILOTS, attempts=4),
}


def _for_test_sets(usual: DiaynSettings) -> DiaynSettings:
    return replace(usual, training=replace(usual.training, n_strategies=10, n_iterations=120, last_rate=1.0))


TEST_SETS = {name: _for_test_sets(usual) for name, usual in DEMONSTRATORS.items()}

# The search for a mixture (Equation 3): candidates, then refinements around the best of them.
MIXTURE = {PENDULUM: MixtureSettings(64, 32), LANDER: MixtureSettings(64, 32)}
QUICK_MIXTURE = MixtureSettings(24, 16, n_finalists=5)

# AIRL and MSRD from nothing: what makes them learn stands in lesson 02.
_FROM_NOTHING: dict[str, dict[str, Any]] = {
    PENDULUM: {
        "n_iterations": 125, "discriminator_rate": 1e-3, "coverage": "none", "first_horizon": 30,
        "entropy_weight": 0.05, "ppo": PPOSettings(epochs=4),
    },
    LANDER: {
        "n_iterations": 100, "episodes": 10, "entropy_weight": 0.05, "first_sigma": 0.5,
        "coverage": "once", "replay_iterations": 0,
        "coverage_levels": ((1.0, 0.5), (1.0, 1.0), (1.0, 2.0)), "ppo": PPOSettings(epochs=4, minibatch=500),
    },
}  # fmt: skip


def from_nothing(domain: str, settings: AIRLSettings, **changes: Any) -> Any:
    """``settings`` (of AIRL or MSRD) from nothing: penalty, growing episodes, mean of iterates."""
    usual = {"start": "nothing", "penalty_weight": 1.0, "n_iterates": 32, "entropy_tuning": 0.1}
    return replace(settings, **{**usual, **_FROM_NOTHING[domain], **changes})


# The methods of the comparison. Lander: as many updates of R_Task as DMSRD makes in all; more make it worse.
_LANDER_ROUND = MSRDSettings(n_iterations=5, episodes=4, discriminator_steps=6)
METHODS = {
    PENDULUM: MethodSettings(dmsrd=DMSRDSettings(mixture=MIXTURE[PENDULUM])),
    LANDER: MethodSettings(
        msrd=MSRDSettings(n_iterations=25, discriminator_steps=10),
        batch_steps=10,
        dmsrd=DMSRDSettings(kl_margin=1.0, msrd=_LANDER_ROUND, mixture=MIXTURE[LANDER]),
    ),
}


@dataclass(frozen=True)
class Start:  # 00
    n_rollouts: int


@dataclass(frozen=True)
class Demonstrations:  # 01
    n_frames: int  # of the video
    fit_steps: int  # of the reward fitted to true returns
    diayn: DiaynSettings  # a small training run; its episodes stay short


@dataclass(frozen=True)
class AIRLLesson:  # 02
    domain: str
    n_demonstrations: int
    nothing_iterations: int
    n_frames: int  # of the video
    airl: AIRLSettings
    fresh: TrainingSettings  # policies on the frozen reward

    @property
    def batch(self) -> AIRLSettings:
        """One model learns from everybody's data."""
        return replace(self.airl, discriminator_steps=40)

    @property
    def without_coverage(self) -> AIRLSettings:
        return replace(self.batch, coverage="none")

    @property
    def nothing(self) -> AIRLSettings:
        """One user, from nothing."""
        return from_nothing(self.domain, AIRLSettings(), n_iterations=self.nothing_iterations)

    @property
    def broken_name(self) -> str:
        return "whole episodes" if self.nothing.first_horizon else "no penalty"

    @property
    def broken(self) -> AIRLSettings:
        """Without what matters most: growing episodes, or where they are whole anyway, the penalty."""
        change = {"first_horizon": 0} if self.nothing.first_horizon else {"penalty_weight": 0.0}
        return replace(self.nothing, n_iterations=20, **change)

    @property
    def paid(self) -> dict[str, AIRLSettings]:
        """What the policy is paid, without the cloning term."""
        paid = {"g": ("g", 0.0), "f - log pi": ("f", 1.0)}
        return {
            name: replace(self.airl, policy_base=base, entropy_weight=c, cloning_weight=0.0)
            for name, (base, c) in paid.items()
        }


@dataclass(frozen=True)
class MSRDLesson:  # 03
    users: tuple[int, ...]
    msrd: MSRDSettings

    @property
    def alphas(self) -> dict[float, MSRDSettings]:
        return {alpha: replace(self.msrd, alpha=alpha) for alpha in (0.01, 0.3, 3.0)}


@dataclass(frozen=True)
class MixtureLesson:  # 04
    parents: tuple[int, int]
    share: float  # of the first parent in the mixture that is to be found back
    search: MixtureSettings
    cloning_steps: int = 1000

    @property
    def true_weights(self) -> tuple[float, float]:
        return self.share, 1 - self.share


@dataclass(frozen=True)
class DiscriminationLesson:  # 05
    users: tuple[int, ...]
    n_mixtures: int
    msrd: MSRDSettings
    cloning_steps: int = 1000  # of the stand-ins that mixtures are made of

    @property
    def as_printed(self) -> MSRDSettings:
        """Equation 4 as it stands."""
        return replace(self.msrd, between_class_relative=False)


@dataclass(frozen=True)
class DMSRDLesson:  # 06
    users: tuple[int, ...]
    mixtures: tuple[tuple[float, ...], ...]  # users who arrive after them: weights of ``users``
    later: tuple[tuple[int, int], ...]  # and after these: half-and-half mixtures of two
    methods: MethodSettings
    fresh: TrainingSettings  # policies on the frozen task reward
    cloning_steps: int = 1000  # of the stand-ins that mixtures are made of

    @property
    def generous(self) -> DMSRDSettings:
        return replace(self.methods.dmsrd, kl_threshold=1000.0)


@dataclass(frozen=True)
class LifelongLesson:  # 08
    users: int
    loop: DMSRDSettings
    cloning_steps: int  # of clones of the base users
    n_base: int = 5
    n_many: int = 1000  # users who are explained and not learned from ...
    short: int = 200  # ... by demonstrations of so many steps
    few: MixtureSettings = MixtureSettings(
        8, 4, search_rollouts=1, n_finalists=2, final_rollouts=2, from_actions=True
    )
    search: MixtureSettings = MixtureSettings(n_candidates=10, n_refinements=4)  # beside weights from actions


def _lifelong(domain: str, quick: bool) -> LifelongLesson:
    usual = METHODS[domain].dmsrd
    mixture = MixtureSettings(n_candidates=24, n_refinements=16, from_actions=True)
    loop = replace(
        usual,
        kl_margin={PENDULUM: 1.0, LANDER: 2.5}[domain],
        remembered=10,
        measured_rollouts=3,
        audit_every=10,
        policies_after_mixture=False,
        msrd=replace(usual.msrd, n_iterations=3),
        mixture=mixture,
    )
    if (
        domain == PENDULUM
    ):  # the lander clones every user, for the reference; here only a new strategy pays for it
        loop = replace(loop, airl=replace(loop.airl, cloning_steps=6000))
    if not quick:
        return LifelongLesson(100, loop, cloning_steps=6000)
    airl = AIRLSettings(n_iterations=1, episodes=4, cloning_steps=1500, coverage_episodes=1)
    mixture = replace(mixture, n_candidates=8, n_refinements=4, n_finalists=2)
    msrd = replace(loop.msrd, n_iterations=2, episodes=2)
    loop = replace(loop, airl=airl, msrd=msrd, mixture=mixture, audit_every=3)
    return LifelongLesson(6, loop, cloning_steps=1500, n_many=20)


def _dmsrd(domain: str, quick: bool) -> DMSRDLesson:
    methods, fresh = METHODS[domain], replace(TRAINING[domain], hold=0.5, growing=0.9)
    if not quick:
        return DMSRDLesson(tuple(range(10)), (), ((0, 1), (2, 3), (3, 5)), methods, fresh)
    airl = AIRLSettings(n_iterations=4, episodes=4, cloning_steps=1000, coverage_episodes=1)
    msrd = replace(methods.dmsrd.msrd, n_iterations=3, episodes=2, discriminator_steps=24)
    loop = replace(methods.dmsrd, airl=airl, msrd=msrd, mixture=MixtureSettings(12, 8, n_finalists=3))
    return DMSRDLesson((0, 1, 2), ((0.5, 0.5, 0.0), (0.3, 0.0, 0.7)), (), replace(methods, dmsrd=loop), fresh)


def _airl(domain: str, quick: bool) -> AIRLLesson:
    fresh = replace(TRAINING[domain], n_strategies=10, n_iterations=120, hold=0.5, growing=0.9)
    if not quick:
        return AIRLLesson(domain, 10, 125 if domain == PENDULUM else 200, 500, AIRLSettings(), fresh)
    fresh = replace(
        fresh, n_strategies=5, n_iterations=8, episodes=2, first_horizon=100, growing=1e9
    )  # short episodes
    return AIRLLesson(
        domain, 3, 100, 200, AIRLSettings(n_iterations=6, episodes=4, cloning_steps=1000), fresh
    )


def _users(quick: bool) -> tuple[int, ...]:
    return (0, 1, 2) if quick else tuple(range(10))


def _small(quick: bool, episodes: int) -> dict[str, Any]:
    return {"episodes": 2, "cloning_steps": 1000} if quick else {"episodes": episodes}


_SHORT = TrainingSettings(n_strategies=4, episodes=5, growing=1e9)
LESSONS: dict[str, Any] = {  # (domain, quick) -> settings
    "00_start_here": lambda domain, quick: Start(5 if quick else 20),
    "01_demonstrations": lambda domain, quick: Demonstrations(
        300 if quick else 1000, 200 if quick else 2000,
        DiaynSettings(training=replace(_SHORT, n_iterations=40 if quick else 120))),
    "02_airl": _airl,
    "03_msrd": lambda domain, quick: MSRDLesson(_users(quick), MSRDSettings(
        n_iterations=9 if quick else 25, discriminator_steps=24, **_small(quick, 8))),
    "04_policy_mixture": lambda domain, quick: MixtureLesson(
        (4, 8) if domain == PENDULUM else (0, 1), 0.5, QUICK_MIXTURE if quick else MIXTURE[domain]),
    "05_between_class_discrimination": lambda domain, quick: DiscriminationLesson(
        _users(quick), 2 if quick else 5,
        MSRDSettings(n_iterations=9 if quick else 20, discriminator_steps=24, **_small(quick, 4))),
    "06_dmsrd": _dmsrd,
    "08_lifelong_100": _lifelong,
}  # fmt: skip


class Knob(NamedTuple):
    """A notebook's parameter: which setting it changes, and from what to what it may be."""

    path: str
    least: float
    most: float
    default: Any = 0  # this value leaves the preset's number as it is


KNOBS: dict[str, dict[str, Knob]] = {
    "01_demonstrations": {"n_iterations": Knob("diayn.training.n_iterations", 1, 10_000)},
    "02_airl": {"n_demonstrations": Knob("n_demonstrations", 1, 10),
                "n_iterations": Knob("airl.n_iterations", 1, 10_000)},
    "03_msrd": {"alpha": Knob("msrd.alpha", 1e-6, 1000, 0.3),
                "n_iterations": Knob("msrd.n_iterations", 1, 10_000)},
    "04_policy_mixture": {"weight": Knob("share", 0, 1, 0.5)},
    "05_between_class_discrimination": {
        "between_class_weight": Knob("msrd.between_class_weight", 0, 1e6, 10.0),
        "n_iterations": Knob("msrd.n_iterations", 1, 10_000)},
    "06_dmsrd": {"kl_threshold": Knob("methods.dmsrd.kl_threshold", 1e-6, 1e9)},
    "08_lifelong_100": {"users": Knob("users", 10, 100), "remembered": Knob("loop.remembered", 0, 100, 10),
                        "moving": Knob("loop.policies_after_mixture", 0, 1, False)},
}  # fmt: skip


def check_preset(preset: str) -> str:
    """``preset`` itself, or ``InputError`` for one that is not in ``PRESETS``."""
    if preset not in PRESETS:
        raise InputError(f"unknown preset {preset!r}: expected one of {', '.join(PRESETS)}")
    return preset


def choose(lesson: str, domain: str, preset: str, **parameters: Any) -> Any:
    """The settings of a lesson, with those of its parameters that are not at their default put in.

    ``InputError`` for an unknown preset and for a parameter out of its range (``KNOBS``).
    """
    settings = LESSONS[lesson](domain, check_preset(preset) == "quick")
    for name, value in parameters.items():
        knob = KNOBS[lesson][name]
        if value != knob.default:
            settings = _put(settings, name, knob, knob.path.split("."), value)
    return settings


def _put(settings: Any, name: str, knob: Knob, path: list[str], value: Any) -> Any:
    """The settings with ``value`` at the path, checked there: a whole number where one stands now."""
    first, *rest = path
    now = getattr(settings, first)
    if rest:
        return replace(settings, **{first: _put(now, name, knob, rest, value)})
    whole = isinstance(now, int)
    fits = isinstance(value, int if whole else int | float) and knob.least <= value <= knob.most
    if not fits or (isinstance(value, bool) and not isinstance(now, bool)):
        expected = f"expected a {'whole ' if whole else ''}number from {knob.least:g} to {knob.most:g}"
        by_preset = ", or 0: by preset" if knob.default == 0 and not isinstance(now, bool) else ""
        raise InputError(f"{name} {value!r}: {expected}{by_preset}")
    return replace(settings, **{first: type(now)(value)})
