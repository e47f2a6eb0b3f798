import inspect
import json
import re
from collections import Counter
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import assert_decisions_follow, balancers
from tiny import GENEROUS, PENDULUM, ROUGH, TINY, after, assert_same, copied, everything, forbid, same, watch

from dmsrd_lite.demonstrations import demonstrations_from
from dmsrd_lite.domains import LUNAR_LANDER, InputError
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import airl, divergence, dmsrd, rounds
from dmsrd_lite.method.state import State

WITHOUT_COVERAGE = {name: replace(getattr(ROUGH, name), coverage="none") for name in ("airl", "msrd")}
FIELDS = """demonstration branch kl_mix kl_new threshold reference weights n_strategies steps seconds
shortfall remembered kl_before_round kl_after_round searched_again recognized"""


def answer_with(monkeypatch, *, kl_mix=None, kl_new=None):
    """Let the search or the new strategy come out with a given divergence."""
    search = dmsrd.search_mixture
    if kl_mix is not None:
        found = lambda *a, **k: replace(search(*a, **k), divergence=kl_mix)  # noqa: E731
        monkeypatch.setattr(dmsrd, "search_mixture", found)
    if kl_new is not None:
        monkeypatch.setattr(dmsrd, "policy_divergences", lambda *_: np.array([kl_new]))


def test_the_loop_fits_a_screen_and_carries_the_papers_line_numbers():
    source = inspect.getsource(dmsrd.learn_one)
    assert len(source.splitlines()) <= 45
    told = re.findall(r"# (\d+(?:, \d+)*)(?::|$)", source, re.MULTILINE)
    found = [[int(n) for n in numbers.split(", ")] for numbers in told]
    assert sorted(n for numbers in found for n in numbers) == list(range(3, 18))
    assert found == [*sorted(found[:-1]), [7, 13, 17]], "in the paper's order, and the rounds at the end"


BY_ACTIONS = replace(ROUGH, likelihood_margin=0.3, mixture=replace(ROUGH.mixture, from_actions=True))


@pytest.mark.parametrize(
    ("kl_mix", "shortfalls", "branch"),
    [(99.0, [0.29], "mixture"), (0.0, [0.31, 0.1], "new strategy"), (99.0, [0.31, 0.31], "new strategy"),
     (99.0, [0.31, 0.32], "mixture, better than a new strategy")],
)  # fmt: skip
def test_actions_can_decide_in_place_of_the_kl(kl_mix, shortfalls, branch, three, states, monkeypatch):
    answer_with(monkeypatch, kl_mix=kl_mix, kl_new=1.0)
    asked, told = [], iter(shortfalls)
    monkeypatch.setattr(dmsrd, "_shortfall", lambda actor, *_: asked.append(actor.n_strategies) or next(told))
    state = after(replace(states[2], form=BY_ACTIONS.form), three.select([2]), BY_ACTIONS)
    assert asked == [2, 1][: len(shortfalls)], "those known, then what AIRL made"
    record = state.records[-1]
    assert (record["branch"], record["shortfall"]) == (branch, shortfalls[0])
    assert BY_ACTIONS.as_printed().likelihood_margin == 0
    assert "likelihood_margin" in BY_ACTIONS.form


def test_the_shortfall_is_nothing_for_who_is_among_them_and_large_for_others():
    own = SimpleNamespace(clone=balancers([0.4]))
    shown = demonstrations_from(rollout(PENDULUM, own.clone, 2, 1, horizon=60), own.clone)
    assert dmsrd._shortfall(balancers([-0.4, 0.4]), shown, own) == pytest.approx(0, abs=1e-6)
    assert dmsrd._shortfall(balancers([-0.4, 0.0]), shown, own) > 0.1


def test_likelihoods_decide_only_from_clones_and_their_actions():
    for change, number in (({"mixture": ROUGH.mixture}, 0.3), ({"likelihood_margin": -1.0}, -1.0)):
        with pytest.raises(InputError, match=f"^likelihood_margin {number}: expected "):
            replace(BY_ACTIONS, **change)


def test_an_alpha_that_cannot_be_is_refused(three, states):
    with pytest.raises(InputError, match=r"alpha 0.0: expected a positive weight of the strategy rewards"):
        replace(ROUGH, msrd=replace(ROUGH.msrd, alpha=0.0))
    other = replace(ROUGH, msrd=replace(ROUGH.msrd, alpha=3.0))
    with pytest.raises(InputError, match=r"^a state with alpha 0.3 cannot go on with 3; expected the same"):
        after(states[2], three.select([2]), other)


def test_the_first_demonstration_makes_the_first_strategy(three, monkeypatch):
    forbid(monkeypatch, (rounds, "MSRD"), (dmsrd, "search_mixture"))
    made = watch(monkeypatch, dmsrd, "AIRL")
    state = after(State(PENDULUM, 0), three.select([0]))
    (record,) = state.records
    assert [record[k] for k in ("branch", "kl_mix", "weights", "recognized")] == [
        "new strategy", None, [1.0], [True]]  # fmt: skip
    kl_new = 10 * 50
    assert record["steps"] == {"search": kl_new, "airl": 50 + 3 * 50, "msrd": 0, "between_class": 0}
    assert (state.weights.tolist(), state.pure, state.n_strategies) == ([[1.0]], (0,), 1)
    assert same(state.networks, made[0]["learner"].networks())
    assert not state.rewards().evaluate(three.observations, "task").any()


@pytest.mark.parametrize(
    ("kl_mix", "kl_new", "branch"),
    [
        (1.9, None, "mixture"),
        (2.0, 3.0, "mixture, better than a new strategy"),  # the paper: the mixture where KL_mix < eps
        (3.0, 2.1, "new strategy"),
        (3.0, 3.0, "new strategy"),  # the paper: the mixture where KL_mix < KL_new
    ],
)
def test_decisions_by_hand(kl_mix, kl_new, branch, three, states, monkeypatch):
    answer_with(monkeypatch, kl_mix=kl_mix, kl_new=kl_new)
    if kl_new is None:
        forbid(monkeypatch, (dmsrd, "AIRL"), (rounds, "MSRD"))
    state = after(states[1], three.select([1]), replace(ROUGH, kl_threshold=2.0))
    record, created = state.records[1], branch == "new strategy"
    assert (record["branch"], record["kl_mix"], record["kl_new"]) == (branch, kl_mix, kl_new)
    assert record["n_strategies"] == len(state.rewards().evaluate(np.zeros(4))) == 1 + created
    assert state.pure == ((0, 1) if created else (0,))
    assert state.weights.tolist() == ([[1, 0], [0, 1]] if created else [[1], [1]])
    decided = (
        0 if kl_new is None else 10 + 2 * ROUGH.measured_rollouts * created
    )  # KL_new, KL after the round
    assert record["steps"]["search"] == 50 * (1 + 2 + 2 + decided)
    assert [record["steps"][k] > 0 for k in ("airl", "msrd")] == [kl_new is not None, created]
    assert same(state.networks, states[1].networks) != created, "one strategy alone has no round"


def test_a_rejected_airl_leaves_no_trace(three, states, monkeypatch):
    """Two strategies, a third demonstration: all goes on as if its mixture had been near, without AIRL."""
    given = watch(monkeypatch, rounds, "MSRD")
    with monkeypatch.context() as patch:
        forbid(patch, (dmsrd, "AIRL"))
        without = after(states[2], three.select([2]), GENEROUS)
    answer_with(monkeypatch, kl_mix=2e9, kl_new=float("inf"))
    rejected = after(states[2], three.select([2]), GENEROUS)
    assert [s.records[2]["branch"] for s in (without, rejected)] == [dmsrd.MIXTURE, dmsrd.BETTER_MIXTURE]
    assert rejected.records[2]["steps"]["airl"] > 0
    assert all(same(one["networks"], states[2].networks) for one in given)
    assert same(everything(without), everything(rejected))
    assert not same(rejected.networks, states[2].networks), "the round must have moved them"
    for name in ("weights", "kl_before_round", "kl_after_round", "searched_again", "recognized"):
        assert without.records[2][name] == rejected.records[2][name]


@pytest.mark.parametrize("add_task_reward", [True, False])
def test_the_task_reward_is_added_to_what_a_new_strategy_learns(add_task_reward, three, states, monkeypatch):
    made = watch(monkeypatch, dmsrd, "AIRL")
    settings = replace(ROUGH, add_task_reward=add_task_reward)
    after(replace(states[2], form=settings.form), three.select([2]), settings)
    known = states[2].rewards().evaluate(three.observations, "task")
    added = made[0]["learner"].rewards.evaluate(three.observations, "task")
    assert known.any()
    assert made[0]["learner"].alpha == TINY.msrd.alpha
    assert np.array_equal(added, known) if add_task_reward else not added.any()


def test_records_say_everything_in_json(states):
    records = states[3].records
    assert_decisions_follow(records, states[3].n_strategies)
    assert [states[n].records for n in range(4)] == [records[:n] for n in range(4)]
    for n, record in enumerate(records):
        assert sorted(record) == sorted(FIELDS.split())
        assert json.loads(json.dumps(record, allow_nan=False)) == record
        m = states[n + 1].n_strategies
        assert (record["demonstration"], record["n_strategies"], record["threshold"]) == (n, m, 1e-3)
        assert len(record["kl_before_round"]) == len(record["kl_after_round"]) == n + 1
        assert len(record["weights"]) == len(record["recognized"]) == m
        assert sum(record["weights"]) == pytest.approx(1)
        assert record["seconds"] > 0


@pytest.mark.parametrize("form", [ROUGH, replace(ROUGH, search_again=False)])
def test_steps_are_those_of_the_simulator(form, three, states, monkeypatch):
    """Of the learners and of every KL that decides something; a KL for the record alone is not counted."""
    simulated, rollout = Counter(), airl.rollout

    def counting(module, *arguments, **keywords):
        data = rollout(*arguments, **keywords)
        simulated[module] += data.n_steps
        return data

    for module in (airl, divergence):
        monkeypatch.setattr(module, "rollout", partial(counting, module))
    known = replace(states[2], form=form.form)
    record = after(known, three.select([2]), form).records[2]
    steps, told = record["steps"], form.measured_rollouts * three.horizon
    for_the_record = told * len(record["kl_before_round"])
    for_the_record += 0 if form.search_again else told * len(record["kl_after_round"])
    assert for_the_record > 0
    assert steps["airl"] + steps["msrd"] == simulated[airl] > steps["airl"] > 0
    assert 0 < steps["search"] == simulated[divergence] - for_the_record


def test_the_threshold_is_calibrated_by_the_demonstration_itself(three, domain):
    a, b = three.observations[0, :, 1:]
    settings = replace(ROUGH, kl_threshold=0.0, kl_margin=0.75)
    arrays = {k: v[:, :1] for k, v in three.select([0]).arrays().items() if k != "strategy_labels"}
    single = replace(three, strategy_labels=None, **arrays)
    own = (divergence.knn_divergence(a, b) + divergence.knn_divergence(b, a)) / 2
    for shown, reference in ((three.select([0]), own), (single, domain.comparison.own_at_most)):
        (record,) = after(State(PENDULUM, 0), shown, settings).records
        assert record["reference"] == pytest.approx(reference)
        assert record["threshold"] == record["reference"] + 0.75


@pytest.mark.parametrize("warm", [True, False])
def test_on_the_lander_the_clone_calibrates_the_threshold(lander_set, warm, monkeypatch):
    made, lander = watch(monkeypatch, dmsrd, "AIRL"), LUNAR_LANDER.on_threads(1)
    first = replace(lander_set.select([0]), domain=lander)
    kind = {"start": "clone", "coverage": "half"} if warm else {"start": "nothing", "coverage": "none"}
    parts = {k: replace(getattr(ROUGH, k), **kind) for k in ("airl", "msrd")}
    (record,) = after(State(lander, 0), first, replace(TINY, kl_threshold=0.0, **parts)).records
    assert len(made) == 1, "the clone that AIRL starts from is the one that calibrates"
    clone = made[-1]["learner"].clone
    assert (clone is not None) == warm
    clone = clone or airl.clone_demonstrations(first, [0, 102, 0, 7, 101], ROUGH.airl.cloning_steps).actor()
    as_many = {"n_rollouts": TINY.mixture.final_rollouts}
    assert record["reference"] == divergence.policy_divergences(clone, first, [0, 102, 0, 7], **as_many)[0]
    assert record["threshold"] == record["reference"] + TINY.kl_margin


BAD_SETTINGS = [
    *(({"kl_threshold": bad}, f"kl_threshold {bad}: expected a positive number of nats, or 0 to calibrate it")
      for bad in (-0.1, float("nan"), float("inf"))),
    *(({name: part}, "coverage differs between airl and msrd: expected the same, because")
      for name, part in WITHOUT_COVERAGE.items()),
    ({"airl": replace(ROUGH.airl, start="nothing")}, "start differs between airl and msrd: expected the"),
    ({"between_class": True}, "between_class True: expected one of always, mixtures, never"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "sentence"), BAD_SETTINGS)
def test_bad_settings_are_refused_in_one_sentence(change, sentence):
    with pytest.raises(InputError, match=f"^{sentence}[^\n]*$"):
        replace(TINY, **change)


def test_without_coverage(three, states):
    state = after(states[0], three.select([0]), replace(TINY, **WITHOUT_COVERAGE))
    assert state.networks.keys() == {name for name in states[1].networks if not name.startswith("coverage.")}
    assert state.records[0]["steps"]["airl"] == 50
    kept = copied(state)
    with pytest.raises(
        InputError, match=r"^a state that was learned from clone, add_task_reward.* cannot go"
    ):
        after(state, three.select([1]))
    assert same(everything(state), kept)


def test_a_state_goes_on_in_the_form_that_made_it(three, states):
    """Another form or another start is refused in one sentence; more memory, other rates are the same."""
    for other in (TINY.as_printed(), replace(TINY, search_again=False)):
        assert other.form != TINY.form
        with pytest.raises(
            InputError, match=f"^a state .* cannot go on {other.form}; expected the same form$"
        ):
            after(states[2], three.select([2]), other)
    assert replace(TINY, remembered=3, kl_margin=2.0).form == TINY.form


def test_as_printed_takes_every_deviation_back():
    rest = {"policies_after_new": False, "policies_after_mixture": False}
    printed = replace(TINY, own_rollouts=5, own_clones=True, remembered=2, **rest).as_printed()
    assert printed.form == "from clone with coverage, as printed"
    assert (printed.between_class, printed.own_rollouts, printed.remembered) == ("mixtures", 0, 0)
    assert not printed.own_clones
    assert printed.policies_after_new
    assert printed.policies_after_mixture
    off = printed.add_task_reward, printed.task_learns, printed.search_again, printed.mixture.from_actions
    assert off == (False, False, False, False)
    assert not printed.msrd.between_class_relative
    assert printed.airl == TINY.airl


def test_the_task_reward_learns_with_a_new_strategy_and_goes_its_share_of_the_way(three, monkeypatch):
    """By hand: the first candidate's R_Task whole, half of the way to the second's; as printed it rests."""
    learning, made = replace(TINY, task_learns=True), watch(monkeypatch, dmsrd, "AIRL")
    monkeypatch.setattr(dmsrd, "play_round", lambda state, *_: (state, {}, {"search": 0}))
    for settings in (learning, TINY.as_printed()):
        made.clear()
        state = after(State(PENDULUM, 0), three.select([0, 1]), replace(settings, kl_threshold=1e-9))
        assert state.n_strategies == 2
        first, second = (one["learner"].networks() for one in made)
        names = [name for name in state.networks if ".task_reward." in name]
        for name in names:
            expected = (first[name] + second[name]) / 2 if settings is learning else first[name]
            torch.testing.assert_close(state.networks[name], expected)
        moved = [not torch.equal(first[name], second[name]) for name in names]
        assert any(moved), "or half of the way is no way"


def test_same_seed_same_bits_for_any_number_of_threads(three, states):
    domain = PENDULUM.on_threads(2)
    assert_same(after(State(domain, 0), replace(three.select([0, 1]), domain=domain)), states[2])
    assert not same(after(State(PENDULUM, 1), three.select([0])).networks, states[1].networks)


def test_learning_is_a_function_of_its_arguments_alone(three, states):
    """No state, no demonstration and no global generator changes; any earlier state can be gone on from."""

    def world():
        generators = {"numpy": np.random.get_state()[1].copy(), "torch": torch.get_rng_state()}  # noqa: NPY002
        return generators | {k: v.copy() for k, v in three.arrays().items()}

    torch.manual_seed(7)  # unlike any that a careless line would set
    before, known, records = world(), copied(states[1]), json.dumps(states[1].records)
    after(states[1], three.select([1, 2]), GENEROUS)  # other settings leave nothing behind
    assert_same(after(states[1], three.select([1])), states[2])
    assert same(world(), before)
    assert same(everything(states[1]), known)
    assert json.dumps(states[1].records) == records


def test_an_interruption_changes_nothing(three, states, monkeypatch):
    before = copied(states[2])
    for fault in ((dmsrd, "search_mixture"), (dmsrd, "AIRL"), (rounds, "MSRD")):
        with monkeypatch.context() as patch:
            forbid(patch, fault)
            with pytest.raises(AssertionError, match="must not be made"):
                after(states[2], three.select([2]), ROUGH)
        assert same(everything(states[2]), before)


BAD = {
    "other domain": (lambda d: replace(d, domain=replace(d.domain, name="other")),
        "a demonstration of other arrived; expected one of inverted_pendulum"),
    "shorter": (lambda d: replace(d, observations=d.observations[:, :, :-10], actions=d.actions[:, :, :-10]),
        r"a demonstration with observations of shape \(2, 41, 4\) arrived; expected \(2, 51, 4\)"),
    "fewer": (lambda d: replace(d, observations=d.observations[:, :1], actions=d.actions[:, :1]),
        r"a demonstration with observations of shape \(1, 51, 4\) arrived; expected \(2, 51, 4\)"),
    "last successor unknown": (lambda d: replace(d, actions=d.actions[:, :, [*range(50), 49]]),
        r"a demonstration with actions of shape \(2, 51, 1\) arrived; expected \(2, 50, 1\) .* as before"),
    "no number": (lambda d: replace(d, actions=np.where(d.actions > 0, np.nan, d.actions)),
        "demonstration 2 cannot be learned from: actions: holds NaN or infinity, first at index"),
    "out of bounds": (lambda d: replace(d, actions=d.actions + 10), "demonstration 2 cannot be learned "),
    "two at once": (lambda d: d.select([0, 0]), "2 demonstrations arrived together; expected one"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_demonstration_is_refused_in_one_sentence(fault, three, states):
    spoil, sentence = BAD[fault]
    bare = replace(three.select([2]), rewards=None, reset_seeds=None)
    with pytest.raises(InputError, match=f"^{sentence}[^\n]*$"):
        dmsrd.learn_one(states[2], spoil(bare), ROUGH)


def test_optional_fields_may_be_missing(three, states):
    bare = replace(three.select([2]), rewards=None, strategy_labels=None, reset_seeds=None)
    state = after(states[2], bare)
    assert state.shown.arrays().keys() == {"observations", "actions"}
    assert same(state.networks, states[3].networks), "nothing is learned from them"
