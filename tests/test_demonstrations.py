"""The file format: what is read, what is refused (in one sentence), and what the repository ships."""

import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest

from dmsrd_lite import demonstrations
from dmsrd_lite.__main__ import main
from dmsrd_lite.demonstrations import load_demonstrations, load_shipped, load_shipped_test_set, load_test_set
from dmsrd_lite.demonstrators import people
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER, InputError
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import divergence, policy_mixture
from dmsrd_lite.method.airl import AIRL, AIRLSettings
from dmsrd_lite.method.divergence import divergence_floor, divergence_table


def about(**entries):
    return np.array(json.dumps({"domain": "inverted_pendulum", "schema_version": 1, **entries}))


@pytest.fixture
def arrays(small_set):
    return {"metadata": about(), **{name: array.copy() for name, array in small_set.arrays().items()}}


def saved(write, *arguments, **arrays):
    write(buffer := io.BytesIO(), *arguments, **arrays)
    return buffer.getvalue()


def test_round_trip(small_set, tmp_path):
    path = demonstrations.save_demonstrations(tmp_path / "set.npz", small_set)
    loaded = load_demonstrations(path, small_set.domain)
    assert loaded.arrays().keys() == small_set.arrays().keys()
    assert all(np.array_equal(array, getattr(small_set, name)) for name, array in loaded.arrays().items())
    assert loaded.metadata["domain"] == "inverted_pendulum"
    assert demonstrations.validate_file(path) == []
    with pytest.raises(InputError, match="is a demonstration set; expected a test set"):
        load_test_set(path)
    with pytest.raises(InputError, match="domain is inverted_pendulum; expected lunar_lander"):
        load_demonstrations(path, LUNAR_LANDER)


def test_only_two_arrays_and_two_metadata_keys_are_required(arrays, tmp_path):
    np.savez(tmp_path / "set.npz", **{k: arrays[k] for k in ("metadata", "observations", "actions")})
    loaded = load_demonstrations(tmp_path / "set.npz")
    assert loaded.rewards is loaded.reset_seeds is loaded.log_likelihoods is loaded.returns is None


def test_transitions_with_and_without_the_last_state(small_set):
    states, actions, successors = small_set.transitions()
    assert states.shape == (2, 100, 4)
    assert np.array_equal(successors[0, 48], states[0, 49])
    assert np.array_equal(successors[1, 99], small_set.observations[1, 1, 50])
    short = dataclasses.replace(small_set, observations=small_set.observations[:, :, :-1])
    states, actions, successors = short.transitions()
    assert (states.shape, actions.shape) == ((2, 98, 4), (2, 98, 1))
    assert np.array_equal(successors[1, 48], small_set.observations[1, 0, 49])
    assert np.array_equal(actions[1, 49], small_set.actions[1, 1, 0]), (
        "each trajectory loses its own last one"
    )


def test_pooled_selected_and_joined(small_set):
    assert small_set.pooled().actions.shape == (1, 4, 50, 1)
    bare = dataclasses.replace(
        small_set.select([1]), rewards=None, log_likelihoods=None, metadata={"seed": 8}
    )
    both = dataclasses.replace(small_set, metadata={"seed": 7}).joined(bare)
    kept = {"observations", "actions", "strategy_labels", "reset_seeds"}
    assert both.arrays().keys() == kept, "an optional field stays where both have it"
    for name, array in both.arrays().items():
        assert np.array_equal(array, [*getattr(small_set, name), getattr(small_set, name)[1]]), name
    assert (both.n_demonstrations, both.metadata) == (3, {"seed": 7})


def test_rollouts_as_demonstrations(domain, monkeypatch):
    actor = GaussianPolicies(domain, 2, 0, sigma=2.0).actor()
    data = rollout(domain, actor, 2, 0, horizon=20)
    shown = demonstrations.demonstrations_from(data, actor)
    assert np.abs(shown.actions).max() == 3 < np.abs(data.actions).max(), (
        "demonstrations hold executed actions"
    )
    one = actor.select([1]).log_density(shown.observations[1, 0, :-1][None], shown.actions[1, 0][None])
    assert shown.log_likelihoods[1, 0] == pytest.approx(one.sum(), rel=1e-5)
    monkeypatch.setattr(demonstrations, "AT_ONCE", 40)  # one episode at a time
    few = demonstrations.demonstrations_from(data, actor)
    assert few.log_likelihoods == pytest.approx(shown.log_likelihoods, rel=1e-5)


def change(name, value):
    return lambda arrays: arrays.__setitem__(name, value(arrays[name]))


def put(name, index, value):
    return lambda arrays: arrays[name].__setitem__(index, value)


def drop(name):
    return lambda arrays: arrays.pop(name)


def metadata(text):
    return lambda arrays: arrays.update(metadata=np.array(text) if isinstance(text, str) else about(**text))


def shorten(arrays):
    arrays.update({name: arrays[name][:, :, :5] for name in ("observations", "actions", "rewards")})


RAGGED = np.array([[1], [1, 2]], dtype=object)
FAULTS = [
    (change("observations", lambda a: a[..., :3]), "observations: has shape .*; expected .* 4"),
    (change("actions", lambda a: a[0]), "actions: has shape .*; expected"),
    (change("observations", lambda a: a[:, :, :-3]), "observations: has shape .*; expected .*50 or 51"),
    (put("observations", (0, 1, 7, 2), np.nan), r"observations: holds NaN .*, first at index \(0, 1, 7, 2\)"),
    (put("rewards", (1, 1, 3), np.inf), "rewards: holds NaN or infinity"),
    (put("actions", (0, 0, 2, 0), 3.5), r"actions: 3.5 at index .* expected executed actions in \[-3, 3\]"),
    (change("actions", lambda a: a[:0]), "actions: has shape .* at least one demonstration"),
    (change("actions", lambda a: a.astype(str)), "actions: has type .*; expected numbers"),
    (change("strategy_labels", lambda a: np.arange(5)), r"labels: has shape \(5,\); expected \(2\)"),
    (change("strategy_labels", lambda a: a + 0.5), "strategy_labels: has type float64 .*; expected whole"),
    (change("reset_seeds", lambda a: a + 0.5), "reset_seeds: has type float64 .*; expected whole"),
    (change("reset_seeds", lambda a: a - 2**31), "reset_seeds: has type int64 .*; expected whole"),
    (shorten, "have 5 steps; expected 10 to 1000"),
    (drop("actions"), "actions: is missing; expected an array"),
    (drop("metadata"), "metadata: is missing; expected a JSON text"),
    (metadata("{"), "metadata: is no JSON object"),
    (metadata({"domain": "x"}), "domain 'x' is unknown; expected one of"),
    (metadata({"domain": ["x"]}), r"domain \['x'\] is unknown; expected one of"),
    (metadata({"schema_version": 9}), "schema_version is 9; expected 1"),
    (lambda arrays: arrays.clear(), "metadata: is missing"),
    (change("actions", lambda a: RAGGED), "actions: holds pickled objects .* equally long"),
]


def zip_of_text(arrays):
    file = io.BytesIO(saved(np.savez, metadata=arrays["metadata"]))
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("observations.npy", b"no array")
    return file.getvalue()


CONTENTS = [
    lambda arrays: saved(np.savez, **arrays)[:5000],
    lambda arrays: saved(np.save, arrays["actions"]),
    zip_of_text,
    lambda arrays: b"",
    lambda arrays: b"no zip at all",
    lambda arrays: b"\x80\x04N.",  # a pickle
]


@pytest.mark.parametrize(("spoil", "sentence"), [*FAULTS, *((c, r"bad\.npz: .*expected") for c in CONTENTS)])
def test_a_fault_is_one_sentence_and_exit_code_2(spoil, sentence, arrays, tmp_path, capsys):
    path = tmp_path / "bad.npz"
    content = spoil(arrays)
    path.write_bytes(content if isinstance(content, bytes) else saved(np.savez, **arrays))
    with pytest.raises(InputError, match=sentence) as caught:
        load_demonstrations(path)
    assert str(path) in str(caught.value)
    assert main(["validate", str(path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (drop("observations"), "observations: is missing"),
        (change("observations", lambda a: a[..., :3]), "observations: has shape .*; expected .* 4"),
        (change("policy", lambda a: a[:-1]), r"policy: has shape \(5,\); expected \(6\)"),
        (put("returns", 2, np.nan), r"returns: holds NaN or infinity, first at index \(2,\)"),
        (change("returns", lambda a: a[0]), r"returns: has shape \(\)"),
        (change("returns", lambda a: a[:0]), "returns: has shape .* at least"),
        (metadata({}), "stride is missing"),
    ],
)
def test_a_faulty_test_set_is_one_sentence(spoil, sentence, tmp_path):
    numbers = {name: np.zeros(6) for name in ("returns", "policy", "snapshot")}
    arrays = {"observations": np.zeros((6, 5, 4)), **numbers, "metadata": about(stride=10)}
    np.savez(tmp_path / "set.npz", **arrays)
    assert load_test_set(tmp_path / "set.npz").observations.shape == (6, 5, 4)
    spoil(arrays)
    np.savez(tmp_path / "set.npz", **arrays)
    with pytest.raises(InputError, match=sentence):
        load_test_set(tmp_path / "set.npz")


def test_all_faults_are_listed(arrays, tmp_path, capsys):
    put("rewards", (0, 0, 0), np.nan)(arrays)
    np.savez(tmp_path / "bad.npz", **{**arrays, "log_likelihoods": arrays["log_likelihoods"][:1]})
    assert main(["validate", str(tmp_path / "bad.npz")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 2
    with pytest.raises(InputError, match=r"\(and 1 more\)$"):
        load_demonstrations(tmp_path / "bad.npz")


def test_save_is_atomic_and_refuses_faults(small_set, tmp_path):
    def fill_the_disk(file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    path = demonstrations.save_demonstrations(tmp_path / "set.npz", small_set)
    before = path.read_bytes()
    with pytest.raises(InputError, match="outside the bounds"):
        demonstrations.save_demonstrations(
            path, dataclasses.replace(small_set, actions=small_set.actions * 100)
        )
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); expected room"):
        demonstrations.write_atomically(path, fill_the_disk)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["set.npz"]
    with pytest.raises(InputError, match=r"cannot be written to .* expected a writable folder"):
        demonstrations.save_demonstrations(path / "set.npz", small_set)


def test_plain_values_are_what_json_holds():
    mixed = {1: np.float32(0.5), "a": (np.int64(3), np.nan, np.array([1.0, np.inf])), "b": None}
    assert demonstrations.plain(mixed) == {"1": 0.5, "a": [3, None, [1.0, None]], "b": None}


def test_a_lander_file_made_elsewhere(tmp_path):
    """Only T states for each trajectory, actions in [-1, 1], nothing else: 1500 = 3 x 500 states."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(2, 3, 500, 8)) / 5, rng.uniform(-1, 1, (2, 3, 500, 2))
    np.savez(tmp_path / "x.npz", observations=states, actions=actions, metadata=about(domain="lunar_lander"))
    shown = load_demonstrations(tmp_path / "x.npz", LUNAR_LANDER.on_threads(1))
    assert [part.shape[1] for part in shown.transitions()] == [3 * 499] * 3
    sizes = {"n_iterations": 1, "episodes": 1, "coverage_episodes": 1, "discriminator_steps": 1}
    *_, record = AIRL(shown, AIRLSettings(cloning_steps=5, **sizes), 0).train()
    assert np.isfinite(record["discriminator_loss"]).all()


@pytest.mark.parametrize("domain", [INVERTED_PENDULUM, LUNAR_LANDER], ids=lambda d: d.name)
def test_shipped_sets(domain):
    shown, again = load_shipped(domain), load_shipped(domain, "second_take")
    assert shown.actions.shape == again.actions.shape == (10, 3, domain.horizon, domain.action_dim)
    assert np.array_equal(shown.reset_seeds, again.reset_seeds)
    assert np.array_equal(shown.observations[:, :, 0], again.observations[:, :, 0])
    assert not np.array_equal(shown.actions, again.actions)
    for take in (shown, again):
        assert take.returns.min() >= domain.success_return
        assert not domain.failed(take.observations[:, :, 1:], take.rewards).any()
    test, development = (load_shipped_test_set(domain, kind) for kind in ("test_set", "development_set"))
    assert test.observations.shape == (10000, domain.horizon // 10, domain.obs_dim)
    assert development.observations.shape == (1000, domain.horizon // 10, domain.obs_dim)
    assert len({s.metadata["seed"] for s in (shown, test, development)}) == 3, "trainings share nothing"
    assert np.isin(development.returns, test.returns).mean() < 0.05, "stray coincidences of rounded returns"
    assert len(np.unique(test.snapshot)) == 100
    for some in (test, development):  # from the time of failure and of success
        failing, good = (some.failed[:, -1] == 1).mean(), (some.returns >= domain.success_return).mean()
        between = ((some.returns >= domain.poor_return) & (some.returns < domain.success_return)).mean()
        between = between if np.isfinite(domain.poor_return) else 1 - failing - good
        assert (0.2 < failing < 0.8, 0.2 < good < 0.65, between > 0.1) == (True, True, True)
    worst, best = {"inverted_pendulum": (-1400, -20), "lunar_lander": (-500, 250)}[domain.name]
    assert test.returns.min() < worst < best < test.returns.max()


@pytest.mark.parametrize("domain", [INVERTED_PENDULUM, LUNAR_LANDER], ids=lambda d: d.name)
def test_shipped_people_differ_in_kind_and_are_told_apart(domain):
    shown, again = load_shipped(domain), load_shipped(domain, "second_take")
    choice, people = shown.metadata["choice"], [domain.diversity.describe(one) for one in shown.observations]
    kinds = [person["kind"] for person in people]
    assert choice["kind"] == kinds, "computed from what they show"
    assert len(set(kinds[:5])) >= 3, "the base users of the stream"
    floor = divergence_floor(shown, again)
    assert choice["own_divergence"] == pytest.approx(floor, abs=2e-3)
    assert min(choice["nearest_other"]) >= domain.comparison.others_at_least
    if domain is INVERTED_PENDULUM:
        above = divergence_table(domain, shown.observations) - floor[:, None]
        np.fill_diagonal(above, np.inf)
        assert choice["nearest_other"] == pytest.approx(above.min(1), abs=2e-3)
        assert kinds.count("rocker") >= 3
        assert kinds.count("swinger") >= 1
        assert kinds.count("holder") <= 5


@pytest.mark.parametrize("domain", [INVERTED_PENDULUM, LUNAR_LANDER], ids=lambda d: d.name)
def test_shipped_demonstrators_are_those_who_showed(domain):
    """Their policies give the likelihood in the file, and fresh takes from the same starts are as near."""
    shown, domain = load_shipped(domain), domain.on_threads(1)
    actor = people.load_shipped_demonstrators(domain, 10)
    again = people.fresh_takes(actor.select([0, 1]), domain, 3, 5, shown.reset_seeds[:2])
    assert np.allclose(again.observations[:, :, 0], shown.observations[:2, :, 0])
    n, k, t = shown.actions.shape[:3]
    states, actions = shown.observations[:, :, :t].reshape(n, k * t, -1), shown.actions.reshape(n, k * t, -1)
    own = actor.log_density(states, actions).reshape(n, k, t).sum(-1)
    assert own == pytest.approx(shown.log_likelihoods, rel=1e-3, abs=1.0)
    stream = load_shipped(domain, "lifelong")
    users = people.stream_actor(stream)
    pick = [0, 7, 99]
    flown = policy_mixture.Mixtures(users.actor, users.weights[pick])
    kl = divergence.policy_divergences(flown, stream.select(pick), 0, n_rollouts=6)
    assert np.abs(kl - np.array(stream.metadata["floor"])[pick]).mean() < 3.0


def test_returns_of_the_shipped_test_sets():
    test = load_shipped_test_set(INVERTED_PENDULUM)
    sampled = -np.abs(test.observations[:, :, 1]).mean(1) * INVERTED_PENDULUM.horizon
    assert np.corrcoef(sampled, test.returns)[0, 1] > 0.99, "every tenth state must tell the return"
    every_step = load_shipped_test_set(LUNAR_LANDER).returns_every_step
    assert (every_step < -10_000).mean() > 0.1, "wrecks pay on every step"
