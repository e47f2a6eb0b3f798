"""Demonstrations as files, generated small: a pendulum on which everybody is good enough."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.demonstrations import load_demonstrations
from dmsrd_lite.demonstrators import choice, streams
from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.domains import INVERTED_PENDULUM, InputError
from dmsrd_lite.domains.domain import StateComparison
from dmsrd_lite.learning.policy_optimization import TrainingSettings

SHORT = TrainingSettings(n_strategies=2, n_iterations=2, episodes=1, first_horizon=20)
TINY = DiaynSettings(discriminator_steps=2, training=SHORT)
ANYBODY = StateComparison(own_at_most=1e9, others_at_least=-1e9)
EASY = replace(
    INVERTED_PENDULUM, horizon=60, success_return=-1e9, failed=lambda s, r: r > 0, comparison=ANYBODY
)


def test_valid_files_that_record_the_choice(tmp_path):
    made = streams.generate_demonstrations(EASY, TINY, 0, tmp_path, n_kept=2)
    paths = [tmp_path / f"inverted_pendulum_{take}.npz" for take in ("demonstrations", "second_take")]
    shown, again = (load_demonstrations(path, EASY) for path in paths)
    assert shown.metadata["choice"] == json.loads(json.dumps(made))
    assert shown.metadata["settings"] == json.loads(json.dumps(asdict(TINY)))
    assert (made["trained"], len(made["kept"])) == (4, 2)
    assert shown.actions.shape == (2, 3, 60, 1)
    assert np.array_equal(shown.observations[:, :, 0], again.observations[:, :, 0])
    assert not np.array_equal(shown.actions, again.actions)
    strict = replace(EASY, success_return=1, comparison=StateComparison())
    with pytest.raises(InputError, match=r"only 0 of 4 demonstrators .* succeeded, .*; expected 2"):
        streams.generate_demonstrations(strict, TINY, 0, tmp_path / "new", n_kept=2)
    assert not list(tmp_path.glob("new/*.npz")), "too few write nothing"


def test_a_stream_holds_base_users_and_mixtures_of_them(tmp_path, monkeypatch):
    chosen = ([2, 0], np.full(2, 2.0), np.zeros(4))
    monkeypatch.setattr(choice, "farthest_from_mixtures", lambda actor, shown, n, seed: chosen)
    made = streams.generate_lifelong(EASY, TINY, 0, tmp_path, n_base=2, n_mixtures=5)
    shown = load_demonstrations(tmp_path / "inverted_pendulum_lifelong.npz", EASY)
    weights = np.array(shown.metadata["weights"])
    assert shown.actions.shape == (7, 3, 60, 1)
    assert weights[:2].tolist() == [[1, 0], [0, 1]]
    assert weights.sum(1) == pytest.approx(np.ones(7), abs=1e-3)
    assert len(shown.metadata["floor"]) == 7
    returns = -np.abs(shown.observations[:, :, 1:, 1]).sum(-1).mean(1)
    assert shown.metadata["returns"] == pytest.approx(returns, abs=1e-3)
    assert shown.metadata["choice"] == json.loads(json.dumps(made))
    assert shown.strategy_labels is None, "who is who stands in the metadata alone"


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
