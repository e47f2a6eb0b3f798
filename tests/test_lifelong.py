import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from test_mixture import balancers, shown_by

from dmsrd_lite import airl, lifelong, metrics
from dmsrd_lite.airl import AIRLSettings
from dmsrd_lite.divergence import knn_divergence
from dmsrd_lite.envs import INVERTED_PENDULUM, LUNAR_LANDER, InputError
from dmsrd_lite.lifelong import DMSRD, LifelongSettings, LifelongState, load_state, save_state
from dmsrd_lite.mixture import MixtureSettings
from dmsrd_lite.msrd import MSRDSettings
from dmsrd_lite.policy_optimization import PPOSettings

SHORT = {"n_iterations": 1, "episodes": 1, "cloning_steps": 150, "coverage_episodes": 1, "coverage_levels": ((1, 0), (3, 0)),
         "replay_samples": 30,
         "discriminator_steps": 2, "discriminator_batch": 16, "ppo": PPOSettings(minibatch=25)}  # fmt: skip
TINY = LifelongSettings(kl_threshold=1e-3, airl=AIRLSettings(**SHORT), msrd=MSRDSettings(**SHORT, between_class_batch=16),
                        mixture=MixtureSettings(4, 2, search_rollouts=1, n_finalists=2, final_rollouts=2))  # fmt: skip
GENEROUS = dataclasses.replace(TINY, kl_threshold=1e9)  # every mixture will do
FIELDS = {"demonstration", "branch", "kl_mix", "kl_new", "reference", "threshold", "weights", "n_strategies", "steps",
          "remembered", "kl_before_round", "kl_after_round", "searched_again", "recognized", "seconds"}  # fmt: skip


@pytest.fixture(scope="module")
def three():
    """Three demonstrations of 50 steps that balance in three places."""
    return shown_by(balancers([-0.4, 0.4, 0.0]), 50)


@pytest.fixture(scope="module")
def states(three):
    """What is known after none, one, two and three demonstrations, two strategies after the second."""
    learner = DMSRD(INVERTED_PENDULUM, TINY, 0, 1)
    found = [learner.state, *(learner.state for _ in learner.learn(three))]
    assert found[2].n_strategies == 2
    return found


def after(state, demonstrations, settings=TINY, n_threads=1):
    learner = DMSRD(INVERTED_PENDULUM, settings, state.seed, n_threads, state)
    list(learner.learn(demonstrations))
    return learner.state


def same_tensors(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def assert_same(a, b):
    """Two states bit for bit, but for the time they took."""
    assert (a.domain, a.seed, a.pure) == (b.domain, b.seed, b.pure)
    assert a.weights.dtype == b.weights.dtype
    assert np.array_equal(a.weights, b.weights)
    assert same_tensors(a.networks, b.networks)
    assert [{**r, "seconds": 0} for r in a.records] == [{**r, "seconds": 0} for r in b.records]
    shown = [{} if s.demonstrations is None else s.demonstrations.arrays() for s in (a, b)]
    assert shown[0].keys() == shown[1].keys()
    for name, array in shown[0].items():
        assert array.dtype == shown[1][name].dtype
        assert np.array_equal(array, shown[1][name]), name


def answer_with(monkeypatch, *, kl_mix=None, kl_new=None):
    """Let the search or the new strategy come out with a given divergence."""
    search, train = lifelong.search_mixture, DMSRD._train
    if kl_mix is not None:
        monkeypatch.setattr(lifelong, "search_mixture", lambda *a, **k: dataclasses.replace(search(*a, **k), divergence=kl_mix))
    if kl_new is not None:
        monkeypatch.setattr(DMSRD, "_train", lambda self, *a: (train(self, *a), kl_new)[1])


def forbid(monkeypatch, *names):
    def never(*arguments, **keywords):
        raise AssertionError("must not be made")

    for name in names:
        monkeypatch.setattr(lifelong, name, never)


def watch(monkeypatch, name, seen):
    """Keep every learner that is made, with what it was given."""
    original = getattr(lifelong, name)

    def make(demonstrations, settings, seed, n_threads=0, **keywords):
        seen.append({"demonstrations": demonstrations, **keywords})
        seen[-1]["learner"] = original(demonstrations, settings, seed, n_threads, **keywords)
        return seen[-1]["learner"]

    monkeypatch.setattr(lifelong, name, make)


def test_the_first_demonstration_makes_the_first_strategy(three, monkeypatch):
    forbid(monkeypatch, "MSRD", "search_mixture")
    made = []
    watch(monkeypatch, "AIRL", made)
    state = after(LifelongState(INVERTED_PENDULUM, 0), three.select([0]))
    (record,) = state.records
    assert record["branch"] == "new strategy"
    assert (record["kl_mix"], record["n_strategies"], record["weights"], record["recognized"]) == (None, 1, [1.0], [True])
    assert record["steps"] == {"search": 0, "airl": 50 + 3 * 50, "msrd": 0}
    assert state.weights.tolist() == [[1.0]]
    assert state.pure == (0,)
    assert same_tensors(state.networks, made[0]["learner"].networks())
    assert not DMSRD(INVERTED_PENDULUM, TINY, 0, state=state).rewards().evaluate(three.observations, "task").any()


def test_a_close_mixture_is_taken_without_airl_and_one_strategy_has_no_round(three, states, monkeypatch):
    forbid(monkeypatch, "AIRL", "MSRD")
    state = after(states[1], three.select([1]), GENEROUS)
    record = state.records[1]
    assert record["branch"] == "mixture"
    assert (record["kl_new"], record["n_strategies"], record["weights"]) == (None, 1, [1.0])
    assert record["steps"] == {"search": 50 * (1 + 2 + 2), "airl": 0, "msrd": 0}
    assert record["kl_after_round"] == record["kl_before_round"]
    assert state.weights.tolist() == [[1.0], [1.0]]
    assert state.pure == (0,)
    assert same_tensors(state.networks, states[1].networks)


@pytest.mark.parametrize(
    ("kl_mix", "kl_new", "branch"),
    [
        (2.0, None, "mixture"),  # at the threshold
        (2.1, 3.0, "mixture, better than a new strategy"),
        (3.0, 2.1, "new strategy"),
        (3.0, 3.0, "new strategy"),  # the paper: the mixture where KL_mix < KL_new
    ],
)
def test_decisions_by_hand(kl_mix, kl_new, branch, three, states, monkeypatch):
    answer_with(monkeypatch, kl_mix=kl_mix, kl_new=kl_new)
    state = after(states[1], three.select([1]), dataclasses.replace(TINY, kl_threshold=2.0))
    record = state.records[1]
    assert (record["branch"], record["kl_mix"], record["kl_new"]) == (branch, kl_mix, kl_new)
    created = branch == "new strategy"
    rewards = DMSRD(INVERTED_PENDULUM, TINY, 0, state=state).rewards()
    assert record["n_strategies"] == state.n_strategies == len(rewards.evaluate(np.zeros(4))) == 1 + created
    assert state.pure == ((0, 1) if created else (0,))
    assert state.weights.tolist() == ([[1, 0], [0, 1]] if created else [[1], [1]])
    assert (record["steps"]["airl"] > 0) == (kl_new is not None)
    assert (record["steps"]["msrd"] > 0) == created


def test_a_far_demonstration_makes_a_strategy_by_itself(states):
    record = states[2].records[1]
    assert record["branch"] == "new strategy"
    assert record["kl_mix"] > record["kl_new"]
    assert record["weights"] == [0.0, 1.0]
    assert record["kl_before_round"][1] < record["kl_mix"]


def test_a_rejected_airl_leaves_no_trace(three, states, monkeypatch):
    """Two strategies and a third demonstration: all that follows is as if its mixture had been near and no AIRL had run."""
    rounds = []
    watch(monkeypatch, "MSRD", rounds)
    untouched = {k: v.clone() for k, v in states[2].networks.items()}
    with monkeypatch.context() as patch:
        forbid(patch, "AIRL")
        without = after(states[2], three.select([2]), GENEROUS)
    answer_with(monkeypatch, kl_mix=2e9, kl_new=float("inf"))
    rejected = after(states[2], three.select([2]), GENEROUS)
    assert [s.records[2]["branch"] for s in (without, rejected)] == ["mixture", "mixture, better than a new strategy"]
    assert rejected.records[2]["steps"]["airl"] > 0
    for one in rounds:
        assert same_tensors(one["networks"], untouched)
    assert same_tensors(states[2].networks, untouched), "a state is never changed"
    assert same_tensors(without.networks, rejected.networks)
    assert not same_tensors(rejected.networks, untouched), "the round must have moved them, or this test says nothing"
    assert np.array_equal(without.weights, rejected.weights)
    assert rejected.pure == (0, 1)
    for name in ("weights", "kl_before_round", "kl_after_round", "searched_again", "recognized"):
        assert without.records[2][name] == rejected.records[2][name]


def test_a_new_strategy_leaves_the_others_as_they_are(three, states, monkeypatch):
    """With a round of no iterations what comes out is the old networks and, behind them, the new ones."""
    made = []
    watch(monkeypatch, "AIRL", made)
    answer_with(monkeypatch, kl_new=-float("inf"))
    settings = dataclasses.replace(TINY, msrd=dataclasses.replace(TINY.msrd, n_iterations=0, between_class_extra=0))
    old = {k: v + 0.1 if k.startswith("rewards.task_reward.") else v for k, v in states[2].networks.items()}  # unlike its average
    state = after(dataclasses.replace(states[2], networks=old), three.select([2]), settings)
    new = made[0]["learner"].networks()
    assert state.pure == (0, 1, 2)
    assert state.networks.keys() == old.keys()
    for name, tensor in state.networks.items():
        if ".task_reward." in name:
            assert torch.equal(tensor, old[name]), name
        else:
            assert torch.equal(tensor, torch.cat([old[name], new[name]])), name
    assert state.weights.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert state.records[2]["kl_after_round"] == state.records[2]["kl_before_round"], "a round of nothing changes nothing"
    x = np.random.default_rng(0).normal(size=(1, 5, 4))
    means = [DMSRD(INVERTED_PENDULUM, TINY, 0, state=s).policies().actor().mean(x) for s in (states[2], state)]
    assert np.allclose(means[0], means[1][:2], atol=1e-6)


def test_the_round_has_all_demonstrations_and_the_decided_weights(three, states, monkeypatch):
    rounds = []
    watch(monkeypatch, "MSRD", rounds)
    state = after(states[2], three.select([2]), GENEROUS)
    (one,) = rounds
    everyone, weights, pure = one["between"]
    assert np.array_equal(everyone.observations, three.observations)
    assert weights[:2].tolist() == [[1, 0], [0, 1]]
    assert weights[2].tolist() == state.records[2]["weights"] == state.weights[2].tolist()
    assert weights[2].min() > 0, "a mixture of both, or stale weights could be the same"
    assert weights[2].sum() == pytest.approx(1)
    assert tuple(pure) == (0, 1)
    assert np.array_equal(one["demonstrations"].observations, three.observations[:2]), "MSRD is trained on the pure demonstrations"
    assert torch.equal(one["learner"].between[1], torch.tensor(state.weights, dtype=torch.float32))
    assert same_tensors(one["learner"].networks(), state.networks)
    assert one["learner"].n_averaged == 2, "the average of the rewards goes on over the rounds"


@pytest.mark.parametrize(
    ("before", "after_round", "found", "again", "replaced"),
    [
        (1.0, 9.0, 3.0, True, True),  # risen above the threshold of 2.0, and something nearer is found
        (2.0, 9.0, 9.0, True, False),  # nothing nearer is found
        (1.0, 2.0, 1.0, False, False),  # at the threshold
        (3.0, 9.0, 1.0, True, True),  # it was above before: risen in a round that did not remember it, perhaps
    ],
)
def test_an_older_mixture_is_searched_again_where_its_kl_has_risen(before, after_round, found, again, replaced, three, states, monkeypatch):
    """Demonstration 2 is a mixture, a fourth arrives; the KLs before and after the round are made up."""
    old, searches, search = after(states[2], three.select([2]), GENEROUS), [], lifelong.search_mixture
    old = dataclasses.replace(old, records=tuple({**r, "threshold": 2.0} for r in old.records))
    kept, answers = old.weights.copy(), [np.array([1.0, 1.0, before, 1.0]), np.array([9.0, 9.0, after_round, 1.0])]

    def scripted(actor, demonstration, *arguments, incumbent=None, **keywords):
        fit = search(actor, demonstration, *arguments, incumbent=incumbent, **keywords)
        fit = dataclasses.replace(fit, weights=np.array([0.5, 0.5]), divergence=found if searches else 1.0)
        searches.append((demonstration, np.copy(incumbent), fit, actor))
        return fit

    monkeypatch.setattr(lifelong, "search_mixture", scripted)
    monkeypatch.setattr(DMSRD, "_divergences", lambda *_: answers.pop(0))
    state = after(old, three.select([0]), dataclasses.replace(TINY, kl_threshold=2.0))
    record = state.records[3]
    assert len(searches) == 1 + again, "pure demonstrations are never searched again"
    assert record["steps"]["search"] == sum(fit.steps for _, _, fit, _ in searches)
    assert record["searched_again"] == ({"2": [after_round, found]} if again else {})
    assert state.weights.tolist() == [[1, 0], [0, 1], [0.5, 0.5] if replaced else kept[2].tolist(), [0.5, 0.5]]
    assert np.array_equal(old.weights, kept), "a state is never changed"
    if again:
        shown, incumbent, _, actor = searches[1]
        assert np.array_equal(shown.observations[0], three.observations[2])
        assert np.array_equal(incumbent, kept[2])
        x, now = three.observations[:2, 0], DMSRD(INVERTED_PENDULUM, TINY, 0, state=state).policies().actor()
        assert np.array_equal(actor.mean(x), now.mean(x)), "the policies are those after the round"


def test_without_a_round_no_mixture_is_searched_again(three, states, monkeypatch):
    """The only strategy has not moved since the search, so there is nothing to find."""
    answer_with(monkeypatch, kl_new=float("inf"))
    record = after(states[1], three.select([1])).records[1]
    assert record["branch"] == "mixture, better than a new strategy"
    assert record["searched_again"] == {}
    assert record["steps"]["search"] == 50 * (1 + 2 + 2)


def test_between_class_discrimination_can_be_left_out(three, states, monkeypatch):
    rounds = []
    watch(monkeypatch, "MSRD", rounds)
    after(states[2], three.select([2]), dataclasses.replace(GENEROUS, between_class=False))
    assert rounds[0]["between"] is None


@pytest.mark.parametrize("add_task_reward", [True, False])
def test_the_task_reward_is_added_to_what_a_new_strategy_learns(add_task_reward, three, states, monkeypatch):
    made = []
    watch(monkeypatch, "AIRL", made)
    after(states[2], three.select([2]), dataclasses.replace(TINY, add_task_reward=add_task_reward))
    known = DMSRD(INVERTED_PENDULUM, TINY, 0, state=states[2]).rewards().evaluate(three.observations, "task")
    added = made[0]["learner"].rewards.evaluate(three.observations, "task")
    assert np.abs(known).max() > 0
    assert np.array_equal(added, known) if add_task_reward else not added.any()


def test_records_say_everything_in_json(states):
    records = states[3].records
    for n, record in enumerate(records):
        assert record.keys() == FIELDS
        assert json.loads(json.dumps(record, allow_nan=False)) == record
        m = states[n + 1].n_strategies
        assert (record["demonstration"], record["n_strategies"]) == (n, m)
        assert len(record["kl_before_round"]) == len(record["kl_after_round"]) == n + 1
        assert len(record["weights"]) == len(record["recognized"]) == m
        assert sum(record["weights"]) == pytest.approx(1)
        assert record["threshold"] == 1e-3
        assert record["seconds"] > 0
        assert set(record["recognized"]) <= {True, False}
    assert [states[n].records for n in range(4)] == [records[:n] for n in range(4)]


def test_steps_are_those_of_the_simulator(three, states, monkeypatch):
    """Of the learners and the searches; the rollouts that only measure a KL are not counted."""
    simulated, rollout, search = {"learners": 0, "searches": 0, "KL": 0}, airl.rollout, lifelong.search_mixture
    purpose = ["KL"]

    def counted(of_learners):
        def simulate(*arguments, **keywords):
            data = rollout(*arguments, **keywords)
            simulated["learners" if of_learners else purpose[-1]] += data.n_steps
            return data

        return simulate

    def searching(*arguments, **keywords):
        purpose.append("searches")
        fit = search(*arguments, **keywords)
        purpose.pop()
        return fit

    monkeypatch.setattr(airl, "rollout", counted(True))
    monkeypatch.setattr(metrics, "rollout", counted(False))
    monkeypatch.setattr(lifelong, "search_mixture", searching)
    steps = after(states[2], three.select([2])).records[2]["steps"]
    assert steps["airl"] + steps["msrd"] == simulated["learners"]
    assert steps["search"] == simulated["searches"]
    assert min(*steps.values(), simulated["KL"]) > 0


def test_what_explains_each_demonstration(three, states):
    """A pure demonstration is explained by its own strategy alone, and a mixture by the weighted means."""
    weights = np.array([[1.0, 0.0], [0.0, 1.0], [0.25, 0.75]])
    state = dataclasses.replace(states[2], weights=weights, demonstrations=three)
    learner = DMSRD(INVERTED_PENDULUM, TINY, 0, state=state)
    mixtures, actor = learner.mixtures(), learner.policies().actor()
    x = three.observations[:, 0]
    means = actor.mean(x[:1].repeat(2, 0)), actor.mean(x[1:2].repeat(2, 0)), actor.mean(x[2:].repeat(2, 0))
    assert mixtures.n_strategies == 3
    assert np.allclose(mixtures.mean(x), [means[0][0], means[1][1], 0.25 * means[2][0] + 0.75 * means[2][1]], atol=1e-6)


def test_the_threshold_is_calibrated_by_the_demonstration_itself(three, domain):
    a, b = three.observations[0, :, 1:]
    own = (knn_divergence(a, b) + knn_divergence(b, a)) / 2
    calibrated = dataclasses.replace(TINY, kl_threshold=0.0, kl_margin=0.75)
    (record,) = after(LifelongState(domain, 0), three.select([0]), calibrated).records
    assert record["reference"] == pytest.approx(own)
    assert record["threshold"] == pytest.approx(own + 0.75)
    single = {name: array[:, :1] for name, array in three.select([0]).arrays().items() if name != "strategy_labels"}
    (record,) = after(LifelongState(domain, 0), dataclasses.replace(three, strategy_labels=None, **single), calibrated).records
    assert record["reference"] == domain.kl_threshold
    assert record["threshold"] == domain.kl_threshold + 0.75


@pytest.mark.parametrize("bad", [-0.1, float("nan"), float("inf")])
def test_the_threshold_must_be_a_number_of_at_least_zero(bad):
    with pytest.raises(InputError, match=f"^kl_threshold {bad!r}: expected a positive number of nats, or 0 to calibrate it$"):
        LifelongSettings(kl_threshold=bad)


def test_coverage_is_on_or_off_in_both(three, states):
    off = {name: dataclasses.replace(getattr(TINY, name), coverage=False) for name in ("airl", "msrd")}
    for name in off:
        with pytest.raises(InputError, match=r"^coverage is on in only one of airl and msrd: expected both or neither"):
            dataclasses.replace(TINY, **{name: off[name]})
    state = after(states[0], three.select([0, 1]), dataclasses.replace(TINY, **off))
    assert state.networks.keys() == {name for name in states[2].networks if not name.startswith("coverage.")}
    assert [r["steps"]["airl"] for r in state.records] == [50, 50]


def test_same_seed_same_bits_for_any_number_of_threads(three, states):
    assert_same(after(states[0], three, n_threads=2), states[3])
    other = after(LifelongState(INVERTED_PENDULUM, 1), three.select([0]))
    assert not same_tensors(other.networks, states[1].networks)


def test_round_trip(states, tmp_path):
    for n, state in enumerate(states):
        path = save_state(tmp_path / f"{n}.safetensors", state)
        loaded = load_state(path, INVERTED_PENDULUM)
        assert_same(loaded, state)
        assert loaded.records == state.records


def test_metadata_of_the_demonstrations_is_kept(states, tmp_path):
    told = dataclasses.replace(states[1].demonstrations, metadata={"seed": 7})
    loaded = load_state(save_state(tmp_path / "a.safetensors", dataclasses.replace(states[1], demonstrations=told)), INVERTED_PENDULUM)
    assert loaded.demonstrations.metadata == {"seed": 7}


def test_going_on_after_a_load_equals_the_uninterrupted_run(three, states, tmp_path):
    loaded = load_state(save_state(tmp_path / "a.safetensors", states[2]), INVERTED_PENDULUM)
    assert_same(after(loaded, three.select([2])), states[3])
    learner = DMSRD(INVERTED_PENDULUM, TINY, 0, 1)
    next(learner.learn(three))  # a reader may stop here ...
    assert_same(learner.state, states[1])
    learner = DMSRD(INVERTED_PENDULUM, TINY, 99, 1, load_state(save_state(tmp_path / "b.safetensors", learner.state), INVERTED_PENDULUM))
    next(learner.learn(three.select([1])))  # ... and go on another day, one at a time; the seed is the state's
    assert_same(learner.state, states[2])


def without_successors(shown):
    """As many states as before, and one action more: the last successor is unknown."""
    fill = {name: np.concatenate([a, a[:, :, -1:]], axis=2) for name, a in shown.arrays().items() if name in ("actions", "rewards")}
    return dataclasses.replace(shown, **fill)


BAD = {
    "other domain": (
        lambda d: dataclasses.replace(d, domain=dataclasses.replace(d.domain, name="other")),
        "a demonstration of other arrived; expected one of inverted_pendulum"),
    "shorter": (
        lambda d: dataclasses.replace(d, observations=d.observations[:, :, :-10], actions=d.actions[:, :, :-10], rewards=None),
        r"a demonstration with observations of shape \(2, 41, 4\) arrived; expected \(2, 51, 4\)"),
    "fewer trajectories": (lambda d: dataclasses.replace(d, observations=d.observations[:, :1], actions=d.actions[:, :1], rewards=None,
        reset_seeds=None), r"a demonstration with observations of shape \(1, 51, 4\) arrived; expected \(2, 51, 4\)"),
    "more actions": (without_successors, "a demonstration with .* arrived; expected .* as before"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_demonstration_changes_nothing(fault, three, states):
    spoil, sentence = BAD[fault]
    learner = DMSRD(INVERTED_PENDULUM, TINY, 0, 1, states[2])
    with pytest.raises(InputError, match=f"^{sentence}") as caught:
        list(learner.learn(spoil(three.select([2]))))
    assert "\n" not in str(caught.value)
    assert learner.state is states[2]
    list(learner.learn(three.select([2])))
    assert_same(learner.state, states[3])


def test_an_interruption_changes_nothing(three, states, monkeypatch):
    learner = DMSRD(INVERTED_PENDULUM, TINY, 0, 1, states[2])
    for name in ("search_mixture", "AIRL", "MSRD"):
        with monkeypatch.context() as patch:
            forbid(patch, name)
            with pytest.raises(AssertionError, match="must not be made"):
                list(learner.learn(three.select([2])))
        assert learner.state is states[2]
    list(learner.learn(three.select([2])))
    assert_same(learner.state, states[3])


def test_optional_fields_may_be_missing(three, states):
    bare = dataclasses.replace(three.select([2]), rewards=None, strategy_labels=None, reset_seeds=None)
    state = after(states[2], bare)
    assert state.demonstrations.arrays().keys() == {"observations", "actions"}
    assert same_tensors(state.networks, states[3].networks), "nothing is learned from them"


def test_a_state_of_another_domain_is_refused(states, domain):
    with pytest.raises(InputError, match="inverted_pendulum"):
        DMSRD(dataclasses.replace(domain, name="other"), TINY, 0, state=states[1])


def test_checkpoints_cut_short_anywhere(states, tmp_path):
    whole, path = save_state(tmp_path / "a.safetensors", states[2]).read_bytes(), tmp_path / "b.safetensors"
    for length in (0, 1, 7, 8, 9, 100, 1000, 5000, len(whole) // 2, len(whole) - 4, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"cannot be read .* expected a state written by save_state, whole") as caught:
            load_state(path, INVERTED_PENDULUM)
        assert str(caught.value).startswith(f"{path}: ")
    path.write_bytes(whole)
    assert_same(load_state(path, INVERTED_PENDULUM), states[2])


def test_other_files_are_refused_in_one_sentence(states, domain, tmp_path, monkeypatch):
    from safetensors.torch import save_file

    text = tmp_path / "text"
    text.write_text("no checkpoint at all, only a text that is long enough")
    tensors = tmp_path / "tensors.safetensors"
    save_file({"weights": torch.zeros(2)}, tensors)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"weights": torch.zeros(2)}, foreign, metadata={"format": "pt"})
    with monkeypatch.context() as patch:
        patch.setattr(lifelong, "_VERSION", lifelong._VERSION + 1)
        newer = save_state(tmp_path / "newer", states[1])
    other = save_state(tmp_path / "other", dataclasses.replace(states[1], domain=dataclasses.replace(domain, name="other")))
    for path, sentence in (
        (text, "cannot be read"),
        (tmp_path / "nothing", "cannot be read"),
        (tmp_path, "cannot be read"),
        (tensors, "is a None of version None; expected 'dmsrd_lite lifelong state' of version"),
        (foreign, "cannot be read"),
        (newer, f"of version {lifelong._VERSION + 1}; expected 'dmsrd_lite lifelong state' of version {lifelong._VERSION}"),
        (other, "holds a state of other; expected inverted_pendulum"),
    ):
        with pytest.raises(InputError, match=sentence) as caught:
            load_state(path, domain)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)


def test_saving_replaces_the_whole_file_or_nothing(states, tmp_path, monkeypatch):
    path = save_state(tmp_path / "a.safetensors", states[1])
    with pytest.raises(TypeError):
        save_state(path, dataclasses.replace(states[2], records=(object(),)))
    assert_same(load_state(path, INVERTED_PENDULUM), states[1])
    (tmp_path / "FILE").write_text("")
    with pytest.raises(InputError, match="cannot be written to"):
        save_state(tmp_path / "FILE" / "a.safetensors", states[1])
    assert {p.name for p in tmp_path.iterdir()} == {"a.safetensors", "FILE"}


@pytest.mark.parametrize("warm_start", [True, False])
def test_on_the_lander_the_clone_calibrates_the_threshold(lander_set, warm_start, monkeypatch):
    made, first = [], lander_set.select([0])
    watch(monkeypatch, "AIRL", made)
    off = {"warm_start": warm_start, "coverage": warm_start}
    settings = dataclasses.replace(TINY, kl_threshold=0.0, airl=dataclasses.replace(TINY.airl, **off),
                                   msrd=dataclasses.replace(TINY.msrd, **off))  # fmt: skip
    learner = DMSRD(LUNAR_LANDER, settings, 0)
    (record,) = learner.learn(first)
    clone = made[-1]["learner"].clone
    assert len(made) == (1 if warm_start else 2), "the clone that AIRL starts from is the one that calibrates"
    assert record["reference"] == metrics.policy_divergences(clone, first, [0, 102, 0, 7])[0]
    assert record["threshold"] == record["reference"] + settings.kl_margin


def test_a_round_works_on_a_bounded_sample_and_measures_no_more(three, states, monkeypatch):
    """Pure ones, the newest, and so many of the others, drawn anew each time; a sample of all is the same as no bound."""
    four = three.select([2, 2, 2, 2])
    settings, rounds = dataclasses.replace(GENEROUS, remembered=1), []
    learner = DMSRD(INVERTED_PENDULUM, settings, 0, 1, states[2])
    watch(monkeypatch, "MSRD", rounds)
    records = list(learner.learn(four))
    assert [len(r["remembered"]) for r in records] == [3, 4, 4, 4]
    for r, made in zip(records, rounds, strict=True):
        n = r["demonstration"]
        assert {0, 1, n} <= set(r["remembered"]) <= set(range(n + 1))
        assert len(r["kl_before_round"]) == len(r["kl_after_round"]) == len(r["remembered"])
        known, weights, pure = made["between"]
        assert np.array_equal(known.observations, learner.state.demonstrations.select(r["remembered"]).observations)
        assert np.array_equal(weights, learner.state.weights[r["remembered"]])
        assert list(np.array(r["remembered"])[pure]) == list(learner.state.pure)
    assert_same(
        after(states[2], three.select([2]), dataclasses.replace(GENEROUS, remembered=5)), after(states[2], three.select([2]), GENEROUS)
    )


@pytest.mark.parametrize("moving", [True, False])
def test_a_round_after_a_mixture_can_leave_policies_alone(moving, three, states, monkeypatch):
    """Then nobody's KL can change, so that none is measured; rewards learn in any case, and after a new strategy everything does."""
    settings = dataclasses.replace(GENEROUS, policies_after_mixture=moving)
    state = after(states[2], three.select([2]), settings)
    old, new = states[2].networks, state.networks
    kept = {k for k in old if torch.equal(old[k], new[k])}
    assert "mixture" in state.records[2]["branch"]
    for part in ("policies.", "averaged.task_reward.", "averaged.strategy_reward."):
        names = {k for k in old if k.startswith(part)}
        assert names
        if part != "policies." or moving:
            assert not names <= kept, part
        else:
            assert names <= kept, part
    assert len(state.records[2]["kl_after_round"]) == (3 if moving else 0)
    answer_with(monkeypatch, kl_mix=2e9, kl_new=1.0)
    created = after(states[2], three.select([2]), settings)
    assert created.records[2]["branch"] == "new strategy"
    assert len(created.records[2]["kl_after_round"]) == 3
    for k in old:
        if k.startswith(("policies.", "averaged.task_reward.")):
            assert not torch.equal(old[k], created.networks[k][: len(old[k])]), k


def test_the_mixture_nearest_to_each_strategy_is_always_remembered():
    table = np.vstack([np.eye(2), np.random.default_rng(0).dirichlet((2, 2), 20)])
    nearest = {2 + int(table[2:-1, 0].argmax()), 2 + int(table[2:-1, 1].argmax())}
    state = LifelongState(INVERTED_PENDULUM, 0, None, table, (0, 1))
    learner = DMSRD(INVERTED_PENDULUM, dataclasses.replace(TINY, remembered=4), 0, 1, state)
    drawn = [set(learner._remembered(state, seed)) for seed in range(50)]
    assert all(len(some) == 2 + 1 + 4 and {0, 1, 21} | nearest <= some for some in drawn)
    assert len(set.union(*drawn)) == 22, "the other two are drawn among all"


def test_an_audit_measures_everybody(three, states):
    learner = DMSRD(INVERTED_PENDULUM, dataclasses.replace(GENEROUS, remembered=1, audit_every=2), 0, 1, states[2])
    records = list(learner.learn(three.select([2, 2])))
    assert "audit" not in records[0]
    audit = records[1]["audit"]
    assert len(audit["kl"]) == 4
    means = learner.rewards().evaluate(learner.state.demonstrations.observations).mean((2, 3))
    assert audit["recognized"] == lifelong.recognized(means, learner.state.pure).tolist()


STREAM = """
import sys
sys.path.insert(0, {tests!r})
from test_lifelong import GENEROUS, three_users
from dmsrd_lite.lifelong import DMSRD, learn_stream
from dmsrd_lite.envs import INVERTED_PENDULUM
learner = DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1)
for record in learn_stream(learner, three_users(), sys.argv[1]):
    print(record["demonstration"], flush=True)
"""


def three_users():
    shown = shown_by(balancers([-0.4, 0.4, 0.0]), 50)
    return shown.select([0, 1, 2, 1, 0, 2, 1, 2])


def newest(folder):
    states = [load_state(path, INVERTED_PENDULUM) for path in folder.glob("checkpoint_*.safetensors")]
    return max(states, key=lambda s: len(s.records))


def test_killed_at_random_moments_a_stream_ends_with_the_same_bits(tmp_path):
    script, rng = STREAM.format(tests=str(Path(__file__).parent)), np.random.default_rng(0)
    whole = DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1)
    assert len(list(lifelong.learn_stream(whole, three_users(), tmp_path / "whole"))) == 8
    command, folder, done = [sys.executable, "-c", script, str(tmp_path / "killed")], tmp_path / "killed", 0
    for at in sorted(rng.choice(np.arange(1, 7), 3, replace=False)):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        for line in process.stdout:
            if int(line) >= at:
                break
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.communicate()
        assert len(newest(folder).records) >= max(done, at)
        done = len(newest(folder).records)
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert [int(line) for line in ended.stdout.split()] == list(range(8))
    assert_same(newest(folder), whole.state)


def test_a_spoiled_checkpoint_is_refused_in_a_sentence_and_the_one_before_it_is_used(three, tmp_path):
    whole = DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1)
    list(lifelong.learn_stream(whole, three, tmp_path))
    last = tmp_path / "checkpoint_1.safetensors"
    content = last.read_bytes()
    last.write_bytes(content[:-100])
    again = DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1)
    with pytest.warns(UserWarning, match=r"checkpoint_1\.safetensors: cannot be read .*; going on from the checkpoint before it"):
        assert len(list(lifelong.learn_stream(again, three, tmp_path))) == 3
    assert_same(again.state, whole.state)
    assert load_state(last, INVERTED_PENDULUM).records


def test_a_folder_of_another_stream_is_refused(three, tmp_path):
    list(lifelong.learn_stream(DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1), three.select([0]), tmp_path))
    with pytest.raises(InputError, match="another seed, other settings or other code"):
        list(lifelong.learn_stream(DMSRD(INVERTED_PENDULUM, GENEROUS, 1, 1), three, tmp_path))
    with pytest.raises(InputError, match="another seed, other settings or other code"):
        list(lifelong.learn_stream(DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1), three, tmp_path, "another source"))
    with pytest.raises(InputError, match="of other demonstrations"):
        list(lifelong.learn_stream(DMSRD(INVERTED_PENDULUM, GENEROUS, 0, 1), three.select([1]), tmp_path))
