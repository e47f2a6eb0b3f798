"""Every method goes through the same door, and what it learned can be stored and scored again."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from dmsrd_lite.domains import InputError
from dmsrd_lite.evaluation import comparison
from dmsrd_lite.evaluation.comparison import METHODS, MethodSettings, score_method, train_method
from dmsrd_lite.method.dmsrd import learn
from dmsrd_lite.method.rewards import MeanRewards
from dmsrd_lite.method.state import State

SETTINGS = {"ours": MethodSettings(tiny.AIRL_ONE, tiny.MSRD_ONE, tiny.TINY, tiny.AIRL_ONE)}
NOTHING = {
    "start": "nothing",
    "coverage": "none",
    "penalty_weight": 1.0,
    "n_iterates": 4,
    "iterates_share": 1.0,
}
_ALONE, _SHARED = replace(tiny.AIRL_ONE, **NOTHING), replace(tiny.MSRD_ONE, **NOTHING)
_LOOP = replace(tiny.TINY, airl=_ALONE, msrd=replace(_SHARED, n_iterates=0))
FROM_NOTHING = SETTINGS["nothing"] = MethodSettings(_ALONE, _SHARED, _LOOP, _ALONE)
RUNS = [("cloning", "ours"), *((method, variant) for method in METHODS[1:] for variant in SETTINGS)]
SCORES = ("divergence", "log_likelihood_per_step", "recognized", "environment_return")


@pytest.mark.parametrize(("method", "variant"), RUNS)
@pytest.mark.parametrize("given", ["small_set", pytest.param("lander_set", marks=pytest.mark.verify)])
def test_what_is_stored_scores_the_same(given, method, variant, request):
    shown = request.getfixturevalue(given)
    shown = replace(shown, domain=shown.domain.on_threads(1))
    learned = train_method(method, shown, SETTINGS[variant], 0)
    scores = score_method(learned, shown, [0, 9])
    assert learned.weights.shape == (2, learned.policies.n_strategies)
    assert learned.weights.sum(1) == pytest.approx([1, 1])
    stored = comparison.restore(
        learned.tensors(), shown, getattr(learned.rewards, "alpha", 0.0), learned.pure
    )
    again = score_method(stored, shown, [0, 9])
    for score in SCORES:
        assert scores[score] == pytest.approx(again[score], nan_ok=True), score
    assert (method == "cloning") == (learned.rewards is None)
    assert np.isnan(scores["recognized"]) == (method in ("cloning", "AIRL Batch"))
    if learned.rewards is not None:
        paid = [one.rewards.evaluate(shown.observations, learned.task_part) for one in (learned, stored)]
        assert np.array_equal(*paid)


@pytest.mark.parametrize("method", ["AIRL Single", "AIRL Batch", "MSRD"])
def test_from_nothing_the_mean_of_functions_is_learned_and_stored(method, small_set):
    learned = train_method(method, small_set, FROM_NOTHING, 0)
    assert isinstance(learned.rewards, MeanRewards)
    stored = comparison.restore(learned.tensors(), small_set, learned.rewards.alpha, learned.pure)
    states = small_set.observations
    for part in ("g", "task") if method == "MSRD" else ("g",):
        assert np.array_equal(stored.rewards.evaluate(states, part), learned.rewards.evaluate(states, part))
    steps, *rewards = np.array(learned.curve).T
    assert steps.tolist() == [50, 100]
    assert len(rewards) == learned.policies.n_strategies


def for_budget(steps, last_rate):
    """Iterations of 50 steps a person, until so many are spent."""
    longer = {"n_iterations": 100, "max_steps": steps, "last_rate": last_rate, "policy_average": 0.5}
    alone, shared = (replace(one, **longer) for one in (_ALONE, _SHARED))
    return MethodSettings(alone, shared, _LOOP, replace(alone, max_steps=2 * steps))


@pytest.mark.parametrize("method", ["AIRL Single", "AIRL Batch", "MSRD"])
@pytest.mark.parametrize("last_rate", [1.0, 0.1])
def test_what_is_known_at_a_budget_is_what_a_training_for_it_knows(method, last_rate, small_set):
    looks = list(
        comparison.train_to(method, small_set, for_budget(400, last_rate), 0, budgets=(100, 200, 400))
    )
    assert [spent for spent, _ in looks] == [100, 200, 400]
    for spent, found in looks:
        alone = train_method(method, small_set, for_budget(spent, last_rate), 0)
        assert found.steps == alone.steps
        assert found.curve == alone.curve
        for name, kept in found.tensors().items():
            assert np.array_equal(kept, alone.tensors()[name]), name
    policies = [found.policies.state_dict()["log_sigma"] for _, found in looks]
    assert not torch.equal(policies[0], policies[1])


@pytest.mark.parametrize("method", ["AIRL Single", "AIRL Batch", "MSRD"])
def test_where_an_iteration_crosses_half_of_a_budget_it_is_nearly_so(method, small_set):
    """The second iteration, which crosses 95 of 190 steps, runs at a rate of 1 instead of 0.95."""
    (spent, found), _ = comparison.train_to(method, small_set, for_budget(400, 0.1), 0, budgets=(190,))
    alone = train_method(method, small_set, for_budget(190, 0.1), 0)
    assert 2 * spent == found.steps == alone.steps
    for name, kept in found.tensors().items():
        assert kept == pytest.approx(alone.tensors()[name], abs=5e-4), name  # 3e-4 at the most
    pairs = zip(found.policies.parameters(), alone.policies.parameters(), strict=True)
    assert not all(torch.equal(one, other) for one, other in pairs)


def test_a_method_spends_what_its_settings_and_records_say(small_set):
    assert train_method("cloning", small_set, SETTINGS["ours"], 0).steps == 0
    coverage, two_iterations, two_users = 3 * 50, 2 * 50, 2
    warm, cold = (train_method("AIRL Single", small_set, SETTINGS[k], 0).steps for k in ("ours", "nothing"))
    assert (warm, cold) == (two_users * (coverage + two_iterations), two_users * two_iterations)
    loop = replace(tiny.TINY, own_rollouts=2)
    *_, state = learn(State(small_set.domain, 0), small_set, loop)
    learned, spent = comparison.learned_by(state), [record["steps"] for record in state.records]
    assert learned.steps == sum(s["airl"] + s["msrd"] + s["between_class"] for s in spent) > 0
    assert spent[1]["between_class"] == 2 * 2 * small_set.domain.horizon
    assert learned.search_steps == sum(s["search"] for s in spent) > 0
    assert np.array_equal(learned.weights, state.weights)
    assert (learned.task_part, learned.pure) == ("task", state.pure)


def test_unknown_method(small_set):
    with pytest.raises(InputError, match="unknown method 'GAIL': expected one of cloning, AIRL Single"):
        train_method("GAIL", small_set, SETTINGS["ours"], 0)
