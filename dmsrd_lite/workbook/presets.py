"""Every number that a lesson, a plan or a record runs with: one frozen object for each lesson, domain and
preset.

What a setting means stands with its class (``AIRLSettings`` and so on). ``choose`` is the way in; a record
holds the answer.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.domains import InputError, get_domain
from dmsrd_lite.evaluation.comparison import METHODS as METHOD_NAMES
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


TEST_SETS = {
    name: replace(usual, training=replace(usual.training, n_strategies=10, n_iterations=120, last_rate=1.0))
    for name, usual in DEMONSTRATORS.items()
}

# The likeliest first. Lander: with 10 rollouts KL shakes by a nat, and eps takes news for noise (lesson 06).
_OURS = {
    PENDULUM: MixtureSettings(from_actions=True),
    LANDER: MixtureSettings(from_actions=True, final_rollouts=30),
}

_DRIFT = ((1.0, 0.5), (1.0, 1.0), (1.0, 2.0))  # rollouts of the untrained policy that lean to one side
# AIRL and MSRD from nothing: what makes them learn stands in lesson 02.
_FROM_NOTHING: dict[str, dict[str, Any]] = {
    PENDULUM: {
        "n_iterations": 180, "discriminator_rate": 1e-3, "coverage": "none", "first_horizon": 30,
        "last_rate": 0.1, "ppo": PPOSettings(epochs=4),
    },
    LANDER: {
        "n_iterations": 200, "episodes": 8, "first_sigma": 0.5, "coverage": "none", "replay_iterations": 0,
        "coverage_levels": _DRIFT, "policy_average": 0.8,
        "ppo": PPOSettings(epochs=4, minibatch=500),
    },
}  # fmt: skip
_LIVE: dict[str, dict[str, Any]] = {
    PENDULUM: {"n_iterations": 100},
    LANDER: {"n_iterations": 100, "episodes": 10},
}
# What many share must say what failure looks like, too: drifting rollouts in the replay, or samples of all.
_MSRD_FROM_NOTHING: dict[str, dict[str, Any]] = {
    PENDULUM: {"n_iterations": 135},
    LANDER: {"n_iterations": 160, "episodes": 6, "coverage": "once"},
}
_BATCH_FROM_NOTHING: dict[str, dict[str, Any]] = {
    PENDULUM: {
        "n_iterations": 140, "discriminator_steps": 36, "last_rate": 1.0, "replay_iterations": 0,
        "grow_below": 0.9,  # one policy for ten people is always seen through a little
    },
    LANDER: {
        "n_iterations": 130, "episodes": 16, "discriminator_steps": 36, "iterates_share": 1.0,
        "entropy_weight": 0.0, "entropy_tuning": 0.0,  # no c suits one policy for ten people
    },
}  # fmt: skip


def from_nothing(domain: str, settings: AIRLSettings, **changes: Any) -> Any:
    """``settings`` (of AIRL or MSRD) from nothing: penalty, growing episodes, mean of iterates."""
    usual: dict[str, Any] = {
        "start": "nothing", "penalty_weight": 1.0, "entropy_weight": 0.05, "entropy_tuning": 0.1,
        "policy_average": 0.95, "n_iterates": 16,
    }  # fmt: skip
    return replace(settings, **{**usual, **_FROM_NOTHING[domain], **changes})


# The methods of the comparison. Lander: as many updates of R_Task as DMSRD makes in all; more make it worse.
_LANDER_ROUND = MSRDSettings(n_iterations=5, episodes=4, discriminator_steps=6, between_class_extra=40)
METHODS = {
    PENDULUM: MethodSettings(dmsrd=DMSRDSettings(mixture=_OURS[PENDULUM])),
    LANDER: MethodSettings(
        msrd=MSRDSettings(n_iterations=25, discriminator_steps=10),
        batch=AIRLSettings(n_iterations=25, discriminator_steps=10),
        dmsrd=DMSRDSettings(kl_margin=1.5, msrd=_LANDER_ROUND, mixture=_OURS[LANDER]),
    ),
}
_DMSRD_FROM_NOTHING = {PENDULUM: 130, LANDER: 110}  # iterations of AIRL on a new strategy


def _round_from_nothing(domain: str, usual: MSRDSettings) -> MSRDSettings:
    """Whole episodes, at the rate that AIRL ended with; a strategy's reward is as quick as AIRL's own."""
    ppo = replace(_FROM_NOTHING[domain]["ppo"], learning_rate=1e-4)
    changes = {"first_horizon": 0, "coverage": "none", "policy_average": 0.0, "n_iterates": 0, "ppo": ppo}
    changes |= {"n_iterations": usual.n_iterations, "episodes": usual.episodes, "last_rate": 1.0}
    changes |= {"alpha": 1.0, "between_class_weight": 1.0}
    return from_nothing(domain, usual, **changes)


METHODS_FROM_NOTHING = {
    name: replace(
        usual,
        dmsrd=replace(
            usual.dmsrd,
            airl=from_nothing(name, AIRLSettings(), n_iterations=_DMSRD_FROM_NOTHING[name]),
            msrd=_round_from_nothing(name, usual.dmsrd.msrd),
            task_learns=True,
            own_rollouts={PENDULUM: 5, LANDER: 20}[name],  # AIRL would miss the steps; few do (lesson 05)
            policies_after_new=False,  # no cloning term would hold them near their demonstrations
            policies_after_mixture=False,
        ),
        airl=from_nothing(name, AIRLSettings()),
        msrd=from_nothing(name, MSRDSettings(), **_MSRD_FROM_NOTHING[name]),
        batch=from_nothing(name, AIRLSettings(), **_BATCH_FROM_NOTHING[name]),
    )
    for name, usual in METHODS.items()
}


def _by_start(domain: str) -> dict[str, MethodSettings]:
    return {"clone": METHODS[domain], "nothing": METHODS_FROM_NOTHING[domain]}


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
    live: AIRLSettings  # of the training that the reader watches
    fresh: TrainingSettings  # policies on the frozen reward
    n_frames: int
    fit_steps: int  # of the reward fitted to true returns
    few: tuple[int, ...]  # people on whom ingredients are taken away
    person: int = 1
    ablated_seed: int = 0  # only with this one ingredients are taken away, too: half an hour

    @property
    def methods(self) -> dict[str, MethodSettings]:
        """By start."""
        return _by_start(self.domain)

    @property
    def ingredients(self) -> dict[str, AIRLSettings]:
        """Of what AIRL Batch's frozen reward is made of, each time without one thing."""
        usual = self.methods["nothing"].batch
        changes: dict[str, dict[str, Any]] = {
            "no penalty": {"penalty_weight": 0.0},
            "samples of ten iterations": {"replay_iterations": 10},
        }
        if usual.coverage == "once":
            changes["no drifting rollouts"] = {"coverage": "none"}
        else:
            changes["drifting rollouts"] = {"coverage": "once", "coverage_levels": _DRIFT}
        return {name: replace(usual, **change) for name, change in changes.items()}

    @property
    def variants(self) -> dict[str, AIRLSettings]:
        """From nothing, each time without one thing; and other pay."""
        usual = from_nothing(self.domain, AIRLSettings(), n_iterations=self.live.n_iterations)
        without: dict[str, dict[str, Any]] = {"no penalty": {"penalty_weight": 0.0}}
        if usual.first_horizon:
            without["whole episodes"] = {"first_horizon": 0}
        else:
            without["drifting rollouts"] = {"coverage": "once"}
        paid: dict[str, dict[str, Any]] = {
            "paid g": {"entropy_weight": 0.0, "entropy_tuning": 0.0},
            "paid g - 0.05 log pi": {"entropy_tuning": 0.0},
            "paid f - log pi": {"policy_base": "f", "entropy_weight": 1.0, "entropy_tuning": 0.0},
        }
        changes: dict[str, dict[str, Any]] = {"as it is": {}, **without, **paid}
        return {name: replace(usual, **change) for name, change in changes.items()}


@dataclass(frozen=True)
class MSRDLesson:  # 03
    domain: str
    users: tuple[int, ...]  # of the live training
    msrd: MSRDSettings
    fresh: TrainingSettings  # policies on the frozen task reward

    @property
    def methods(self) -> dict[str, MethodSettings]:
        """By start; with the lesson's alpha."""
        usual, alpha = _by_start(self.domain), self.msrd.alpha
        return {start: replace(m, msrd=replace(m.msrd, alpha=alpha)) for start, m in usual.items()}

    @property
    def alphas(self) -> dict[float, MSRDSettings]:
        return {alpha: replace(self.msrd, alpha=alpha) for alpha in (0.01, 0.3, 3.0)}


@dataclass(frozen=True)
class MixtureLesson:  # 04
    parents: tuple[int, int]
    share: float  # of the first parent in the mixture that is to be found back
    search: MixtureSettings
    triangle: tuple[int, int, int]  # three people ...
    study: MixtureSettings  # searches side by side: full searches of Equation 3 ...
    cloning_steps: int = 1000
    inside: tuple[float, float, float] = (0.4, 0.3, 0.3)  # ... and somebody who mixes them
    n_newcomers: int = 20
    n_known: tuple[int, ...] = (2, 5, 9)
    budgets: tuple[int, ...] = (12, 24, 48, 96)  # candidates
    identifiable: float = 0.02  # Cramer-Rao bound of a weight

    @property
    def true_weights(self) -> tuple[float, float]:
        return self.share, 1 - self.share


@dataclass(frozen=True)
class DiscriminationLesson:  # 05
    users: tuple[int, ...]
    n_mixtures: int
    msrd: MSRDSettings
    n_own: int  # rollouts from new starts on which Equation 4 is asked
    n_fresh: tuple[int, ...] = (3, 10, 30)  # fresh takes on which recognition is measured
    windows: tuple[int, ...] = (0, 1, 10)  # one state, or two so many steps apart, by Equation 4 alone
    window_updates: int = 480  # as many as beside AIRL
    window_rate: float = 1e-3

    @property
    def as_printed(self) -> MSRDSettings:
        """Equation 4 as it stands."""
        return replace(self.msrd, between_class_relative=False)

    @property
    def ablations(self) -> dict[str, tuple[MSRDSettings, int]]:
        """Fewer rollouts from new starts; AIRL's penalty; no further updates after training."""
        return {
            "new starts, 3 rollouts": (self.msrd, 3),
            "new starts, 10 rollouts": (self.msrd, 10),
            "new starts, with penalty": (replace(self.msrd, penalty_weight=1.0), self.n_own),
            "new starts, no further updates": (replace(self.msrd, between_class_extra=0), self.n_own),
        }


@dataclass(frozen=True)
class DMSRDLesson:  # 06
    domain: str
    users: tuple[int, ...]
    mixtures: tuple[tuple[float, ...], ...]  # users who arrive after them: weights of ``users``
    loop: DMSRDSettings  # ours, from a clone
    fresh: TrainingSettings  # policies on the frozen task reward
    n_fresh: tuple[int, ...] = (3, 10, 30)  # fresh takes on which recognition is measured
    n_known: int = 5  # the rule for eps: so many are known ...
    n_decisions: int = 20  # ... and so many people of a new kind, and as many mixtures, arrive
    margins: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0, 4.0)  # eps above its reference (nats)

    @property
    def forms(self) -> dict[str, DMSRDSettings]:
        """Algorithm 1 as printed and ours, from both starts."""
        starts = {"clone": self.loop, "nothing": METHODS_FROM_NOTHING[self.domain].dmsrd}
        forms = {f"ours, {start}": loop for start, loop in starts.items()}
        return forms | {f"as printed, {start}": loop.as_printed() for start, loop in starts.items()}

    @property
    def ablations(self) -> dict[str, DMSRDSettings]:
        """Ours (from a clone, where no start is named), with one deviation from the paper taken back at a
        time."""
        found, nothing = taken_back(self.loop), self.forms["ours, nothing"]
        found["task_learns as printed, nothing"] = replace(nothing, task_learns=False)
        moving = replace(nothing, policies_after_new=True, policies_after_mixture=True)
        found["policies learn in rounds, nothing"] = moving
        found["Equation 4 on clones, nothing"] = replace(nothing, own_clones=True)
        airl = replace(nothing.airl, anchor_samples=0)
        found["samples of AIRL's end alone, nothing"] = replace(nothing, airl=airl)
        return found | {"without BCD": replace(self.loop, between_class="never")}


def taken_back(loop: DMSRDSettings) -> dict[str, DMSRDSettings]:
    """A form of Algorithm 1 with one deviation from the paper taken back at a time."""
    printed = loop.as_printed()
    names = "add_task_reward", "between_class", "own_rollouts", "search_again"
    found = {f"{name} as printed": replace(loop, **{name: getattr(printed, name)}) for name in names}
    if loop.likelihood_margin:  # it needs actions
        found["likelihood_margin as printed"] = loop = replace(loop, likelihood_margin=0.0)
    return found | {"from_actions as printed": replace(loop, mixture=printed.mixture)}


BENCHMARK = {  # what each part trains: method, start
    "clone": [(method, "clone") for method in METHOD_NAMES],
    "rivals": [(method, "nothing") for method in ("AIRL Single", "AIRL Batch", "MSRD")],
    "ours": [("DMSRD without BCD", "nothing"), ("DMSRD", "nothing")],
    "printed": [("DMSRD as printed", "nothing")],
    "control": [("AIRL Single", "nothing")],  # with the steps that DMSRD leaves to its AIRL
    "control_clone": [("AIRL Single", "clone")],
}


@dataclass(frozen=True)
class BenchmarkLesson:  # 07
    domain: str
    users: tuple[int, ...]
    budgets: tuple[int, ...]  # steps per demonstration; one training serves a rival at all (``train_to``)
    printed: tuple[int, ...]  # DMSRD as printed is trained for each of these
    main: int  # of which the tables are made
    from_clone: int  # the budget of everybody who starts from a clone
    live: MethodSettings  # of a small benchmark from a clone
    clone: MethodSettings  # from each start; the budget replaces how long they train
    nothing: MethodSettings
    n_fresh: tuple[int, ...] = (3, 10, 30)

    @property
    def fresh(self) -> TrainingSettings:
        """Of policies on a frozen task reward."""
        return _fresh(self.domain)

    @property
    def budget_of(self) -> dict[str, int]:
        """Of the tables, by start."""
        return {"clone": self.from_clone, "nothing": self.main}

    def share(self, start: str) -> int:
        """Of the tables' budget, what DMSRD's rounds leave to its AIRL."""
        return self.methods("DMSRD", start, self.budget_of[start]).dmsrd.airl.max_steps

    def scored_at(self, method: str, start: str, part: str) -> tuple[int, ...]:
        """The budgets at which a part scores a method."""
        return self.budgets if part == "rivals" else self.trained_for(method, start, part)

    def trained_for(self, method: str, start: str, part: str = "") -> tuple[int, ...]:
        """The budgets that ask for a training of their own."""
        if part.startswith("control"):
            return (self.share(start),)
        if start == "clone":
            return (self.from_clone,)
        if method.startswith("DMSRD"):
            return self.printed if method == "DMSRD as printed" else (self.main,)
        return (max(self.budgets),)

    def methods(self, method: str, start: str, budget: int) -> MethodSettings:
        """With so many steps per demonstration, all told; AIRL in DMSRD gets what its rounds will leave."""
        usual: MethodSettings = getattr(self, start)
        many, n, loop = 100_000, len(self.users), usual.dmsrd
        if method.startswith("DMSRD"):
            a_round = loop.msrd.n_iterations * loop.msrd.episodes
            own = loop.own_rollouts if method == "DMSRD" else 0
            episodes = a_round * sum(range(2, n + 1)) + own * sum(range(1, n + 1))
            rounds = get_domain(self.domain).horizon * episodes // n
            if budget <= rounds:
                what = f"{method} from {start} with {budget:,} steps per demonstration"
                raise InputError(f"{what}: its rounds take them all; expected more than {rounds:,}")
            loop = replace(loop, airl=replace(loop.airl, n_iterations=many, max_steps=budget - rounds))
        longer: dict[str, Any] = {"n_iterations": many, "max_steps": budget}
        return MethodSettings(
            airl=replace(usual.airl, **longer),
            msrd=replace(usual.msrd, **longer),
            batch=replace(usual.batch, n_iterations=many, max_steps=budget * n),
            dmsrd=loop,
        )


def _benchmark(domain: str, quick: bool) -> BenchmarkLesson:
    few = _dmsrd(domain, True).loop
    live = MethodSettings(
        msrd=replace(few.msrd, n_iterations=6, episodes=4, cloning_steps=few.airl.cloning_steps), dmsrd=few
    )
    budgets = {PENDULUM: (100_000, 250_000, 500_000, 1_000_000), LANDER: (100_000, 250_000, 500_000)}[domain]
    printed = {PENDULUM: (250_000, 500_000, 1_000_000), LANDER: (500_000,)}[domain]
    users = (0, 1, 3) if quick else tuple(range(10))
    from_clone = {PENDULUM: 300_000, LANDER: 150_000}[domain]
    starts = METHODS[domain], METHODS_FROM_NOTHING[domain]
    return BenchmarkLesson(domain, users, budgets, printed, 500_000, from_clone, live, *starts)


@dataclass(frozen=True)
class LifelongLesson:  # 08
    domain: str
    users: int
    ours: DMSRDSettings  # from a clone
    printed: DMSRDSettings  # from nothing
    kept: tuple[int, ...]  # after so many users we look at what is known, ...
    taught: tuple[int, ...]  # ... and after so many train fresh policies on R_Task
    fresh: TrainingSettings
    n_fresh: tuple[int, ...]  # fresh takes on which recognition is measured
    n_base: int = 5
    n_sample: int = 30  # users whose KL is looked at
    n_looks: int = 3  # rollouts for it
    n_ablated: int = 40  # users of the ablations
    n_orders: int = 20  # random orders ...
    n_ordered: int = 25  # ... of so many users
    n_many: int = 1000

    @property
    def forms(self) -> dict[str, DMSRDSettings]:
        return {"ours": self.ours, "as printed": self.printed}

    def of(self, form: str) -> "LifelongLesson":
        """What a run of one form knows: the other is left out, so that its record outlives a change there."""
        other: dict[str, Any] = {"ours" if form == "as printed" else "printed": None}
        return replace(self, **other)

    @property
    def ablations(self) -> dict[str, DMSRDSettings]:
        """Ours, with one deviation from the paper taken back at a time; on the lander only who decides."""
        loop = self.ours
        found = {"as it is": loop, **taken_back(loop), "all are remembered": replace(loop, remembered=0)}
        if self.domain == LANDER:
            return {k: found[k] for k in ("as it is", "likelihood_margin as printed")}
        absolute = replace(loop.msrd, between_class_relative=False)
        found["Equation 4 as printed"] = replace(loop, msrd=absolute)
        found["longer rounds"] = replace(loop, msrd=replace(loop.msrd, n_iterations=5))
        found["policies learn after mixtures"] = replace(loop, policies_after_mixture=True)
        usual = METHODS_FROM_NOTHING[self.domain].dmsrd  # ours of lesson 06, but for what bounds the work
        rounds = replace(usual.msrd, n_iterations=loop.msrd.n_iterations)
        found["from nothing"] = replace(
            usual,
            msrd=rounds,
            remembered=loop.remembered,
            own_rollouts=loop.own_rollouts,
            kl_margin=loop.kl_margin,
        )
        return found


def _lifelong(domain: str, quick: bool) -> LifelongLesson:
    margin = {PENDULUM: 1.0, LANDER: 2.0}[domain]  # with 3 a base pilot passed for a mixture of the others
    usual = METHODS[domain].dmsrd
    ours = replace(
        usual,
        remembered=10,
        measured_rollouts=3,
        policies_after_mixture=False,
        own_rollouts={PENDULUM: 5, LANDER: 10}[domain],  # from other starts in every round
        msrd=replace(usual.msrd, n_iterations=3),
    )
    printed = replace(METHODS_FROM_NOTHING[domain].dmsrd.as_printed(), measured_rollouts=0)
    ours, printed = (replace(loop, kl_margin=margin) for loop in (ours, printed))
    ours = replace(ours, likelihood_margin={PENDULUM: 0.02, LANDER: 0.3}[domain])  # lesson 06 measures why
    if not quick:
        looks = (5, 10, 20, 25, *range(30, 101, 10))
        return LifelongLesson(
            domain, 100, ours, printed, looks, (5, 25, 50, 100), _fresh(domain), (3, 10, 30)
        )
    airl = AIRLSettings(n_iterations=1, episodes=4, cloning_steps=1000, coverage_episodes=1)
    ours = replace(ours, airl=airl, own_rollouts=5)
    printed = replace(printed, airl=replace(printed.airl, n_iterations=10))
    ours, printed = (
        replace(
            loop,
            msrd=replace(loop.msrd, n_iterations=2, episodes=2),
            mixture=replace(loop.mixture, n_candidates=8, n_refinements=4, n_finalists=2),
        )
        for loop in (ours, printed)
    )
    return LifelongLesson(domain, 6, ours, printed, (3, 6), (), _fresh(domain), (3, 10), n_looks=1)


@dataclass(frozen=True)
class BeyondLesson:  # 09
    users: tuple[int, ...]  # whose files are converted; DMSRD knows them when you come
    loop: DMSRDSettings
    skill: int  # who does what you steer, ...
    stops: tuple[float, ...]  # ... and where the script steers to
    five: tuple[int, ...]  # people with a slider
    pair: tuple[int, int]  # somebody wants what these two want ...
    training: TrainingSettings  # ... trained like this, one policy for each of the shares
    fresh: TrainingSettings  # policies on a frozen reward
    batch: AIRLSettings  # whose reward is looked at on the way, ...
    moments: tuple[int, ...]  # ... at these iterations
    cheetahs: DiaynSettings
    shares: tuple[tuple[float, float], ...] = ((1.0, 0.0), (0.5, 0.5), (0.0, 1.0))
    alpha: float = MSRDSettings.alpha
    cheetah_airl: AIRLSettings = AIRLSettings(
        n_iterations=5, episodes=4, cloning_steps=1000, coverage_episodes=1
    )
    blend: tuple[float, float, float] = (0.5, 0.5, 0.0)


def _beyond(domain: str, quick: bool) -> BeyondLesson:
    fresh, batch = _fresh(domain), METHODS_FROM_NOTHING[domain].batch
    runners = TrainingSettings(
        n_strategies=3, n_iterations=30 if quick else 150, episodes=10, first_sigma=0.5, last_rate=0.1,
        ppo=PPOSettings(epochs=4, minibatch=500),
    )  # fmt: skip
    few = _dmsrd(domain, True)
    return BeyondLesson(
        users=few.users[:2],
        loop=few.loop,
        skill={PENDULUM: 0, LANDER: 4}[domain],
        stops={PENDULUM: (0.4,), LANDER: (0.3,)}[domain],
        five=(0, 1, 4, 5, 8) if domain == PENDULUM else (0, 1, 2, 3, 4),
        pair=(8, 9) if domain == PENDULUM else (0, 2),
        training=replace(fresh, n_strategies=3),
        fresh=fresh,
        batch=batch,
        moments=tuple(batch.n_iterations * k // 6 for k in range(1, 7)),
        cheetahs=DiaynSettings(diversity_weight=0.1, training=runners),
    )


def _dmsrd(domain: str, quick: bool) -> DMSRDLesson:
    loop = METHODS[domain].dmsrd
    if not quick:
        halves = tuple(tuple((i in pair) / 2 for i in range(10)) for pair in ((0, 1), (2, 3), (3, 5)))
        return DMSRDLesson(domain, tuple(range(10)), halves, loop, _fresh(domain))
    airl = AIRLSettings(n_iterations=4, episodes=4, cloning_steps=1000, coverage_episodes=1)
    msrd = replace(loop.msrd, n_iterations=3, episodes=2, discriminator_steps=24)
    mixture = MixtureSettings(12, 8, n_finalists=3, from_actions=True)
    loop = replace(loop, airl=airl, msrd=msrd, mixture=mixture, own_rollouts=5)
    return DMSRDLesson(domain, (0, 1, 3), ((0.5, 0.5, 0.0), (0.3, 0.0, 0.7)), loop, _fresh(domain))


def _fresh(domain: str) -> TrainingSettings:
    """Long, and slower towards the end: too short a training looks like a reward that does not teach."""
    if domain == LANDER:
        return replace(_FLIGHT, n_strategies=10, n_iterations=160, last_rate=0.1)
    return TrainingSettings(n_strategies=10, n_iterations=240, hold=0.75, growing=0.92, last_rate=0.1)


def _airl(domain: str, quick: bool) -> AIRLLesson:
    live = from_nothing(domain, AIRLSettings(), **_LIVE[domain])
    few = (0, 1, 3) if domain == PENDULUM else (1,)
    return AIRLLesson(domain, live, _fresh(domain), 200 if quick else 500, 2000, few)


def _users(quick: bool) -> tuple[int, ...]:
    return (0, 1, 2) if quick else tuple(range(10))


def _small(quick: bool, episodes: int) -> dict[str, Any]:
    return {"episodes": 2, "cloning_steps": 1000} if quick else {"episodes": episodes}


_SHORT = TrainingSettings(n_strategies=4, episodes=5, growing=float("inf"))
LESSONS: dict[str, Any] = {  # (domain, quick) -> settings
    "00_start_here": lambda domain, quick: Start(5 if quick else 20),
    "01_demonstrations": lambda domain, quick: Demonstrations(
        300 if quick else 1000, 200 if quick else 2000,
        DiaynSettings(training=replace(_SHORT, n_iterations=40 if quick else 120))),
    "02_airl": _airl,
    "03_msrd": lambda domain, quick: MSRDLesson(domain, (0, 1, 2), MSRDSettings(
        n_iterations=9 if quick else 25, discriminator_steps=24, **_small(quick, 8)), _fresh(domain)),
    "04_policy_mixture": lambda domain, quick: MixtureLesson(
        (4, 8) if domain == PENDULUM else (0, 1), 0.5,
        MixtureSettings(24, 16, n_finalists=5) if quick else MixtureSettings(),
        (4, 1, 3) if domain == PENDULUM else (2, 0, 1), MixtureSettings(), 1000 if quick else 3000),
    "05_between_class_discrimination": lambda domain, quick: DiscriminationLesson(
        _users(quick), 2 if quick else 5,
        MSRDSettings(n_iterations=9 if quick else 20, discriminator_steps=24, **_small(quick, 4)),
        {True: 10, False: 20 if domain == PENDULUM else 40}[quick]),
    "06_dmsrd": _dmsrd,
    "07_benchmark": _benchmark,
    "08_lifelong_100": _lifelong,
    "09_beyond": _beyond,
}  # fmt: skip


class Knob(NamedTuple):
    """A notebook's parameter: which setting it changes, and from what to what it may be."""

    path: str
    least: float
    most: float
    default: Any = 0  # this value leaves the preset's number as it is


KNOBS: dict[str, dict[str, Knob]] = {
    "01_demonstrations": {"n_iterations": Knob("diayn.training.n_iterations", 1, 10_000)},
    "02_airl": {"person": Knob("person", 0, 9, 1), "n_iterations": Knob("live.n_iterations", 1, 10_000)},
    "03_msrd": {"alpha": Knob("msrd.alpha", 1e-6, 1000, 0.3),
                "n_iterations": Knob("msrd.n_iterations", 1, 10_000)},
    "04_policy_mixture": {"weight": Knob("share", 0, 1, 0.5)},
    "05_between_class_discrimination": {
        "between_class_weight": Knob("msrd.between_class_weight", 0, 1e6, 10.0),
        "n_iterations": Knob("msrd.n_iterations", 1, 10_000)},
    "06_dmsrd": {"kl_threshold": Knob("loop.kl_threshold", 1e-6, 1e9)},
    "08_lifelong_100": {"users": Knob("users", 6, 100)},
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
        if value != knob.default or isinstance(value, bool) != isinstance(knob.default, bool):
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
