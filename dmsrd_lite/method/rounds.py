"""A round: after each demonstration all strategies train on. Paper: Algorithm 1, lines 7, 13 and 17."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dmsrd_lite.learning.networks import Policies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.airl import clone_demonstrations
from dmsrd_lite.method.between_class_discrimination import states_of
from dmsrd_lite.method.divergence import steps_measured
from dmsrd_lite.method.msrd import MSRD
from dmsrd_lite.method.policy_mixture import search_mixture
from dmsrd_lite.method.state import State

if TYPE_CHECKING:
    from dmsrd_lite.method.dmsrd import DMSRDSettings


def play_round(
    state: State, created: bool, threshold: float, settings: "DMSRDSettings", seed: list[int]
) -> tuple[State, dict, dict[str, int]]:
    """MSRD on the pure demonstrations, BCD on those remembered; mixtures that moved away are searched again.

    ``created``: the newest demonstration is a strategy; ``threshold``: its eps. Returns the state; for the
    record the KL of those remembered before and after, and who was searched again ({demonstration: [KL then,
    KL now]}); and the steps. Declared deviations: BCD runs after every branch (line 17 names MSRD only); a
    mixture is searched again (the paper keeps its weights), but only where its KL lies above its eps: its
    strategies have moved away, or it was never near enough (line 11) and there is a new strategy.
    """
    s, newest, pure = settings, len(state.weights) - 1, state.pure
    some = remembered(state, s.remembered, [*seed, 6])
    thresholds = np.array([*(r["threshold"] for r in state.records), threshold])[some]
    moving = s.policies_after_new if created else s.policies_after_mixture  # else no KL changes by itself
    steps = {"search": 0, "msrd": 0, "between_class": 0}
    searched: dict[int, list[float]] = {}

    def measure(asked: bool) -> np.ndarray:
        n = s.measured_rollouts if asked else 0
        return state.divergences(some, [*seed, 3], n) if n else np.zeros(0)

    before = after = measure(moving)
    if len(pure) > 1:
        between = None
        if s.between_class == "always" or (s.between_class == "mixtures" and not created):
            states, steps["between_class"] = _states(state, some, s, [*seed, 7])
            between = states, state.weights[some], np.searchsorted(some, pure)
        only = state.shown.select(pure)
        learner = MSRD(only, s.msrd, [*seed, 4], networks=state.networks, between=between)
        learner.n_averaged = s.msrd.n_iterations * sum(r["n_strategies"] > 1 for r in state.records)
        learner.learns_policies = moving
        for _ in learner.train():
            pass
        learner.settle()
        state, steps["msrd"] = replace(state, networks=learner.networks()), learner.steps * len(pure)
        weights, policies = state.weights.copy(), state.policies().actor()
        helped = created and s.search_again and len(some) > len(pure)  # by the new strategy, maybe
        after = measure(moving or helped)
        if s.search_again:  # else nothing is decided by it
            steps["search"] += len(after) * steps_measured(state.shown, s.measured_rollouts)
        risen = np.flatnonzero(after > thresholds[: len(after)])  # never near enough, or its own moved away
        for k in risen if s.search_again else ():
            if (i := int(some[k])) not in {*pure, newest}:
                keywords = {"incumbent": weights[i], "enough": thresholds[k]}
                fit = search_mixture(policies, state.shown.select([i]), s.mixture, [*seed, 5, i], **keywords)
                searched[i] = [after[k], min(after[k], fit.divergence)]
                steps["search"] += fit.steps
                weights[i] = fit.weights if fit.divergence < after[k] else weights[i]
        state = replace(state, weights=weights)
    known = {
        "remembered": some,
        "kl_before_round": before,
        "kl_after_round": after,
        "searched_again": searched,
    }
    return state, {**known, "recognized": state.recognized(some)}, steps


def _states(
    state: State, some: np.ndarray, settings: "DMSRDSettings", seed: list[int]
) -> tuple[np.ndarray, int]:
    """States of the people ``some`` for Equation 4, and the environment steps that they took.

    Of what they showed; or (``own_rollouts``) of what explains them, acting from new starts: what was shown
    started in three places, and these are what is learned otherwise. With ``own_clones`` a clone of each
    demonstration acts instead: from nothing an explanation need not act much like its person.
    """
    if settings.own_rollouts:
        actor: Policies = state.mixtures(some)
        if settings.own_clones:
            shown, n_steps = state.shown.select(some), settings.airl.cloning_steps
            actor = clone_demonstrations(shown, [*seed, 2], n_steps).actor()
        data = rollout(state.domain, actor, settings.own_rollouts, [*seed, 0])
        observations, steps = data.observations, data.n_steps
    else:
        observations, steps = state.shown.select(some).observations, 0
    return states_of(state.domain, observations, [*seed, 1]), steps


def remembered(state: State, n: int, seed: list[int]) -> np.ndarray:
    """The demonstrations that a round works on: the pure ones, the newest, and ``n`` of the others (0: all),
    sorted.

    Of these first the one with the largest weight on each strategy, which its reward confuses most easily
    with its own; the rest are drawn anew each time.
    """
    everyone = np.arange(len(state.weights))
    others = np.setdiff1d(everyone, [*state.pure, everyone[-1]])
    if not 0 < n < len(others):
        return everyone
    nearest = np.unique(others[state.weights[others].argmax(0)])[:n]
    drawn = np.random.default_rng(seed).choice(np.setdiff1d(others, nearest), n - len(nearest), replace=False)
    return np.union1d(np.setdiff1d(everyone, others), [*nearest, *drawn])
