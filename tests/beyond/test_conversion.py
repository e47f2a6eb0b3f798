"""Three doors, the same arrays behind them; and what is refused, in a sentence."""

from pathlib import Path

import numpy as np
import pytest

from dmsrd_lite.__main__ import main
from dmsrd_lite.beyond.conversion import convert
from dmsrd_lite.demonstrations import load_demonstrations, validate_file
from dmsrd_lite.domains import InputError, get_domain

N, T = 4, 12
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


def minari(folder, arrays, monkeypatch, version=0, ended=False, length=T):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    from gymnasium.spaces import Box
    from minari import create_dataset_from_buffers
    from minari.data_collector import EpisodeBuffer

    episodes = []
    for i in range(N):
        t = length if i == 2 else T
        over = {"terminations": [False] * (t - 1) + [ended], "truncations": [False] * (t - 1) + [not ended]}
        states, actions = arrays["observations"][i, : t + 1], arrays["actions"][i, :t]
        rewards = list(arrays["rewards"][i, :t])
        episodes.append(EpisodeBuffer(observations=states, actions=actions, rewards=rewards, **over))
    spaces = {"observation_space": Box(-np.inf, np.inf, (4,)), "action_space": Box(-3, 3, (1,))}
    create_dataset_from_buffers(f"pole/people-v{version}", episodes, **spaces)
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


def test_notes(arrays, tmp_path):
    single = arrays["observations"].astype(np.float32)
    _, notes = convert(plain(tmp_path, arrays, observations=single, rewards=None))
    for text, note in zip(
        ("single precision", "no rewards", "one trajectory per person"), notes, strict=True
    ):
        assert text in note


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
    with pytest.raises(InputError, match="episode 2: has 9 states, the first has 13; expected equally long"):
        convert(minari(tmp_path / "short", arrays, monkeypatch, length=8))
    two = minari(tmp_path / "early", arrays, monkeypatch, version=1)
    with pytest.raises(
        InputError, match=r"holds 2 datasets \(pole/people-v0, pole/people-v1\); expected the"
    ):
        convert(two)
    assert convert(two / "pole" / "people-v1")[0].n_demonstrations == N


@pytest.mark.parametrize("target", ["mine.safetensors", "plain.npz"])
def test_a_file_of_another_kind_or_the_source_itself_is_not_written(target, arrays, tmp_path, capsys):
    source = plain(tmp_path, arrays)
    before = source.read_bytes()
    assert main(["convert", str(source), str(tmp_path / target)]) == 2
    assert "expected another file, with the ending .npz" in capsys.readouterr().err
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
