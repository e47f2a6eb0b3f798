"""Demonstrations as files, generated small: a pendulum on which everybody is good enough."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.demonstrations import load_demonstrations
from dmsrd_lite.demonstrators import people, streams
from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER, InputError
from dmsrd_lite.domains.domain import StateComparison
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.policy_optimization import TrainingSettings

SHORT = TrainingSettings(n_strategies=2, n_iterations=2, episodes=1, first_horizon=20)
TINY = DiaynSettings(discriminator_steps=2, training=SHORT)
ANYBODY = StateComparison(own_at_most=1e9, others_at_least=-1e9)
EASY = replace(
    INVERTED_PENDULUM, horizon=60, success_return=-1e9, failed=lambda s, r: r > 0, comparison=ANYBODY
)


@pytest.mark.verify
def test_files_of_people_who_were_chosen_and_of_a_stream_of_them(tmp_path, monkeypatch):
    made = streams.generate_demonstrations(EASY, TINY, 0, tmp_path, n_kept=3)
    paths = [tmp_path / f"inverted_pendulum_{take}.npz" for take in ("demonstrations", "second_take")]
    shown, again = (load_demonstrations(path, EASY) for path in paths)
    assert shown.metadata["choice"] == json.loads(json.dumps(made))
    assert shown.metadata["settings"] == json.loads(json.dumps(asdict(TINY)))
    assert made["trained"] == 2 * len(EASY.diversity.populations)
    kinds = [EASY.diversity.describe(one)["kind"] for one in shown.observations]
    assert made["kind"] == kinds, "computed from what is shown, not typed"
    assert shown.actions.shape == (3, 3, 60, 1)
    assert np.array_equal(shown.observations[:, :, 0], again.observations[:, :, 0])
    assert not np.array_equal(shown.actions, again.actions)
    actor, _ = people.load_demonstrators(tmp_path / "inverted_pendulum_demonstrators.safetensors", EASY, 3)
    flown = people.fresh_takes(actor, EASY, 3, 0, shown.reset_seeds)
    assert np.array_equal(flown.observations[:, :, 0], shown.observations[:, :, 0]), "from the same starts"
    assert flown.log_likelihoods.mean() == pytest.approx(shown.log_likelihoods.mean(), abs=10)

    streams.generate_stream(EASY, TINY, 0, tmp_path, n_base=2, n_mixtures=5)
    stream = load_demonstrations(tmp_path / "inverted_pendulum_lifelong.npz", EASY)
    weights = np.array(stream.metadata["weights"])
    assert stream.actions.shape == (7, 3, 60, 1)
    assert np.allclose(stream.actions[:2], shown.actions[:2], atol=1e-6), (
        "the base users are the first people"
    )
    assert weights[:2].tolist() == [[1, 0], [0, 1]]
    assert weights.sum(1) == pytest.approx(np.ones(7), abs=1e-3)
    assert (stream.metadata["kind"], len(stream.metadata["floor"])) == (kinds[:2], 7)
    returns = -np.abs(stream.observations[:, :, 1:, 1]).sum(-1).mean(1)
    assert stream.metadata["returns"] == pytest.approx(returns, abs=1e-3)
    assert stream.strategy_labels is None, "who is who stands in the metadata alone"

    def never(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(streams, "train_demonstrators", never)
    assert streams.generate_demonstrations(EASY, TINY, 0, tmp_path, n_kept=3) == made, (
        "goes on from what is there"
    )
    with pytest.raises(AssertionError, match="trained again"):
        streams.generate_demonstrations(EASY, TINY, 1, tmp_path, n_kept=3)


def test_too_few_who_can_is_a_sentence_and_writes_nothing(tmp_path):
    strict = replace(EASY, success_return=1, comparison=StateComparison())
    with pytest.raises(InputError, match=r"only 0 of 20 demonstrators .* succeed .*; expected 2"):
        streams.generate_demonstrations(strict, TINY, 0, tmp_path, n_kept=2)
    assert not list(tmp_path.glob("*.npz"))


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "cannot be read"),
        (lambda path: path.unlink(), "cannot be read"),
        (
            lambda path: people.save_demonstrators(path, GaussianPolicies(LUNAR_LANDER, 9, 0).actor()),
            "of lunar_lander",
        ),
        (lambda path: None, "holds 2 demonstrators; expected at least 9"),
    ],
    ids=["cut", "missing", "another domain", "too few"],
)
def test_demonstrators_that_cannot_be_used_are_a_sentence(spoil, sentence, tmp_path):
    path = people.save_demonstrators(tmp_path / "some.safetensors", GaussianPolicies(EASY, 2, 0).actor())
    spoil(path)
    with pytest.raises(InputError, match=sentence) as caught:
        people.load_demonstrators(path, EASY, 9)
    assert str(path) in str(caught.value)
    assert "expected" in str(caught.value)


def test_mixtures_act_by_their_weights_and_bad_ones_are_redrawn():
    """From places 0.4 m left and right; whoever returns less than half of them do is redrawn."""
    domain, actor = replace(EASY, horizon=200), balancers([-0.4, 0.4], sigma=0.02)
    actor.domain = domain
    weights, takes, n_redrawn = streams.draw_mixtures(domain, actor, TINY, 0, 4, -1e9)
    assert (len(weights), n_redrawn) == (4, 0)
    last = takes[0].observations[:, :, -1, 0].mean(1)
    assert last == pytest.approx(weights @ [-0.4, 0.4], abs=0.15)
    bound = float(np.median(takes[0].returns.mean(1)))
    again, takes, n_redrawn = streams.draw_mixtures(domain, actor, TINY, 0, 4, bound)
    assert (len(again), n_redrawn > 0) == (4, True)
    assert takes[0].returns.mean(1).min() >= bound
    with pytest.raises(
        InputError, match=r"mixtures of inverted_pendulum failed one after the other; expected"
    ):
        streams.draw_mixtures(domain, actor, TINY, 0, 1, 1.0)
