from dataclasses import replace

import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.demonstrations import demonstrations_from
from dmsrd_lite.demonstrators import choice
from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.divergence import divergence_table, policy_divergences


def test_most_distinct_drops_the_crowded_one():
    place = np.array([0.0, 10.0, 10.5, 13.0, 30.0])
    distance = np.abs(place[:, None] - place[None])
    assert choice.most_distinct(distance, 4) == [0, 1, 3, 4]
    assert choice.most_distinct(distance, 3) == [0, 3, 4], "10 is nearer than 13 to the rest"


def test_what_looks_different_is_place_and_movement(domain):
    states = np.zeros((3, 1, 101, 4))
    states[1, ..., 0] = 0.2  # holds elsewhere
    states[2, ..., 0] = 0.1 * np.sin(np.arange(101))  # moves to and fro
    distance = choice.visible_distance(domain, states)
    assert distance[0, 1] == distance[1, 0] == pytest.approx(0.2 / 0.1)
    assert distance[0, 2] > 5, "a movement 0.2 m wide, in units of 0.02 m"


def test_only_good_flights_are_shown():
    """Three of twelve starts, the first at which both takes return enough and do not fail."""
    short = replace(LUNAR_LANDER.on_threads(1), horizon=100, failed=lambda s, r: s[..., 0] > 0.4)
    actor = GaussianPolicies(short, 3, 0).actor()
    starts = np.random.default_rng([5, 7]).integers(0, 2**31 - 1, (3, 12))
    takes = [rollout(short, actor, 12, [5, 8, take], reset_seeds=starts) for take in (0, 1)]
    bound = float(np.quantile(takes[0].returns, 0.2))
    strict = replace(short, success_return=bound)
    found, shown = choice.good_flights(strict, actor, DiaynSettings(attempts=4), 3, 5)
    fine = np.all([take.returns >= bound for take in takes], axis=0)
    fails = np.any([(take.observations[:, :, 1:, 0] > 0.4).any(2) for take in takes], axis=0)
    assert (fine & fails).any(), "some must fail although they return enough, or this test says nothing"
    for j in range(3):
        good = np.flatnonzero(fine[j] & ~fails[j])
        assert 3 <= len(good) < 12, "some starts must be good and some not, or this test says nothing"
        assert np.array_equal(np.flatnonzero(found[j]), good)
        for take in (0, 1):
            assert np.array_equal(shown[take].reset_seeds[j], starts[j, good[:3]])
            assert shown[take].returns[j] == pytest.approx(takes[take].returns[j, good[:3]])


def test_distances_with_matched_starts_are_above_ones_own(small_set, lander_set):
    alone, actor = (
        replace(lander_set, domain=LUNAR_LANDER.on_threads(1)),
        GaussianPolicies(LUNAR_LANDER, 2, 0).actor(),
    )
    table, own = choice.distances(alone, actor, [0])
    for i in (0, 1):
        by_hand = policy_divergences(actor, alone.select([i]), [0, i], n_rollouts=2)
        assert own[i] == by_hand[i]
        assert table[i].tolist() == (by_hand - by_hand[i]).tolist()
    table, own = choice.distances(small_set, None, [0])
    assert np.array_equal(table, divergence_table(small_set.domain, small_set.observations))
    assert np.array_equal(own, np.diag(table))


@pytest.mark.verify
def test_farthest_from_mixtures_finds_the_corners():
    """Five who balance in five places: everybody between the outermost two is a mixture of them."""
    actor = balancers([-0.2, 0.6, 0.0, -0.6, 0.3], sigma=0.05)
    data = rollout(INVERTED_PENDULUM, actor, 3, 1)
    kept, far, own = choice.farthest_from_mixtures(actor, demonstrations_from(data, actor), 2, [0])
    assert sorted(kept) == [1, 3]
    assert far.min() > 5
    assert len(own) == 5
