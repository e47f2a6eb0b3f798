import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tiny import GENEROUS, PENDULUM, TINY, assert_same, forbid, three_users

from dmsrd_lite.domains import InputError
from dmsrd_lite.method import dmsrd, rounds, stream
from dmsrd_lite.method.state import State
from dmsrd_lite.method.stream import kept_states, learn_stream, load_state, save_state

STREAM = """
import sys
sys.path.insert(0, {tests!r})
from tiny import PENDULUM, TINY, three_users
from dmsrd_lite.method.state import State
from dmsrd_lite.method.stream import learn_stream
users = three_users().select([int(i) for i in sys.argv[2]])
for state in learn_stream(State(PENDULUM, 0), users, TINY, sys.argv[1]):
    print(len(state.records), flush=True)
"""


def start(folder, users):
    script = STREAM.format(tests=str(Path(__file__).parent.parent))
    return subprocess.Popen([sys.executable, "-c", script, folder, users], stdout=subprocess.PIPE, text=True)


def kill(process, at, seconds):
    """Once ``at`` users are learned, and so many seconds more have gone by."""
    for line in process.stdout:
        if int(line) >= at:
            break
    time.sleep(seconds)
    process.kill()
    process.communicate()


def newest(folder):
    states = [load_state(path, PENDULUM) for path in folder.glob("checkpoint_*.safetensors")]
    return max(states, key=lambda state: len(state.weights))


def bare(state):
    """As a checkpoint holds it."""
    return replace(state, demonstrations=None, records=())


def keep(folder, *states):
    """Checkpoints and journal as a stream leaves them after these states."""
    next(learn_stream(states[-1], states[-1].shown, TINY, folder))  # writes the journal
    for state in states:
        save_state(folder / f"checkpoint_{len(state.records) % 2}.safetensors", bare(state))


def test_round_trip(states, tmp_path):
    told = replace(states[1], demonstrations=replace(states[1].shown, metadata={"seed": 7}), alpha=0.1)
    for state in (*states, told):
        loaded = load_state(save_state(tmp_path / "a.safetensors", state), PENDULUM)
        assert_same(loaded, state)
        assert loaded.records == state.records
    assert loaded.shown.metadata == {"seed": 7}


def test_checkpoints_cut_short_anywhere(states, tmp_path):
    whole, path = save_state(tmp_path / "a.safetensors", states[2]).read_bytes(), tmp_path / "b.safetensors"
    for length in (0, 1, 7, 8, 9, 100, 1000, 5000, len(whole) // 2, len(whole) - 4, len(whole) - 1):
        path.write_bytes(whole[:length])
        sentence = rf"^{path}: cannot be read \(\w+\); expected a state written by save_state, whole$"
        with pytest.raises(InputError, match=sentence):
            load_state(path, PENDULUM)
    path.write_bytes(whole)
    assert_same(load_state(path, PENDULUM), states[2])


def test_other_files_are_refused_in_one_sentence(states, tmp_path, monkeypatch):
    (tmp_path / "text").write_text("no checkpoint at all, only a text that is long enough")
    save_file({"weights": torch.zeros(2)}, tmp_path / "tensors")
    save_file({"weights": torch.zeros(2)}, tmp_path / "foreign", metadata={"format": "pt"})
    with monkeypatch.context() as patch:
        patch.setattr(stream, "_VERSION", 4)
        save_state(tmp_path / "newer", states[1])
    save_state(tmp_path / "other", replace(states[1], domain=replace(PENDULUM, name="other")))
    for name, sentence in {
        "text": "cannot be read",
        "nothing": "cannot be read",
        ".": "cannot be read",
        "tensors": "is a None of version None; expected 'dmsrd_lite state' of version 3",
        "foreign": "cannot be read",
        "newer": "is a 'dmsrd_lite state' of version 4; expected 'dmsrd_lite state' of version 3",
        "other": "holds a state of other; expected inverted_pendulum",
    }.items():
        path = (tmp_path / name).resolve()
        with pytest.raises(InputError, match=f"^{path}: {sentence}[^\n]*$"):
            load_state(path, PENDULUM)


def test_saving_replaces_the_whole_file_or_nothing(states, tmp_path):
    path = save_state(tmp_path / "a.safetensors", states[1])
    with pytest.raises(TypeError):
        save_state(path, replace(states[2], records=(object(),)))
    assert_same(load_state(path, PENDULUM), states[1])
    (tmp_path / "FILE").write_text("")
    with pytest.raises(InputError, match="cannot be written to"):
        save_state(tmp_path / "FILE" / "a.safetensors", states[1])
    assert {p.name for p in tmp_path.iterdir()} == {"a.safetensors", "FILE"}


def test_killed_once_a_stream_ends_with_the_same_bits(three, states, tmp_path, monkeypatch):
    kill(start(tmp_path, "012"), 1, 0.1)
    kept = newest(tmp_path)
    assert len(kept.weights) >= 1
    first, *more = learn_stream(State(PENDULUM, 0), three, TINY, tmp_path)
    assert_same(bare(first), kept)
    assert len(first.records) == len(kept.weights) == 3 - len(more)
    assert_same(more[-1] if more else first, states[3])
    assert_same(newest(tmp_path), bare(states[3]))
    names = ["checkpoint_0.safetensors", "checkpoint_1.safetensors", "records.jsonl", "settings.txt"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    forbid(monkeypatch, (dmsrd, "AIRL"), (rounds, "MSRD"))
    (ended,) = learn_stream(State(PENDULUM, 0), three, TINY, tmp_path)
    assert_same(ended, states[3])


@pytest.mark.verify
def test_killed_at_random_moments_a_stream_ends_with_the_same_bits(tmp_path):
    users, rng, done = "01210212", np.random.default_rng(0), 0
    shown = three_users().select([int(i) for i in users])
    *_, whole = learn_stream(State(PENDULUM, 0), shown, TINY, tmp_path / "whole")
    for at in sorted(rng.choice(np.arange(1, 7), 3, replace=False)):
        kill(start(tmp_path / "killed", users), at, rng.uniform(0, 0.5))
        assert len(newest(tmp_path / "killed").weights) >= max(done, at)
        done = len(newest(tmp_path / "killed").weights)
    lines, _ = start(tmp_path / "killed", users).communicate()
    assert [int(line) for line in lines.split()] == list(range(done, 9))
    assert_same(newest(tmp_path / "killed"), bare(whole))


@pytest.mark.parametrize(
    ("name", "n_bytes", "sentence"),
    [
        ("checkpoint_1.safetensors", 100, "cannot be read .*"),
        ("records.jsonl", 20, "knows 3 demonstrations; expected 3 lines in records.jsonl"),
    ],
)
def test_what_was_cut_short_costs_one_demonstration(name, n_bytes, sentence, three, states, tmp_path):
    keep(tmp_path, states[2], states[3])
    spoiled = tmp_path / name
    spoiled.write_bytes(spoiled.read_bytes()[:-n_bytes])
    whole = rf"1\.safetensors: {sentence}; going on from the checkpoint before it$"
    with pytest.warns(UserWarning, match=whole):
        found = list(learn_stream(State(PENDULUM, 0), three, TINY, tmp_path))
    for state, known in zip(found, states[2:], strict=True):
        assert_same(state, known)
        assert state.records[:2] == states[2].records
    assert_same(load_state(tmp_path / "checkpoint_1.safetensors", PENDULUM), bare(states[3]))
    assert len((tmp_path / "records.jsonl").read_text().splitlines()) == 3


def test_states_that_are_kept_hold_all_that_was_known(three, states, tmp_path):
    list(learn_stream(State(PENDULUM, 0), three, TINY, tmp_path, kept=(1, 3)))
    for state, known in zip(kept_states(tmp_path, three), states[1::2], strict=True):
        assert_same(state, known)


OTHERS = {
    "seed": ({"state": State(PENDULUM, 1)}, "another seed, other settings or other code"),
    "settings": ({"settings": GENEROUS}, "another seed, other settings or other code"),
    "source": ({"source": "another"}, "another seed, other settings or other code"),
    "demonstrations": ({"shown": three_users().select([1, 0])}, "other demonstrations"),
    "fields": ({"shown": replace(three_users(), rewards=None)}, "other demonstrations"),
    "fewer": ({"shown": three_users().select([0])}, "2 demonstrations, more than the 1 given"),
    "fewer others": ({"shown": three_users().select([1])}, "other demonstrations"),
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_folder_of_another_stream_is_refused(other, three, states, tmp_path):
    change, sentence = OTHERS[other]
    given = {"state": State(PENDULUM, 0), "shown": three, "settings": TINY, "folder": tmp_path}
    keep(tmp_path, states[2])
    next(learn_stream(**given))
    with pytest.raises(InputError, match=f"^{tmp_path}: holds checkpoints of {sentence}; expected [^\n]*$"):
        next(learn_stream(**{**given, **change}))


def test_a_state_of_other_demonstrations_cannot_go_on(three, states, tmp_path):
    with pytest.raises(InputError, match=r"^a state that knows other demonstrations; expected [^\n]*$"):
        next(learn_stream(states[1], three.select([1, 0]), TINY, tmp_path))


def test_killed_between_two_files_a_kept_state_is_there_in_the_end(three, states, tmp_path, monkeypatch):
    save = stream.save_state

    def killed(path, state):
        if path.name.startswith("checkpoint_") and len(state.weights) == 2:
            raise KeyboardInterrupt
        return save(path, state)

    with monkeypatch.context() as patch:
        patch.setattr(stream, "save_state", killed)
        with pytest.raises(KeyboardInterrupt):
            list(learn_stream(State(PENDULUM, 0), three, TINY, tmp_path, kept=(2,)))
    list(learn_stream(State(PENDULUM, 0), three, TINY, tmp_path, kept=(2,)))
    (kept,) = kept_states(tmp_path, three)
    assert_same(kept, states[2])
