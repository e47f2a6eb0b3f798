"""Every method of the comparison through one door: the same demonstrations, budget, start and score."""

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import InputError
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.evaluation.metrics import score_policies
from dmsrd_lite.learning.networks import GaussianPolicies, under
from dmsrd_lite.method.airl import AIRL, AIRLSettings, clone_demonstrations
from dmsrd_lite.method.between_class_discrimination import recognized
from dmsrd_lite.method.dmsrd import DMSRDSettings, learn
from dmsrd_lite.method.msrd import MSRD, MSRDSettings
from dmsrd_lite.method.policy_mixture import Mixtures
from dmsrd_lite.method.rewards import MeanRewards, Rewards, StateReward
from dmsrd_lite.method.state import State

METHODS = (
    "cloning", "AIRL Single", "AIRL Batch", "MSRD", "DMSRD without BCD", "DMSRD as printed", "DMSRD",
)  # fmt: skip


@dataclass(frozen=True)
class MethodSettings:
    """``airl`` and ``msrd`` spend per strategy what DMSRD spends on the average; its search comes on top."""

    airl: AIRLSettings = AIRLSettings(n_iterations=25)
    msrd: MSRDSettings = MSRDSettings(n_iterations=25, discriminator_steps=24)
    dmsrd: DMSRDSettings = DMSRDSettings()
    batch: AIRLSettings = AIRLSettings(n_iterations=25, discriminator_steps=40)  # one model for all the data


@dataclass(frozen=True)
class Learned:
    """What a method ended with: weights (n, M) say which policy or mixture explains which demonstration."""

    policies: GaussianPolicies
    weights: np.ndarray
    rewards: StateReward | None = None
    task_part: str = "g"  # the part of the rewards that is to know the task
    pure: tuple[int, ...] = ()  # the demonstration of each strategy reward; () where there are none
    steps: int = 0  # environment steps of training, all strategies together
    search_steps: int = 0
    seconds: float = 0.0
    curve: Sequence[Sequence[float]] = ()  # by iteration: a strategy's steps, true reward per step (M)
    decisions: tuple[dict, ...] = ()  # DMSRD's records, one for each demonstration

    def actor(self) -> Mixtures:
        return Mixtures(self.policies.actor(), self.weights)

    def tensors(self) -> dict[str, np.ndarray]:
        """Policies, rewards (without shaping) and weights, for a record."""
        modules = {"policy": self.policies, **({"reward": self.rewards} if self.rewards else {})}
        found = {
            f"{name}.{k}": v.numpy()
            for name, module in modules.items()
            for k, v in module.state_dict().items()
        }
        return {**{k: v for k, v in found.items() if ".shaping." not in k}, "weights": self.weights}


def train_method(
    method: str, shown: DemonstrationSet, settings: MethodSettings, seed: int, progress: Callable = iter
) -> Learned:
    """Train one of ``METHODS`` on the demonstrations in their order; ``progress`` wraps an iterable."""
    *_, (_, learned) = train_to(method, shown, settings, seed, progress=progress)
    return learned


def train_to(
    method: str,
    shown: DemonstrationSet,
    settings: MethodSettings,
    seed: int,
    budgets: Sequence[int] = (),
    progress: Callable = iter,
) -> Iterator[tuple[int, Learned]]:
    """What is known after each of ``budgets`` (ascending; environment steps per demonstration) that is below
    the settings' own, and in the end, each with the steps per demonstration.

    One training, and copies of it that end: with a budget's settings, whose learning rate falls over its
    second half (``last_rate``), a training is the same to the bit until the iteration that crosses half of
    it. That one runs at the full rate here, in a training for this budget alone already a little slower: the
    two are nearly the same, and to the bit where an iteration ends on the half, or no rate falls. DMSRD and
    cloning are known in the end only.
    """
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}: expected one of {', '.join(METHODS)}")
    start, n = time.perf_counter(), shown.n_demonstrations
    if method.startswith("DMSRD"):
        loop = settings.dmsrd
        if method == "DMSRD as printed":
            loop = loop.as_printed()
        elif method != "DMSRD":
            loop = replace(loop, between_class="never")
        *_, state = progress(learn(State(shown.domain, seed), shown, loop))
        learned = learned_by(state)
        yield learned.steps // n, learned
        return
    pure, weights, part = tuple(range(n)), np.eye(n), "g"
    learner: AIRL
    if method == "MSRD":
        learner, part = MSRD(shown, settings.msrd, seed), "task"
    elif method == "AIRL Batch":
        learner, pure, weights = AIRL(shown.pooled(), settings.batch, seed), (), np.ones((n, 1))
    elif method == "AIRL Single":
        learner = AIRL(shown, settings.airl, seed)
    else:
        clones = clone_demonstrations(shown, [seed, 101], settings.airl.cloning_steps)  # as AIRL starts from
        yield 0, Learned(clones, weights, seconds=time.perf_counter() - start)
        return
    seconds = time.perf_counter() - start  # of the start
    for one, curve, own_seconds in _trainings(learner, n, budgets, progress):
        spent, models = one.steps * len(one.x), (one.learned_policies, one.learned_rewards)
        known = models[0], weights, models[1], part, pure, spent, 0, seconds + own_seconds, curve
        yield spent // n, Learned(*known)


def _trainings(
    learner: AIRL, n: int, budgets: Sequence[int], progress: Callable
) -> Iterator[tuple[AIRL, list[list[float]], float]]:
    """``learner`` trained for each of ``budgets`` (``train_to``; ``n`` demonstrations) and to its end, with
    its curve and seconds: a training, and copies of it from the end of the iteration in which a budget's rate
    begins to fall."""
    per_person = len(learner.x) / n  # steps for each demonstration in one of a strategy's
    limit, alike = learner.settings.max_steps, 0.5 if learner.settings.last_rate < 1 else 1.0
    left = [b for b in budgets if not limit or b < limit * per_person]
    start, elsewhere = time.perf_counter(), 0.0  # seconds: of copies, and of whoever looks at them
    curve: list[list[float]] = []

    def line(record: dict) -> list[float]:
        return [record["steps"], *(record["environment_return"] / record["horizon"]).round(4)]

    for r in progress(learner.train()):
        curve.append(line(r))
        while left and learner.steps * per_person >= alike * left[0]:
            begun, one = time.perf_counter(), copy.deepcopy(learner)
            one.settings = replace(one.settings, max_steps=round(left.pop(0) / per_person))
            whole = [*curve, *map(line, one.train())]
            yield one, whole, time.perf_counter() - start - elsewhere
            elsewhere += time.perf_counter() - begun
    yield learner, curve, time.perf_counter() - start - elsewhere


def learned_by(state: State) -> Learned:
    """What DMSRD has learned from the demonstrations so far."""
    steps = [record["steps"] for record in state.records]
    training = sum(s["airl"] + s["msrd"] + s["between_class"] for s in steps)
    spent = training, sum(s["search"] for s in steps)
    seconds = sum(record["seconds"] for record in state.records)
    known = state.policies(), state.weights, state.rewards(), "task", state.pure
    return Learned(*known, *spent, seconds, decisions=state.records)


def score_method(learned: Learned, shown: DemonstrationSet, seed: Seed) -> dict[str, Any]:
    """``score_policies`` of what explains each demonstration, what it took to learn it, and ``recognized``:
    the share of strategy rewards that rank their pure demonstration first among all shown; NaN if there are
    none."""
    known = float("nan")
    if learned.rewards is not None and learned.pure:
        known = float(recognized(learned.rewards.mean_rewards(shown), learned.pure).mean())
    return {
        **score_policies(learned.actor(), shown, seed),
        "recognized": known,
        "steps": learned.steps,
        "search_steps": learned.search_steps,
        "seconds": learned.seconds,
        "curve": learned.curve,
    }


def restore(
    tensors: dict[str, np.ndarray], shown: DemonstrationSet, alpha: float = 0.0, pure: Sequence[int] = ()
) -> Learned:
    """What ``Learned.tensors`` kept, to be scored again; ``alpha`` as trained, 0 without a task reward."""
    m = tensors["weights"].shape[1]
    policies, found = GaussianPolicies(shown.domain, m, 0), under("reward", tensors)
    n_iterates = len({name.split(".")[1] for name in found if name.startswith("iterates.")})
    several = [Rewards(shown.domain, m, 0.99, 0, alpha) for _ in range(n_iterates or 1)]
    rewards: StateReward = MeanRewards(several) if n_iterates else several[0]
    modules: list[tuple[str, torch.nn.Module]] = [("policy", policies), ("reward", rewards)]
    for name, module in modules:
        kept = {k: torch.tensor(v) for k, v in under(name, tensors).items()}
        module.load_state_dict(kept, strict=False)  # shaping is not kept
    return Learned(
        policies, tensors["weights"], rewards if found else None, "task" if alpha else "g", tuple(pure)
    )
