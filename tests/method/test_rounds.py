import copy
from dataclasses import replace

import numpy as np
import pytest
from tiny import GENEROUS, PENDULUM, TINY, after, assert_same, copied, everything, forbid, same, watch

from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import rounds
from dmsrd_lite.method.airl import clone_demonstrations
from dmsrd_lite.method.between_class_discrimination import N_STATES
from dmsrd_lite.method.policy_mixture import MixtureFit
from dmsrd_lite.method.state import State


@pytest.fixture
def mixed(three, states):
    """Two strategies and a mixture of both, not yet in a round."""
    return states[2].explained(three.select([2]), np.array([0.25, 0.75]))


def test_a_round_has_all_demonstrations_and_the_decided_weights(three, mixed, monkeypatch):
    made = watch(monkeypatch, rounds, "MSRD")
    state, record, steps = rounds.play_round(mixed, False, 1e9, TINY, [0])
    (one,) = made
    states, weights, pure = one["between"]
    shown = {tuple(row) for row in three.observations[2].reshape(-1, 4)}
    assert states.shape == (3, N_STATES, 4)
    assert {tuple(row) for row in states[2]} <= shown, "of the third one's own states"
    assert np.array_equal(one["learner"].between[1].numpy(), weights)
    assert (weights.tolist(), tuple(pure)) == (mixed.weights.tolist(), (0, 1))
    assert np.array_equal(one["demonstrations"].observations, three.observations[:2]), "the pure ones"
    assert same(one["networks"], mixed.networks)
    assert same(one["learner"].networks(), state.networks)
    assert one["learner"].n_averaged == 2 + 2, "the average of the rewards goes on over the rounds"
    kl_after = 3 * TINY.measured_rollouts * three.horizon
    assert steps == {"search": kl_after, "msrd": 2 * 50, "between_class": 0}
    assert record["recognized"].tolist() == state.recognized([0, 1, 2]).tolist()
    for name, then in (("before", mixed), ("after", state)):
        assert np.array_equal(record[f"kl_{name}_round"], then.divergences(range(3), [0, 3], 2))
    assert (record["kl_before_round"] != record["kl_after_round"]).all()


def test_one_strategy_has_no_round(three, states, monkeypatch):
    """It has not moved since the search, so there is nothing to find either."""
    forbid(monkeypatch, (rounds, "MSRD"), (rounds, "search_mixture"))
    known = states[1].explained(three.select([1]), np.ones(1))
    state, record, steps = rounds.play_round(known, False, 1e-3, TINY, [0])
    assert state is known
    assert record["kl_before_round"] is record["kl_after_round"]
    assert (record["searched_again"], steps) == ({}, {"search": 0, "msrd": 0, "between_class": 0})


@pytest.mark.parametrize(
    ("before", "after_round", "found", "again", "replaced"),
    [
        (1.0, 9.0, 3.0, True, True),  # risen above its threshold of 2.0, and something nearer is found
        (2.0, 9.0, 9.0, True, False),  # nothing nearer is found
        (1.0, 2.0, 1.0, False, False),  # at the threshold
        (3.0, 9.0, 1.0, True, True),  # above before: it rose in a round that did not remember it, perhaps
    ],
)
def test_an_older_mixture_is_searched_again_where_its_kl_has_risen(
    before, after_round, found, again, replaced, three, mixed, monkeypatch
):
    """Demonstration 2 is a mixture with a threshold of 2, a fourth arrives; the KLs are made up."""
    record = {"threshold": 2.0, "n_strategies": 2}
    known = replace(mixed, records=(*mixed.records, record))
    known = known.explained(three.select([0]), np.array([0.5, 0.5]))
    kept, kls, searches = copied(known), [[1.0, 1.0, before, 1.0], [9.0, 9.0, after_round, 9.0]], []

    def search(*arguments, **keywords):
        searches.append((*arguments, copy.deepcopy(keywords)))
        return MixtureFit(np.array([0.6, 0.4]), found, np.zeros((1, 2)), np.zeros(1), 11)

    monkeypatch.setattr(rounds, "search_mixture", search)
    monkeypatch.setattr(State, "divergences", lambda *_: np.array(kls.pop(0)))
    state, record, steps = rounds.play_round(known, False, 1e-3, TINY, [0])
    assert len(searches) == again, "neither those of the strategies nor the newest is searched again"
    assert steps["search"] == 11 * again + 4 * TINY.measured_rollouts * three.horizon
    assert record["searched_again"] == ({2: [after_round, found]} if again else {})
    weights = [0.6, 0.4] if replaced else [0.25, 0.75]
    assert state.weights.tolist() == [[1, 0], [0, 1], weights, [0.5, 0.5]]
    assert same(everything(known), kept), "a state is never changed"
    for actor, shown, settings, _, keywords in searches:
        assert np.array_equal(shown.observations[0], three.observations[2])
        assert settings == TINY.mixture
        assert (keywords["incumbent"].tolist(), keywords["enough"]) == ([0.25, 0.75], 2.0)
        x, now = three.observations[:2, 0], state.policies().actor()
        assert np.array_equal(actor.mean(x), now.mean(x)), "the policies are those after the round"


@pytest.mark.parametrize(
    ("between_class", "created", "asked"),
    [("always", True, True), ("always", False, True), ("mixtures", True, False), ("mixtures", False, True),
     ("never", False, False)],
)  # fmt: skip
def test_equation_4_is_asked_after_some_branches(between_class, created, asked, mixed, monkeypatch):
    made = watch(monkeypatch, rounds, "MSRD")
    rounds.play_round(mixed, created, 1e9, replace(TINY, between_class=between_class), [0])
    assert (made[0]["between"] is not None) == asked


@pytest.mark.parametrize("own_clones", [False, True])
def test_equation_4_can_be_asked_on_rollouts_of_what_explains_people(own_clones, mixed, monkeypatch):
    """Or of a clone of each demonstration, the mixture's, too."""
    made = watch(monkeypatch, rounds, "MSRD")
    settings = replace(TINY, own_rollouts=2, own_clones=own_clones)
    _, _, steps = rounds.play_round(mixed, False, 1e9, settings, [0])
    states, weights, _ = made[0]["between"]
    clones = clone_demonstrations(mixed.shown, [0, 7, 2], TINY.airl.cloning_steps).actor()
    flown = rollout(mixed.domain, clones if own_clones else mixed.mixtures(), 2, [0, 7, 0])
    known = {tuple(row) for row in flown.observations[2].reshape(-1, 4)}
    assert {tuple(row) for row in states[2]} <= known
    assert steps["between_class"] == flown.n_steps
    assert weights.tolist() == mixed.weights.tolist()


def test_an_older_mixture_keeps_its_weights_where_nobody_searches_again(mixed, three, monkeypatch):
    forbid(monkeypatch, (rounds, "search_mixture"))
    known = replace(mixed, records=(*mixed.records, {"threshold": 0.0, "n_strategies": 2}))
    known = known.explained(three.select([0]), np.array([0.5, 0.5]))
    state, record, _ = rounds.play_round(known, False, 0.0, replace(TINY, search_again=False), [0])
    assert record["searched_again"] == {}
    assert state.weights.tolist() == known.weights.tolist()


@pytest.mark.parametrize("created", [True, False])
@pytest.mark.parametrize("after_new", [True, False])
@pytest.mark.parametrize("after_mixture", [True, False])
def test_a_round_can_leave_policies_alone(after_new, after_mixture, created, mixed):
    """Then no KL is measured but after a new strategy, which may help; rewards always learn."""
    settings = replace(TINY, policies_after_new=after_new, policies_after_mixture=after_mixture)
    moving = after_new if created else after_mixture
    state, record, _ = rounds.play_round(mixed, created, 1e9, settings, [0])
    for part in ("policies.", "averaged.task_reward.", "averaged.strategy_reward."):
        now, then = ({k: v for k, v in s.networks.items() if k.startswith(part)} for s in (state, mixed))
        assert same(now, then) == (part == "policies." and not moving), part
    assert len(record["kl_before_round"]) == (3 if moving else 0)
    assert len(record["kl_after_round"]) == (3 if moving or created else 0)


def test_a_round_works_on_a_bounded_sample_and_measures_no_more(three, states, monkeypatch):
    made, settings = watch(monkeypatch, rounds, "MSRD"), replace(GENEROUS, remembered=1)
    state = after(states[2], three.select([2, 2, 2]), settings)
    assert [len(r["remembered"]) for r in state.records[2:]] == [3, 4, 4]
    for r, one in zip(state.records[2:], made, strict=True):
        some, n = r["remembered"], r["demonstration"]
        assert {0, 1, n} <= set(some) <= set(range(n + 1))
        assert len(r["kl_before_round"]) == len(r["kl_after_round"]) == len(some)
        asked, weights, pure = one["between"]
        assert len(asked) == len(some)
        assert np.array_equal(weights, state.weights[some])
        assert [some[i] for i in pure] == [0, 1]
    wide = [after(states[2], three.select([2]), replace(GENEROUS, remembered=n)) for n in (5, 0)]
    assert_same(*wide)


def test_the_mixture_nearest_to_each_strategy_is_always_remembered():
    table = np.vstack([np.eye(2), np.random.default_rng(0).dirichlet((2, 2), 20)])
    nearest = {2 + int(table[2:-1, 0].argmax()), 2 + int(table[2:-1, 1].argmax())}
    state = State(PENDULUM, 0, None, table, (0, 1))
    drawn = [rounds.remembered(state, 4, [seed]) for seed in range(50)]
    assert all(len(some) == 2 + 1 + 4 and {0, 1, 21} | nearest <= set(some) for some in drawn)
    assert all((np.diff(some) > 0).all() for some in drawn)
    assert len(set.union(*map(set, drawn))) == 22, "the other two are drawn among all"
    assert rounds.remembered(state, 1, [0]).tolist() == [0, 1, min(nearest), 21]
    assert all(len(rounds.remembered(state, n, [0])) == 22 for n in (0, 19, 20))
