import dataclasses
import io
import json
import os
import stat
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from dmsrd_lite.__main__ import main
from dmsrd_lite.airl import AIRL, AIRLSettings
from dmsrd_lite.demonstrations import load_demonstrations, load_shipped, load_test_set, save_demonstrations, validate_file
from dmsrd_lite.divergence import demonstration_divergence, divergence_table
from dmsrd_lite.envs import LUNAR_LANDER, InputError
from dmsrd_lite.metrics import divergence_floor


def arrays_of(demonstrations):
    names = ("observations", "actions", "rewards", "strategy_labels", "reset_seeds", "log_likelihoods")
    metadata = np.array(json.dumps({"domain": "inverted_pendulum", "schema_version": 1}))
    return {"metadata": metadata, **{n: getattr(demonstrations, n).copy() for n in names}}


def test_round_trip(small_set, tmp_path):
    path = save_demonstrations(tmp_path / "set.npz", small_set)
    loaded = load_demonstrations(path)
    assert np.array_equal(loaded.observations, small_set.observations)
    assert np.array_equal(loaded.actions, small_set.actions)
    assert np.array_equal(loaded.reset_seeds, small_set.reset_seeds)
    assert loaded.metadata["domain"] == "inverted_pendulum"
    assert validate_file(path) == []


def test_only_two_arrays_and_two_metadata_keys_are_required(small_set, tmp_path):
    arrays = {k: v for k, v in arrays_of(small_set).items() if k in ("metadata", "observations", "actions")}
    np.savez(tmp_path / "set.npz", **arrays)
    loaded = load_demonstrations(tmp_path / "set.npz")
    assert loaded.rewards is loaded.reset_seeds is loaded.log_likelihoods is loaded.returns is None


def test_transitions_with_and_without_the_last_state(small_set):
    states, actions, successors = small_set.transitions()
    assert states.shape == (2, 100, 4)
    assert np.array_equal(successors[0, 48], states[0, 49])
    assert np.array_equal(successors[1, 99], small_set.observations[1, 1, 50])
    short = dataclasses.replace(small_set, observations=small_set.observations[:, :, :-1])
    states, actions, successors = short.transitions()
    assert states.shape == (2, 98, 4)
    assert actions.shape == (2, 98, 1)
    assert np.array_equal(successors[1, 48], small_set.observations[1, 0, 49])
    assert np.array_equal(actions[1, 49], small_set.actions[1, 1, 0]), "each trajectory loses its own last transition"


def test_pooled_and_selected(small_set):
    assert small_set.pooled().actions.shape == (1, 4, 50, 1)
    assert np.array_equal(small_set.select([1]).actions[0], small_set.actions[1])


def test_joined_and_arrays(small_set):
    bare = dataclasses.replace(small_set.select([1]), rewards=None, log_likelihoods=None, metadata={"seed": 8})
    assert bare.arrays().keys() == {"observations", "actions", "strategy_labels", "reset_seeds"}
    assert bare.arrays()["actions"] is bare.actions
    told = dataclasses.replace(small_set, metadata={"seed": 7})
    both = told.joined(bare)
    assert both.arrays().keys() == bare.arrays().keys(), "an optional field stays where both have it"
    for name, array in both.arrays().items():
        by_hand = [*getattr(small_set, name), getattr(small_set, name)[1]]
        assert np.array_equal(array, by_hand), name
    assert both.n_demonstrations == 3
    assert both.metadata == {"seed": 7}
    assert small_set.joined(small_set).arrays().keys() == small_set.arrays().keys()
    assert small_set.n_demonstrations == 2


def change(name, value):
    return lambda arrays: arrays.__setitem__(name, value(arrays[name]))


def put(index, value):
    def putter(array):
        array[index] = value
        return array

    return putter


FAULTS = {
    "wrong observation dimension": (change("observations", lambda a: a[..., :3]), "observations: has shape .*; expected .* 4"),
    "wrong number of axes": (change("actions", lambda a: a[0]), "actions: has shape .*; expected"),
    "unequal lengths": (change("observations", lambda a: a[:, :, :-3]), "observations: has shape .*; expected .*50 or 51"),
    "nan": (change("observations", put((0, 1, 7, 2), np.nan)), r"observations: holds NaN or infinity, first at index \(0, 1, 7, 2\)"),
    "infinite reward": (change("rewards", put((1, 1, 3), np.inf)), "rewards: holds NaN or infinity"),
    "action outside the bounds": (
        change("actions", put((0, 0, 2, 0), 3.5)), r"actions: 3.5 at index .* expected executed actions in \[-3, 3\]"),
    "empty set": (change("actions", lambda a: a[:0]), "actions: has shape .* at least one demonstration"),
    "text instead of numbers": (change("actions", lambda a: a.astype(str)), "actions: has type .*; expected numbers"),
    "labels of another length": (change("strategy_labels", lambda a: np.arange(5)), r"strategy_labels: has shape \(5,\); expected \(2\)"),
    "fractional reset seeds": (change("reset_seeds", lambda a: a + 0.5), "reset_seeds: has type float64 .*; expected whole"),
    "too short": (
        lambda a: [a.update({n: a[n][:, :, :5]}) for n in ("observations", "actions", "rewards")], "have 5 steps; expected 10 to 1000"),
    "no actions": (lambda a: a.pop("actions"), "actions: is missing; expected an array"),
    "no metadata": (lambda a: a.pop("metadata"), "metadata: is missing; expected a JSON text"),
    "metadata no JSON": (change("metadata", lambda a: np.array("{")), "metadata: is no JSON object"),
    "unknown domain": (
        change("metadata", lambda a: np.array('{"domain": "x", "schema_version": 1}')), "domain 'x' is unknown; expected one of"),
    "other version": (
        change("metadata", lambda a: np.array('{"domain": "inverted_pendulum", "schema_version": 9}')), "schema_version is 9; expected 1"),
    "domain is no text": (
        change("metadata", lambda a: np.array('{"domain": ["x"], "schema_version": 1}')), r"domain \['x'\] is unknown; expected one of"),
    "negative reset seeds": (change("reset_seeds", lambda a: a - 2**31), "reset_seeds: has type int64 .*; expected whole"),
    "fractional labels": (change("strategy_labels", lambda a: a + 0.5), "strategy_labels: has type float64 .*; expected whole"),
    "nothing at all": (lambda a: a.clear(), "metadata: is missing"),
    "pickled": (change("actions", lambda a: np.array([[1], [1, 2]], dtype=object)), "actions: holds pickled objects .* equally long"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_one_sentence_and_exit_code_2(fault, small_set, tmp_path, capsys):
    arrays = arrays_of(small_set)
    spoil, sentence = FAULTS[fault]
    spoil(arrays)
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=sentence) as caught:
        load_demonstrations(path)
    assert str(path) in str(caught.value)
    assert main(["validate", str(path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"{path}: ")


def truncated(arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()[: len(buffer.getvalue()) // 2]


def one_array(arrays):
    buffer = io.BytesIO()
    np.save(buffer, arrays["actions"])
    return buffer.getvalue()


def zip_of_text(arrays):
    buffer = io.BytesIO()
    np.savez(buffer, metadata=arrays["metadata"])
    with zipfile.ZipFile(buffer, "a") as file:
        file.writestr("observations.npy", b"no array")
    return buffer.getvalue()


@pytest.mark.parametrize("content", [truncated, one_array, zip_of_text, lambda a: b"", lambda a: b"no zip at all", lambda a: b"\x80\x04N."])
def test_unreadable_files(content, small_set, tmp_path, capsys):
    path = tmp_path / "bad.npz"
    path.write_bytes(content(arrays_of(small_set)))
    with pytest.raises(InputError, match=r"bad\.npz: .*expected"):
        load_demonstrations(path)
    assert main(["validate", str(path)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


TEST_SET_FAULTS = {
    "no observations": (lambda a: a.pop("observations"), "observations: is missing"),
    "other shape": (change("observations", lambda a: a[..., :3]), "observations: has shape .*; expected .* 4"),
    "other length": (change("policy", lambda a: a[:-1]), r"policy: has shape \(5,\); expected \(6\)"),
    "nan": (change("returns", put(2, np.nan)), r"returns: holds NaN or infinity, first at index \(2,\)"),
    "one number": (change("returns", lambda a: a[0]), r"returns: has shape \(\)"),
    "empty": (lambda a: [a.update({n: a[n][:0]}) for n in a if n != "metadata"], "returns: has shape .* at least one"),
    "no stride": (change("metadata", lambda a: np.array('{"domain": "inverted_pendulum", "schema_version": 1}')), "stride is missing"),
}  # fmt: skip


@pytest.mark.parametrize("fault", TEST_SET_FAULTS)
def test_faulty_test_sets(fault, tmp_path):
    metadata = np.array(json.dumps({"domain": "inverted_pendulum", "schema_version": 1, "stride": 10}))
    arrays = {
        "observations": np.zeros((6, 5, 4)),
        "returns": np.zeros(6),
        "policy": np.zeros(6),
        "snapshot": np.zeros(6),
        "metadata": metadata,
    }
    np.savez(tmp_path / "good.npz", **arrays)
    assert load_test_set(tmp_path / "good.npz").observations.shape == (6, 5, 4)
    spoil, sentence = TEST_SET_FAULTS[fault]
    spoil(arrays)
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=sentence):
        load_test_set(tmp_path / "bad.npz")


def test_missing_file_and_wrong_kind(small_set, tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        load_demonstrations(tmp_path / "none.npz")
    path = save_demonstrations(tmp_path / "set.npz", small_set)
    with pytest.raises(InputError, match="is a demonstration set; expected a test set"):
        load_test_set(path)


def test_all_faults_are_listed(small_set, tmp_path, capsys):
    arrays = arrays_of(small_set)
    arrays["rewards"][0, 0, 0] = np.nan
    arrays["log_likelihoods"] = arrays["log_likelihoods"][:1]
    np.savez(tmp_path / "bad.npz", **arrays)
    assert main(["validate", str(tmp_path / "bad.npz")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 2


def test_save_is_atomic_and_refuses_faults(small_set, tmp_path):
    path = save_demonstrations(tmp_path / "set.npz", small_set)
    before = path.read_bytes()
    bad = dataclasses.replace(small_set, actions=small_set.actions * 100)
    with pytest.raises(InputError, match="outside the bounds"):
        save_demonstrations(path, bad)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["set.npz"]


def test_unwritable_folder(small_set, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written to .* expected a writable folder"):
        save_demonstrations(tmp_path / "file" / "set.npz", small_set)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder(small_set, tmp_path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(InputError, match="cannot be written to"):
        save_demonstrations(tmp_path / "set.npz", small_set)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["generate", "cartpole"], "unknown domain 'cartpole'"),
        (["generate", "inverted_pendulum", "--seed", "1.5"], "seed '1.5': expected a whole number"),
        (["generate", "inverted_pendulum", "--output", "FILE/x"], "cannot be written to"),
        (["run", "none.toml"], "cannot be read as a plan"),
        (["bench", "--seed", "x"], "seed 'x': expected a whole number"),
        (["bench", "--iterations", "1"], "iterations 1: expected at least 2"),
    ],
)
def test_command_line_refuses_in_one_sentence(arguments, sentence, tmp_path):
    (tmp_path / "FILE").write_text("")
    done = subprocess.run([sys.executable, "-m", "dmsrd_lite", *arguments], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["FILE"]


def test_shipped_sets(domain):
    shown, again = load_shipped(domain), load_shipped(domain, "second_take")
    assert shown.actions.shape == again.actions.shape == (10, 3, 1000, 1)
    assert np.array_equal(shown.reset_seeds, again.reset_seeds)
    assert np.array_equal(shown.observations[:, :, 0], again.observations[:, :, 0])
    assert not np.array_equal(shown.actions, again.actions)
    for take in (shown, again):
        assert take.returns.min() >= domain.success_return
        assert not domain.failed(take.observations[:, :, 1:], take.rewards).any()
    table = divergence_table(domain, shown.observations)
    assert table[~np.eye(10, dtype=bool)].min() >= domain.kl_margin
    assert np.diag(table).max() <= domain.kl_threshold
    assert shown.metadata["choice"]["smallest_divergence"] == pytest.approx(table[~np.eye(10, dtype=bool)].min(), abs=1e-3)
    test, development = load_shipped(domain, "test_set"), load_shipped(domain, "development_set")
    assert test.observations.shape == (10000, 100, 4)
    assert development.observations.shape == (1000, 100, 4)
    assert test.metadata["seed"] != development.metadata["seed"] != shown.metadata["seed"]
    assert len(np.unique(test.snapshot)) == 100
    assert np.isin(development.returns, test.returns).mean() < 0.05, "a stray coincidence of rounded returns, not the same trajectories"
    assert test.returns.min() < -1400
    assert test.returns.max() > -20
    sampled = -np.abs(test.observations[:, :, 1]).mean(1) * domain.horizon
    assert np.corrcoef(sampled, test.returns)[0, 1] > 0.99, "every tenth state must tell the whole trajectory's return"


def test_a_lander_file_made_elsewhere(tmp_path):
    """Only T states for each trajectory, actions in [-1, 1], nothing else: 1500 = 3 x 500 states."""
    rng = np.random.default_rng(0)
    metadata = json.dumps({"domain": "lunar_lander", "schema_version": 1})
    states, actions = rng.normal(size=(2, 3, 500, 8)) / 5, rng.uniform(-1, 1, (2, 3, 500, 2))
    np.savez(tmp_path / "theirs.npz", observations=states, actions=actions, metadata=np.array(metadata))
    shown = load_demonstrations(tmp_path / "theirs.npz", LUNAR_LANDER)
    assert shown.horizon == 500
    assert [part.shape[1] for part in shown.transitions()] == [3 * 499] * 3
    settings = AIRLSettings(n_iterations=1, episodes=1, cloning_steps=5, coverage_episodes=1, discriminator_steps=1)
    *_, record = AIRL(shown, settings, 0).train()
    assert np.isfinite(record["discriminator_loss"]).all()


def test_shipped_lander_sets():
    shown, again = (load_shipped(LUNAR_LANDER, kind) for kind in ("demonstrations", "second_take"))
    assert shown.actions.shape == again.actions.shape == (10, 3, 500, 2)
    assert np.array_equal(shown.reset_seeds, again.reset_seeds)
    assert np.array_equal(shown.observations[:, :, 0], again.observations[:, :, 0])
    for take in (shown, again):
        assert take.returns.min() >= LUNAR_LANDER.success_return
        assert not LUNAR_LANDER.failed(take.observations[:, :, 1:], take.rewards).any()
    assert shown.metadata["choice"]["smallest_divergence"] >= LUNAR_LANDER.kl_margin
    floor = divergence_floor(shown, again)
    others = [[demonstration_divergence(LUNAR_LANDER, a, b) for b in shown.observations] for a in shown.observations]
    np.fill_diagonal(others := np.array(others), np.inf)
    assert (others.min(1) > floor + 1).all(), "from other starts everybody is far away"
    test, development = load_shipped(LUNAR_LANDER, "test_set"), load_shipped(LUNAR_LANDER, "development_set")
    assert test.observations.shape == (10000, 50, 8)
    assert development.observations.shape == (1000, 50, 8)
    assert len({s.metadata["seed"] for s in (shown, test, development)}) == 3
    assert test.returns.min() < -500
    assert test.returns.max() > 250
    assert (test.returns_every_step < -10_000).mean() > 0.1, "wrecks pay on every step"
