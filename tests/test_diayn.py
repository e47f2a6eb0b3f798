import dataclasses
import json

import numpy as np
import pytest
from test_mixture import balancers

from dmsrd_lite import diayn
from dmsrd_lite.demonstrations import demonstrations_from, load_demonstrations, load_test_set
from dmsrd_lite.diayn import (
    DiaynSettings,
    StrategyDiscriminator,
    distances,
    draw_mixtures,
    farthest_from_mixtures,
    generate_demonstrations,
    generate_lifelong,
    generate_test_set,
    good_flights,
    most_distinct,
    visible_distance,
)
from dmsrd_lite.envs import DOMAINS, INVERTED_PENDULUM, LUNAR_LANDER, InputError
from dmsrd_lite.metrics import policy_divergences
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.policy_optimization import TrainingSettings
from dmsrd_lite.rollouts import rollout

TINY = DiaynSettings(discriminator_steps=2, training=TrainingSettings(n_strategies=2, n_iterations=2, episodes=1, first_horizon=20))


def test_discriminator_learns_separate_places():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(3, 500, 2)) * 0.1 + np.array([[-5.0, 0], [0, 5.0], [5.0, 0]])[:, None]
    q = StrategyDiscriminator(2, 3, DiaynSettings(discriminator_rate=1e-2), 0)
    for i in range(10):
        log_q, accuracy = q.update(features, i)
    assert accuracy > 0.95
    assert log_q.shape == (3, 500)
    assert np.exp(log_q).mean() > 0.9


def test_discriminator_cannot_tell_what_is_alike():
    features = np.random.default_rng(0).normal(size=(2, 2000, 2))
    q = StrategyDiscriminator(2, 2, DiaynSettings(), 0)
    log_q, _ = q.update(features, 0)
    assert np.exp(log_q).mean() == pytest.approx(0.5, abs=0.05)


def test_most_distinct_drops_the_crowded_one():
    place = np.array([0.0, 10.0, 10.5, 13.0, 30.0])
    assert most_distinct(np.abs(place[:, None] - place[None]), 4) == [0, 1, 3, 4]
    assert most_distinct(np.abs(place[:, None] - place[None]), 3) == [0, 3, 4], "10 is nearer to the rest than 13"


def test_what_looks_different_is_place_and_movement(domain):
    states = np.zeros((3, 1, 101, 4))
    states[1, ..., 0] = 0.2  # holds elsewhere
    states[2, ..., 0] = 0.1 * np.sin(np.arange(101))  # moves to and fro
    distance = visible_distance(domain, states)
    assert distance[0, 1] == pytest.approx(0.2 / 0.1)
    assert distance[0, 2] > 5, "a movement 0.2 m wide, in units of 0.02 m"
    assert np.allclose(distance, distance.T)


def test_generation_writes_valid_files_and_records_the_choice(domain, tmp_path, monkeypatch):
    easy = dataclasses.replace(
        domain, success_return=-1e9, failed=lambda s, r: np.zeros(r.shape, bool), horizon=60, kl_threshold=1e9, kl_margin=-1e9
    )
    monkeypatch.setitem(DOMAINS, domain.name, easy)
    choice = generate_demonstrations(easy, 0, tmp_path, settings=TINY, n_kept=2)
    shown, again = (load_demonstrations(tmp_path / f"inverted_pendulum_{take}.npz") for take in ("demonstrations", "second_take"))
    assert shown.metadata["choice"] == json.loads(json.dumps(choice))
    assert len(choice["kept"]) == 2
    assert shown.actions.shape == (2, 3, 60, 1)
    assert np.abs(shown.actions).max() <= 3
    assert np.array_equal(shown.observations[:, :, 0], again.observations[:, :, 0])
    assert not np.array_equal(shown.actions, again.actions)
    path = generate_test_set(easy, 1, tmp_path / "test.npz", settings=TINY, n_snapshots=2, n_episodes=2)
    test = load_test_set(path)
    assert test.observations.shape == (2 * 2 * 2, 6, 4)
    assert test.policy.tolist() == [0, 0, 1, 1] * 2
    assert test.snapshot.tolist() == [0] * 4 + [1] * 4


def test_too_few_successes_write_nothing(domain, tmp_path):
    with pytest.raises(InputError, match=r"only 0 of 4 demonstrators .* succeeded, .*; expected 2"):
        generate_demonstrations(domain, 0, tmp_path / "new", settings=TINY, n_kept=2)
    assert list(tmp_path.glob("**/*.npz")) == []


def test_only_good_flights_are_shown():
    """Three of twelve starts, the first at which both takes return enough; the rest by hand."""
    easy = dataclasses.replace(LUNAR_LANDER, failed=lambda s, r: np.zeros(r.shape, bool))
    actor = GaussianPolicies(easy, 3, 0).actor()
    settings = dataclasses.replace(TINY, attempts=4)
    starts = np.random.default_rng([5, 7]).integers(0, 2**31 - 1, (3, 12))
    takes = [rollout(easy, actor, 12, [5, 8, take], reset_seeds=starts).returns for take in (0, 1)]
    bound = float(np.quantile(takes[0], 0.3))
    found, shown = good_flights(dataclasses.replace(easy, success_return=bound), actor, settings, 3, 5)
    for j in range(3):
        good = [e for e in range(12) if takes[0][j, e] >= bound and takes[1][j, e] >= bound]
        assert 3 <= len(good) < 12, "some starts must be good and some not, or this test says nothing"
        assert found[j].mean() == len(good) / 12
        assert shown[0].reset_seeds[j].tolist() == shown[1].reset_seeds[j].tolist() == starts[j, good[:3]].tolist()
        assert shown[0].returns[j] == pytest.approx(takes[0][j, good[:3]])
        assert shown[1].returns[j] == pytest.approx(takes[1][j, good[:3]])


def test_distances_with_matched_starts_are_above_ones_own(lander_set):
    actor = GaussianPolicies(LUNAR_LANDER, 2, 0).actor()
    table, own = distances(LUNAR_LANDER, lander_set, actor, [0])
    for i in (0, 1):
        by_hand = policy_divergences(actor, lander_set.select([i]), [0, i], n_rollouts=2)
        assert own[i] == by_hand[i]
        assert table[i].tolist() == (by_hand - by_hand[i]).tolist()


def test_a_stream_holds_base_users_and_mixtures_of_them(domain, tmp_path, monkeypatch):
    easy = dataclasses.replace(domain, success_return=-1e9, failed=lambda s, r: np.zeros(r.shape, bool), horizon=60, kl_threshold=1e9)
    monkeypatch.setitem(DOMAINS, domain.name, easy)
    monkeypatch.setattr(diayn, "farthest_from_mixtures", lambda actor, shown, n, seed: ([2, 0], np.full(2, 2.0), np.zeros(4)))
    choice = generate_lifelong(easy, 0, tmp_path, settings=TINY, n_base=2, n_mixtures=5)
    shown = load_demonstrations(tmp_path / "inverted_pendulum_lifelong.npz")
    assert shown.actions.shape == (7, 3, 60, 1)
    weights = np.array(shown.metadata["weights"])
    assert weights[:2].tolist() == [[1, 0], [0, 1]]
    assert weights.sum(1) == pytest.approx(np.ones(7), abs=1e-3)
    assert len(shown.metadata["floor"]) == len(shown.metadata["returns"]) == 7
    assert shown.metadata["returns"] == pytest.approx(-np.abs(shown.observations[:, :, 1:, 1]).sum(-1).mean(1), abs=1e-3)
    assert shown.metadata["choice"] == json.loads(json.dumps(choice))
    assert choice["kept"] == [2, 0]
    assert shown.strategy_labels is None, "who is who stands in the metadata alone"


def test_mixtures_act_by_their_weights_and_bad_ones_are_redrawn(domain):
    """From places 0.4 m left and right; whoever stays left of the middle is redrawn, by a return that says so."""
    actor = balancers([-0.4, 0.4], sigma=0.02)
    easy = dataclasses.replace(domain, success_return=-1e9, horizon=200)
    actor.domain = easy
    weights, takes, n_redrawn = draw_mixtures(easy, actor, TINY, 0, 4, -1e9)
    assert (len(weights), n_redrawn) == (4, 0)
    last = takes[0].observations[:, :, -1, 0].mean(1)
    assert last == pytest.approx(weights @ [-0.4, 0.4], abs=0.15)
    bound = float(np.median(takes[0].returns.mean(1)))
    again, takes, n_redrawn = draw_mixtures(easy, actor, TINY, 0, 4, bound)
    assert n_redrawn >= 1
    assert len(again) == 4
    assert takes[0].returns.mean(1).min() >= bound


def test_farthest_from_mixtures_finds_the_corners():
    """Five who balance in five places: everybody between the outermost two is a mixture of them."""
    actor = balancers([-0.2, 0.6, 0.0, -0.6, 0.3], sigma=0.05)
    data = rollout(INVERTED_PENDULUM, actor, 3, 1)
    kept, far, own = farthest_from_mixtures(actor, demonstrations_from(data, actor), 2, [0])
    assert sorted(kept) == [1, 3]
    assert far.min() > 5
    assert len(own) == 5
