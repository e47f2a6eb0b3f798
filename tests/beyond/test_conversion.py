"""Three doors, the same arrays behind them; and what is refused, in a sentence."""

import re
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from dmsrd_lite.__main__ import main
from dmsrd_lite.beyond.conversion import convert
from dmsrd_lite.demonstrations import load_demonstrations, load_shipped, validate_file
from dmsrd_lite.domains import InputError, get_domain

N, T = 4, 12
PUSH = spaces.Box(-3, 3, (1,))
SAVED = Path(__file__).parent / "trajectories"  # by `datasets`, in the form in which `imitation` saves


@pytest.fixture
def arrays():
    """As those that the saved trajectories were made of."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(N, T + 1, 4)), rng.uniform(-3, 3, (N, T, 1))
    return {"observations": states, "actions": actions, "rewards": rng.normal(size=(N, T))}


def spoiled():
    states = np.zeros((N, T + 1, 4))
    states[2, 3, 1] = np.nan
    return states


def plain(folder, arrays, **changes):
    np.savez(folder / "plain.npz", **{k: v for k, v in {**arrays, **changes}.items() if v is not None})
    return folder / "plain.npz"


def minari(folder, arrays, monkeypatch, version=0, ended=False, length=T, form=None, **other):
    """``form`` (field, function): how a field is stored; ``other``: its space."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    from minari import create_dataset_from_buffers
    from minari.data_collector import EpisodeBuffer

    episodes = []
    for i in range(N):
        t = length if i == 2 else T
        over = {"terminations": [False] * (t - 1) + [ended], "truncations": [False] * (t - 1) + [not ended]}
        parts = {"observations": arrays["observations"][i, : t + 1], "actions": arrays["actions"][i, :t]}
        if form:
            parts[form[0]] = form[1](parts[form[0]])
        episodes.append(EpisodeBuffer(**parts, rewards=list(arrays["rewards"][i, :t]), **over))
    kinds = {"observation_space": spaces.Box(-np.inf, np.inf, (4,)), "action_space": PUSH, **other}
    create_dataset_from_buffers(f"pole/people-v{version}", episodes, **kinds)
    return folder


@pytest.mark.filterwarnings("ignore::UserWarning")  # a test's dataset names no author
@pytest.mark.parametrize("door", ["plain", "minari", "saved"])
def test_every_door_gives_the_same_file(door, arrays, tmp_path, monkeypatch, capsys):
    doors = {"plain": lambda: plain(tmp_path, arrays), "saved": lambda: SAVED}
    source = doors[door]() if door in doors else minari(tmp_path / "sets", arrays, monkeypatch)
    assert main(["convert", str(source), str(tmp_path / "mine.npz"), "--each", "2"]) == 0
    assert "2 demonstrations of 2 trajectories, 12 steps, inverted_pendulum" in capsys.readouterr().out
    found = load_demonstrations(tmp_path / "mine.npz", get_domain("inverted_pendulum"))
    for name, array in arrays.items():
        assert getattr(found, name) == pytest.approx(array.reshape(2, 2, *array.shape[1:]), abs=1e-12)
    assert validate_file(tmp_path / "mine.npz") == []


def test_only_the_first_steps(arrays, tmp_path):
    found, _ = convert(plain(tmp_path, arrays), steps=10)
    assert found.observations.shape == (N, 1, 11, 4)
    assert found.rewards[:, 0] == pytest.approx(arrays["rewards"][:, :10])


def test_a_file_with_four_axes_says_who_is_who(arrays, tmp_path):
    people = {k: v.reshape(2, 2, *v.shape[1:]) for k, v in arrays.items()}
    found, _ = convert(plain(tmp_path, people, reset_seeds=np.array([[5, 6], [7, 8]])))
    assert found.actions.shape == (2, 2, T, 1)
    assert found.reset_seeds.tolist() == [[5, 6], [7, 8]]
    with pytest.raises(InputError, match="2 episodes for each person; expected --each 2, or none"):
        convert(tmp_path / "plain.npz", each=4)


def test_notes(tmp_path):
    """Of the shipped people nothing but a note on rewards; of what was done to them a note each."""
    shown = load_shipped(get_domain("inverted_pendulum")).select([0, 1])
    whole = {name: array[:, :, :51] for name, array in shown.arrays().items() if array.ndim > 2}
    whole |= {"actions": whole["actions"][:, :, :50], "rewards": whole["rewards"][:, :, :50]}
    whole["reset_seeds"] = shown.reset_seeds
    pays = "rewards are kept as they are; the task here pays -|theta|"
    assert_notes(convert(plain(tmp_path, whole)), pays)
    states, seeds = whole["observations"], shown.reset_seeds
    away = "its actions, replayed from its reset_seeds, lead to states"
    degrees, late = states * [1, 57.3, 1, 57.3], states[:, :, [1, *range(1, 51)]]
    for changes, texts in (
        ({"reset_seeds": seeds + 1}, [away]),
        ({"observations": late}, [away]),
        ({"observations": degrees, "reset_seeds": None}, ["lie outside (-2.0", "episodes fail (falls)"]),
        ({"observations": np.add(states, [5, 0, 0, 0]), "reset_seeds": None}, ["100.0% of the states lie"]),
        ({"observations": states.astype(np.float32)}, ["observations are of single precision"]),
    ):
        found = convert(plain(tmp_path, whole, **changes))
        assert_notes(found, *texts, pays)
    first = {name: array[:, 0] for name, array in whole.items()} | {"rewards": None}
    assert_notes(convert(plain(tmp_path, first)), "there are no rewards", "one trajectory per person")


def assert_notes(converted, *texts):
    for text, note in zip(texts, converted[1], strict=True):
        assert text in note


def test_without_reset_seeds_a_note_where_starts_are_matched(tmp_path):
    lander = {"observations": np.zeros((N, T + 1, 8)), "actions": np.zeros((N, T, 2))}
    text = "there are no reset_seeds: rollouts start elsewhere; a KL on lunar_lander"
    assert_notes(convert(plain(tmp_path, lander), each=2), text, "no rewards")


@pytest.mark.parametrize(
    ("changes", "options", "sentence"),
    [
        ({"actions": None}, {}, "episode 0: has no actions; expected"),
        ({"observations": None}, {}, "observations: is missing (the file holds actions, rewards); expected"),
        ({"observations": np.zeros((N, T + 1, 5))}, {}, "5 observations and 1 actions a step"),
        ({"observations": np.zeros((N, T + 3, 4))}, {}, "shape (15, 4); expected (12 or 13, 4)"),
        ({"actions": np.zeros((3, T, 1))}, {}, "has shape (3, 12, 1); expected (4, steps, dimension)"),
        ({"actions": np.array([None, [1]], dtype=object)}, {}, "unequal length"),
        ({}, {"each": 3}, "holds 4 episodes; expected a multiple of 3"),
        ({}, {"steps": 13}, "has 12 steps and 13 states; expected at least 13 and 14, or a smaller --steps"),
        ({}, {"domain": get_domain("lunar_lander")}, "expected (12 or 13, 8) of lunar_lander"),
        ({"observations": spoiled()}, {}, "episode 2: observations: holds NaN or infinity, first at step 3"),
        ({"observations": np.full((N, T + 1, 4), "x")}, {}, "observations: has type <U1; expected numbers"),
        ({"terminations": np.eye(N, T)}, {}, "episode 0: ended early, after 12 steps; expected"),
        ({"terminations": np.zeros(3)}, {}, "terminations: has shape (3,); expected (4,) or (4, 12)"),
        ({"terminations": np.zeros((3, T))}, {}, "terminations: has shape (3, 12); expected (4,) or (4, 12)"),
        ({"terminations": np.zeros((N, 9))}, {}, "terminations: has shape (4, 9); expected (4,) or (4, 12)"),
        ({"dones": np.zeros((N, T))}, {}, "dones: is not read; expected terminations, or nothing"),
        ({"rewards": np.full((N, T), "x")}, {}, "episode 0: rewards: has type <U1; expected numbers"),
        ({"rewards": np.zeros((N, 11))}, {"steps": 10}, "0: has rewards of shape (11,); expected (12,)"),
        ({"rewards": np.full((N, T), np.nan)}, {}, "0: rewards: holds NaN or infinity, first at step 0; exp"),
        ({"observations": np.zeros((N, 1, 4)), "actions": np.zeros((N, 0, 1)), "rewards": None}, {},
         "episode 0: has no actions; expected the executed action of every step"),
        ({"observations": np.zeros((N, 1200, 4)), "actions": np.zeros((N, 1200, 1)), "rewards": None}, {},
         "has 1200 steps; expected at most 1000, or --steps 1000 to cut them"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_said_in_a_sentence(changes, options, sentence, arrays, tmp_path):
    with pytest.raises(InputError, match=f"(?s)^{tmp_path}.*") as error:
        convert(plain(tmp_path, arrays, **changes), **options)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.filterwarnings("ignore::UserWarning")  # a test's dataset names no author
def test_what_a_dataset_may_be_refused_for(arrays, tmp_path, monkeypatch):
    early = minari(tmp_path / "early", arrays, monkeypatch, ended=True)
    with pytest.raises(InputError, match="episode 0: ended early, after 12 steps; expected"):
        convert(early)
    assert convert(early, steps=11)[0].horizon == 11
    with pytest.raises(
        InputError, match="2: has 9 states and 8 actions, the first has 13 and 12; expected equally"
    ):
        convert(minari(tmp_path / "short", arrays, monkeypatch, length=8))
    two = minari(tmp_path / "early", arrays, monkeypatch, version=1)
    with pytest.raises(
        InputError, match=r"holds 2 datasets \(pole/people-v0, pole/people-v1\); expected the"
    ):
        convert(two)
    assert convert(two / "pole" / "people-v1")[0].n_demonstrations == N


@pytest.mark.filterwarnings("ignore::UserWarning")  # a test's dataset names no author
@pytest.mark.parametrize("domain", [None, get_domain("inverted_pendulum")])
@pytest.mark.parametrize(
    ("field", "form", "space", "sentence"),
    [
        ("actions", lambda a: {"push": a}, spaces.Dict(push=PUSH), "actions come as a dict; expected one"),
        ("actions", lambda a: (a,), spaces.Tuple([PUSH]), "actions come as a tuple; expected one vector"),
        ("observations", lambda s: ["up"] * len(s), spaces.Text(2), "observations come as a list; expected"),
        ("observations", lambda s: {"pole": s}, spaces.Dict(pole=spaces.Box(-9, 9, (4,))), "come as a dict;"),
        ("observations", lambda s: [0] * len(s), spaces.Discrete(2), "has observations of shape (13,)"),
        ("actions", lambda a: [0] * len(a), spaces.Discrete(2), "has actions of shape (12,)"),
    ],
)  # fmt: skip
def test_a_dataset_of_other_things_than_vectors(
    field, form, space, sentence, domain, arrays, tmp_path, monkeypatch
):
    stored = {"form": (field, form), f"{field[:-1]}_space": space}
    with pytest.raises(InputError) as error:
        convert(minari(tmp_path, arrays, monkeypatch, **stored), domain)
    assert sentence in str(error.value)


@pytest.mark.parametrize("n_acts", [(T, T + 1), (T + 1, T)])
def test_as_many_states_as_the_first_but_not_as_many_actions(n_acts, arrays, tmp_path):
    import pyarrow

    states = arrays["observations"][:2]
    acts = [np.zeros((n, 1)).tolist() for n in n_acts]
    table = pyarrow.table({"obs": states.tolist(), "acts": acts})
    with pyarrow.ipc.new_stream(tmp_path / "data.arrow", table.schema) as stream:
        stream.write_table(table)
    (tmp_path / "state.json").write_text('{"_data_files": [{"filename": "data.arrow"}]}')
    sentence = f"episode 1: has 13 states and {n_acts[1]} actions, the first has 13 and {n_acts[0]}; expected"
    with pytest.raises(InputError, match=sentence):
        convert(tmp_path)
    assert convert(tmp_path, steps=12)[0].horizon == 12


@pytest.mark.parametrize("target", ["mine.safetensors", "plain.npz"])
def test_a_file_of_another_kind_or_the_source_itself_is_not_written(target, arrays, tmp_path, capsys):
    source = plain(tmp_path, arrays)
    before = source.read_bytes()
    assert main(["convert", str(source), str(tmp_path / target)]) == 2
    assert re.search(
        "expected (a name with the ending .npz|another file to be written)", capsys.readouterr().err
    )
    assert source.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["plain.npz"]


def test_folders_that_hold_nothing_or_are_cut(tmp_path):
    with pytest.raises(InputError, match="holds no demonstrations that we can read; expected"):
        convert(tmp_path)
    with pytest.raises(InputError, match="nowhere: there is no such file or folder; expected an"):
        convert(tmp_path / "nowhere")
    for file in SAVED.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes()[:900])
    with pytest.raises(InputError, match=r"cannot be read \(\w+\); expected trajectories with obs and acts"):
        convert(tmp_path)


def test_actions_out_of_bounds_write_nothing(arrays, tmp_path, capsys):
    source, target = plain(tmp_path, arrays, actions=5 + arrays["actions"]), tmp_path / "mine.npz"
    assert main(["convert", str(source), str(target)]) == 2
    assert "expected executed actions in [-3, 3]" in capsys.readouterr().err
    assert not target.exists()
