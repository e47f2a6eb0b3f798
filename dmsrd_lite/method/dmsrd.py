"""Dynamic multi-strategy reward distillation: demonstrations arrive one by one. Paper: Algorithm 1."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, cast

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, plain
from dmsrd_lite.domains import InputError
from dmsrd_lite.learning.networks import Actor
from dmsrd_lite.method.airl import AIRL, AIRLSettings
from dmsrd_lite.method.divergence import policy_divergences, steps_measured
from dmsrd_lite.method.kl_threshold import reference_divergence
from dmsrd_lite.method.msrd import MSRDSettings
from dmsrd_lite.method.policy_mixture import MixtureSettings, action_loss, likeliest_weights, search_mixture
from dmsrd_lite.method.rewards import Rewards
from dmsrd_lite.method.rounds import play_round
from dmsrd_lite.method.state import State

MIXTURE, BETTER_MIXTURE, NEW_STRATEGY = "mixture", "mixture, better than a new strategy", "new strategy"

AS_PRINTED: dict[str, Any] = {
    "add_task_reward": False, "task_learns": False, "between_class": "mixtures", "own_rollouts": 0,
    "own_clones": False, "search_again": False, "policies_after_new": True, "policies_after_mixture": True,
    "from_actions": False, "likelihood_margin": 0.0, "between_class_relative": False,
}  # fmt: skip


@dataclass(frozen=True)
class DMSRDSettings:
    """What is done with a demonstration; a comment in the source stands beside each field.

    ``kl_threshold``: eps in nats, a mixture below it is taken; 0: ``kl_margin`` nats above a reference.
    ``airl``: training of a new strategy; ``msrd``: of a round; ``mixture``: the search for weights. The other
    fields say where ours deviates from the paper (``as_printed`` takes all that back).
    """

    kl_threshold: float = 0.0  # eps: a mixture is accepted below it (nats); 0: a reference + kl_margin
    kl_margin: float = 0.5  # nats above the reference (``kl_threshold.reference_divergence``)
    likelihood_margin: float = 0.0  # > 0: lines 5 and 11 ask the actions, not the KL: is their loss under the
    # likeliest mixture less than so many nats above that of their own clone (``action_loss``)?
    add_task_reward: bool = True  # AIRL trains alpha g beside the frozen R_Task (the paper: alone)
    task_learns: bool = False  # R_Task learns beside a new strategy, goes 1/M of the way (the paper: rests)
    between_class: str = "always"  # Equation 4 after every branch, after "mixtures" only (the paper), "never"
    own_rollouts: int = 20  # it is asked on so many of each person's explanation from new starts; 0: on what
    # was shown (the paper)
    own_clones: bool = False  # these are rollouts of a clone of each demonstration, not of its explanation
    search_again: bool = True  # an older mixture whose KL has risen above its eps (the paper: never)
    airl: AIRLSettings = AIRLSettings(n_iterations=12)
    msrd: MSRDSettings = MSRDSettings(n_iterations=5, episodes=4, discriminator_steps=24)  # a round
    mixture: MixtureSettings = MixtureSettings()
    policies_after_new: bool = True  # policies learn in the round after a new strategy (the paper) ...
    policies_after_mixture: bool = True  # ... and in that after a mixture (the paper), or only rewards do
    remembered: int = 0  # how many earlier mixtures a round works on (``rounds.remembered``); 0: all
    measured_rollouts: int = 10  # for the KL before and after a round; 0: not measured, nobody searched again

    def __post_init__(self) -> None:
        if self.kl_threshold < 0 or not np.isfinite(self.kl_threshold):
            expected = "expected a positive number of nats, or 0 to calibrate it"
            raise InputError(f"kl_threshold {self.kl_threshold!r}: {expected}")
        if self.between_class not in (words := ("always", "mixtures", "never")):
            raise InputError(f"between_class {self.between_class!r}: expected one of {', '.join(words)}")
        if not 0 <= self.likelihood_margin < np.inf:
            expected = "expected a positive number of nats, or 0: KL decides"
            raise InputError(f"likelihood_margin {self.likelihood_margin!r}: {expected}")
        if self.likelihood_margin and not (self.mixture.from_actions and self.airl.start == "clone"):
            text = "expected mixtures from_actions and policies that start from a clone"
            raise InputError(f"likelihood_margin {self.likelihood_margin!r}: {text}, or 0")
        half = [one.coverage == "half" for one in (self.airl, self.msrd)]
        for name, (first, second) in {"start": (self.airl.start, self.msrd.start), "coverage": half}.items():
            if first != second:
                expected = "expected the same, because MSRD goes on with what AIRL learned"
                raise InputError(f"{name} differs between airl and msrd: {expected}")

    def as_printed(self) -> "DMSRDSettings":
        """Algorithm 1 as the paper prints it, from the same start: every deviation taken back."""
        return replace(
            self,
            **{name: usual for name, usual in AS_PRINTED.items() if name in vars(self)},
            remembered=0,
            msrd=replace(self.msrd, between_class_relative=False),
            mixture=replace(self.mixture, from_actions=False),
        )

    @property
    def form(self) -> str:
        """In words: the start, and what deviates from the paper."""
        known = vars(self) | vars(self.msrd) | {"from_actions": self.mixture.from_actions}
        names = [name for name, usual in AS_PRINTED.items() if known[name] != usual]
        start = self.airl.start + (" with coverage" if self.airl.coverage == "half" else "")
        return f"from {start}, {', '.join(names) or 'as printed'}"


def learn(state: State, demonstrations: DemonstrationSet, settings: DMSRDSettings) -> Iterator[State]:
    """Algorithm 1, line 1: what is known after each of the demonstrations, in their order; the last record
    says why.

    A state is replaced, never changed: an error leaves the last one as it was, and any of them can be gone on
    from, with demonstrations that it does not know yet.

    record (a dict, ``state.records[-1]``): branch (``MIXTURE``, ``BETTER_MIXTURE``, ``NEW_STRATEGY``);
    kl_mix, kl_new, threshold (eps) and reference in nats, shortfall (``likelihood_margin``) in nats an
    action's coordinate, None where it was not asked for;
    weights (M,); n_strategies; remembered, kl_before_round, kl_after_round, searched_again and recognized of
    the round (``play_round``); steps of the environment, by use; seconds. A kl_new far above the threshold:
    even the new strategy does not do what was shown.
    """
    for i in range(demonstrations.n_demonstrations):
        state = learn_one(state, demonstrations.select([i]), settings)
        yield state


def learn_one(state: State, new: DemonstrationSet, settings: DMSRDSettings) -> State:
    """Algorithm 1, lines 2 to 17, for one demonstration tau_i; the numbers are the paper's lines."""
    _check(state, new, settings)
    s, started, n = settings, time.perf_counter(), len(state.weights)
    state, seed = replace(state, alpha=s.msrd.alpha, form=s.form), [state.seed, 102, n]
    steps = {"search": 0, "airl": 0}  # search: of all rollouts whose KL decides something
    candidate = cache(partial(_candidate, state, new, s, [*seed, 2]))  # AIRL on tau_i, made when asked for
    reference = reference_divergence(new, candidate, s, [*seed, 7])
    eps = s.kl_threshold or reference + s.kl_margin
    if new.domain.comparison.matched_starts and not s.kl_threshold:  # the reference was flown
        steps["search"] += steps_measured(new, s.mixture.final_rollouts)
    kl_mix = kl_new = shortfall = float("inf")
    if state.n_strategies:
        policies = state.policies().actor()
        fit = search_mixture(policies, new, s.mixture, [*seed, 1], enough=eps)  # 3: w = mixture optimisation
        kl_mix, steps["search"] = fit.divergence, steps["search"] + fit.steps  # 4: KL_mix
        if s.likelihood_margin:
            shortfall = _shortfall(policies, new, candidate())
    if shortfall < s.likelihood_margin if s.likelihood_margin else kl_mix < eps:  # 5
        branch, known = MIXTURE, state.explained(new, fit.weights)  # 6: keep w, no new strategy
    else:  # 8
        for _ in candidate().train():  # 9: train AIRL on tau_i: a policy and a strategy reward
            pass
        learned, steps["airl"] = candidate().learned_policies.actor(), candidate().steps
        kl_new = float(policy_divergences(learned, new, [*seed, 2, 9])[0])  # 10: KL_new
        steps["search"] += steps_measured(new)
        better = shortfall < _shortfall(learned, new, candidate()) if s.likelihood_margin else kl_mix < kl_new
        if better:  # 11: then AIRL leaves no trace
            branch, known = BETTER_MIXTURE, state.explained(new, fit.weights)  # 12: keep w, no new strategy
        else:  # 14
            branch = NEW_STRATEGY
            share = 1 / (state.n_strategies + 1) if s.task_learns else 0.0
            known = state.with_strategy(new, candidate().networks(), share)  # 15, 16: w = e_M+1, m_M+1 = i
    decision = {"demonstration": n, "branch": branch, "kl_mix": kl_mix, "kl_new": kl_new, "threshold": eps}
    decision |= {"shortfall": shortfall, "reference": reference, "weights": known.weights[n]}
    decision["n_strategies"] = known.n_strategies
    created = branch == NEW_STRATEGY
    known, seen, played = play_round(known, created, eps, s, seed)  # 7, 13, 17: MSRD and BCD for all
    spent = {**steps, **played, "search": steps["search"] + played["search"]}
    record = {**decision, **seen, "steps": spent, "seconds": time.perf_counter() - started}
    return replace(known, records=(*state.records, plain(record)))


def _candidate(state: State, new: DemonstrationSet, settings: DMSRDSettings, seed: list[int]) -> AIRL:
    """AIRL on the new demonstration alone, cloned and not yet trained, beside the R_Task known so far."""
    s = settings
    nothing = Rewards(state.domain, 1, s.airl.discount, seed, s.msrd.alpha)  # its R_Task is zero
    shared = state.rewards() if state.networks and s.add_task_reward else nothing
    return AIRL(new, s.airl, seed, shared=shared, task_learns=s.task_learns)


def _shortfall(policies: Actor, new: DemonstrationSet, candidate: AIRL) -> float:
    """By how many nats the demonstration's actions are less likely under policies, mixed as suits them best,
    than under its own clone."""
    own = action_loss(cast(Actor, candidate.clone), new, [1.0])
    return action_loss(policies, new, likeliest_weights(policies, new)) - own


def _check(state: State, new: DemonstrationSet, settings: DMSRDSettings) -> None:
    name, known = state.domain.name, state.demonstrations
    if new.domain.name != name:
        raise InputError(f"a demonstration of {new.domain.name} arrived; expected one of {name}")
    if (n := new.n_demonstrations) != 1:
        raise InputError(f"{n} demonstrations arrived together; expected one (learn takes several)")
    if faults := new.faults():
        raise InputError(f"demonstration {len(state.weights)} cannot be learned from: {faults[0]}")
    for array in ("observations", "actions") if known is not None else ():
        before, now = (getattr(some, array).shape[1:] for some in (known, new))
        if before != now:
            expected = f"expected {before} (trajectories, steps, dimension) as before"
            raise InputError(f"a demonstration with {array} of shape {now} arrived; {expected}")
    if state.alpha not in (0, settings.msrd.alpha):
        text = f"a state with alpha {state.alpha:g} cannot go on with {settings.msrd.alpha:g}"
        raise InputError(f"{text}; expected the same weight of the strategy rewards")
    if state.form not in ("", settings.form):
        text = f"a state that was learned {state.form} cannot go on {settings.form}; expected the same form"
        raise InputError(text)
