"""Every method of the comparison through one door: the same demonstrations, budget, start and scoring function."""

import time
from dataclasses import dataclass, replace

import numpy as np
import torch

from dmsrd_lite import lifelong
from dmsrd_lite.airl import AIRL, AIRLSettings, Rewards
from dmsrd_lite.demonstrations import DemonstrationSet, RewardTestSet
from dmsrd_lite.discrimination import recognized
from dmsrd_lite.envs import InputError
from dmsrd_lite.lifelong import DMSRD, LifelongSettings
from dmsrd_lite.metrics import correlations_on, reward_correlation, score_policies
from dmsrd_lite.mixture import Mixtures
from dmsrd_lite.msrd import MSRD, MSRDSettings
from dmsrd_lite.networks import GaussianPolicies, to_tensor, under

METHODS = ("cloning", "AIRL Single", "AIRL Batch", "MSRD", "DMSRD without BCD", "DMSRD")


@dataclass(frozen=True)
class MethodSettings:
    """``airl`` and ``msrd`` spend per strategy what DMSRD spends on the average over ten demonstrations; its search comes on top."""

    airl: AIRLSettings = AIRLSettings(n_iterations=25)
    msrd: MSRDSettings = MSRDSettings(n_iterations=25, discriminator_steps=24)
    lifelong: LifelongSettings = LifelongSettings()
    batch_steps: int = 40  # discriminator updates per iteration of AIRL Batch, one model for all the data

    def as_in_the_paper(self) -> "MethodSettings":
        """No warm start, no cloning term, no coverage, and AIRL for a new strategy on its own reward alone."""
        off = {"warm_start": False, "cloning_weight": 0.0, "coverage": False}
        airl, msrd = replace(self.lifelong.airl, **off), replace(self.lifelong.msrd, **off)
        loop = replace(self.lifelong, airl=airl, msrd=msrd, add_task_reward=False)
        return replace(self, airl=replace(self.airl, **off), msrd=replace(self.msrd, **off), lifelong=loop)


SETTINGS = {
    "inverted_pendulum": MethodSettings(),
    "lunar_lander": MethodSettings(  # in all about as many updates of the task reward as DMSRD makes: more make it worse
        msrd=MSRDSettings(n_iterations=25, discriminator_steps=10), lifelong=lifelong.SETTINGS["lunar_lander"], batch_steps=10
    ),
}


@dataclass(frozen=True)
class Learned:
    """What a method ended with: weights (n, M) say which policy or mixture explains which demonstration."""

    policies: GaussianPolicies
    weights: np.ndarray
    rewards: Rewards | None = None
    task_part: str = "g"  # the part of the rewards that is to know the task
    pure: tuple[int, ...] = ()  # the demonstration of each strategy reward; empty where there are no strategy rewards
    steps: int = 0  # environment steps of training, all strategies together
    search_steps: int = 0
    seconds: float = 0.0

    def actor(self) -> Mixtures:
        return Mixtures(self.policies.actor(), self.weights)

    def tensors(self) -> dict[str, np.ndarray]:
        """Policies, rewards (without shaping) and weights, for a record."""
        modules = {"policy": self.policies} | ({"reward": self.rewards} if self.rewards else {})
        found = {f"{name}.{k}": v.numpy() for name, module in modules.items() for k, v in module.state_dict().items()}
        return {k: v for k, v in found.items() if ".shaping." not in k} | {"weights": self.weights}


def train_method(method: str, shown: DemonstrationSet, settings: MethodSettings, seed: int, n_threads: int = 0, progress=iter) -> Learned:
    """Train one of ``METHODS`` on the demonstrations in their order; ``progress`` wraps an iterable."""
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}: expected one of {', '.join(METHODS)}")
    start, n = time.perf_counter(), shown.n_demonstrations
    everyone = tuple(range(n))
    if method.startswith("DMSRD"):
        learner = DMSRD(shown.domain, replace(settings.lifelong, between_class=method == "DMSRD"), seed, n_threads)
        for _ in progress(learner.learn(shown)):
            pass
        return learned_by(learner)
    if method == "MSRD":
        learner = MSRD(shown, settings.msrd, seed, n_threads)
        part, pure, weights = "task", everyone, np.eye(n)
    elif method == "AIRL Batch":
        learner = AIRL(shown.pooled(), replace(settings.airl, discriminator_steps=settings.batch_steps), seed, n_threads)
        part, pure, weights = "g", (), np.ones((n, 1))
    else:
        only_clone = {"n_iterations": 0, "coverage": False, "warm_start": True} if method == "cloning" else {}
        learner = AIRL(shown, replace(settings.airl, **only_clone), seed, n_threads)
        part, pure, weights = "g", everyone, np.eye(n)
    for _ in progress(learner.train()):
        pass
    rewards = None if method == "cloning" else learner.averaged_rewards
    steps = 0 if method == "cloning" else learner.steps * len(learner.x)
    return Learned(learner.policies, weights, rewards, part, pure if rewards else (), steps, 0, time.perf_counter() - start)


def learned_by(learner: DMSRD) -> Learned:
    """What DMSRD has learned from the demonstrations so far."""
    state, steps = learner.state, [record["steps"] for record in learner.state.records]
    spent = sum(s["airl"] + s["msrd"] for s in steps), sum(s["search"] for s in steps)
    seconds = sum(record["seconds"] for record in state.records)
    return Learned(learner.policies(), state.weights, learner.rewards(), "task", state.pure, *spent, seconds)


def score_method(learned: Learned, shown: DemonstrationSet, again: DemonstrationSet | None, test_set: RewardTestSet | None, seed) -> dict:
    """``score_policies`` of what explains each demonstration, and what its rewards know.

    task_correlation: mean over the rewards that are to know the task. recognized, recognized_again: share of strategy
    rewards that rank their pure demonstration first among all shown, and among the second takes; NaN where there are none.
    """
    scores = score_policies(learned.actor(), shown, seed)
    rewards, nothing = learned.rewards, float("nan")
    known = rewards is not None and test_set is not None
    scores["task_correlation"] = float(correlations_on(test_set, rewards, learned.task_part).mean()) if known else nothing
    for name, take in (("recognized", shown), ("recognized_again", again)):
        some = len(learned.pure) > 0 and take is not None
        scores[name] = float(recognized(rewards.evaluate(take.observations).mean((2, 3)), learned.pure).mean()) if some else nothing
    return {**scores, "steps": learned.steps, "search_steps": learned.search_steps, "seconds": learned.seconds}


def restore(tensors: dict[str, np.ndarray], shown: DemonstrationSet, alpha: float = 0.0, pure=()) -> Learned:
    """What ``Learned.tensors`` kept, to be scored again; ``alpha`` as trained, 0 where there was no task reward."""
    m = tensors["weights"].shape[1]
    modules = {"policy": GaussianPolicies(shown.domain, m, [0]), "reward": Rewards(shown.domain, m, 0.99, [0], alpha)}
    for name, module in modules.items():
        kept = {k: torch.tensor(v) for k, v in under(name, tensors).items()}
        module.load_state_dict(kept, strict=False)  # shaping is not kept
    known = any(k.startswith("reward.") for k in tensors)
    part = "task" if alpha else "g"
    return Learned(modules["policy"], tensors["weights"], modules["reward"] if known else None, part, tuple(pure))


def fit_reward(known: RewardTestSet, seed, n_steps: int = 2000, batch: int = 128) -> Rewards:
    """A state reward, the same network as a learned one, fitted to true returns: what any state reward could know.

    Minimises ``(mean_t g(s_t) - standardised return)^2`` over trajectories; every fifth is held out, and the weights that
    correlate best with these are kept. Its correlation on a test set is the ceiling of the task-reward correlation.
    """
    rng, rewards = np.random.default_rng(seed), Rewards(known.domain, 1, 0.99, [*np.atleast_1d(seed).tolist(), 1])
    x = to_tensor(known.domain.network_input(known.observations))
    target = to_tensor((known.returns - known.returns.mean()) / known.returns.std())
    held = np.arange(len(target)) % 5 == 0
    optimizer, best = torch.optim.Adam(rewards.strategy_reward.parameters(), lr=3e-3, fused=True), -1.0
    for step in range(n_steps):
        pick = rng.choice(np.flatnonzero(~held), batch)
        loss = (rewards.g(x[pick].flatten(0, 1)[None]).view(batch, -1).mean(1) - target[pick]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 49:
            found = reward_correlation(rewards.evaluate(known.observations[held])[0].mean(1), known.returns[held])
            if found > best:
                best, kept = found, {k: v.clone() for k, v in rewards.state_dict().items()}
    rewards.load_state_dict(kept)
    return rewards
