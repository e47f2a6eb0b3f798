from dataclasses import replace

import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.demonstrators import choice
from dmsrd_lite.demonstrators.diayn import DiaynSettings
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER
from dmsrd_lite.domains.domain import StateComparison
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.divergence import divergence_floor, divergence_table, policy_divergences


def test_kinds_are_drawn_in_turn_and_nobody_is_too_near():
    place = np.array([0.0, 4.0, 20.0, 30.0, 33.0])
    distance, kinds = np.abs(place[:, None] - place[None]), ["a", "a", "a", "b", "b"]
    for seed in range(20):
        kept = choice.draw_in_turn(kinds, distance, 3.5, 5, np.random.default_rng(seed))
        assert {kinds[i] for i in kept[:2]} == {"a", "b"}, "another kind comes second"
        assert len(kept) == 4, "3 and 4 are too near each other"
        assert (3 in kept) != (4 in kept)


def test_the_most_even_in_kinds_and_the_farthest_apart_is_chosen():
    place = np.array([0.0, 4.0, 17.0, 30.0, 34.0])
    distance, kinds = np.abs(place[:, None] - place[None]), ["a", "a", "a", "b", "b"]

    def nobody_is_a_mixture(kept):
        return np.full(len(kept), np.inf)

    kept = choice.choose_different(kinds, distance, 3.0, 3, nobody_is_a_mixture, 0)
    assert sorted(kinds[i] for i in kept) in (["a", "a", "b"], ["a", "b", "b"])
    assert sorted(kept) == [0, 2, 4], "17 apart, in the closest pair"
    assert len(choice.choose_different(kinds, distance, 5.0, 5, nobody_is_a_mixture, 0)) == 3


def test_who_is_a_mixture_of_the_others_is_avoided():
    place = np.array([0.0, 20.0, 10.0])
    distance = np.abs(place[:, None] - place[None])

    def outside(kept):  # who lies right between two others
        return np.array([0.0 if 2 in kept and i == 2 else 9.0 for i in kept])

    assert sorted(choice.choose_different(["a"] * 3, distance, 5.0, 2, outside, 0)) == [0, 1]


def test_only_good_flights_are_shown():
    """Three of twelve starts, the first at which both takes return enough and do not fail."""
    short = replace(LUNAR_LANDER.on_threads(1), horizon=100, failed=lambda s, r: s[..., 0] > 0.4)
    actor = GaussianPolicies(short, 3, 0).actor()
    starts = np.random.default_rng([5, 7]).integers(0, 2**31 - 1, (3, 12))
    takes = [rollout(short, actor, 12, [5, 8, take], reset_seeds=starts) for take in (0, 1)]
    bound = float(np.quantile(takes[0].returns, 0.2))
    strict = replace(short, success_return=bound)
    found, shown = choice.good_flights(strict, actor, DiaynSettings(attempts=4), 5)
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


def test_distances_are_above_ones_own_second_take(small_set, lander_set):
    again = replace(small_set, observations=small_set.observations[:, ::-1] + 0.01)
    table, floor = choice.distances([small_set, again], None, [0])
    assert floor.tolist() == divergence_floor(small_set, again).tolist()
    full = divergence_table(small_set.domain, small_set.observations)
    assert np.allclose(table, full - floor[:, None])
    alone = replace(lander_set, domain=LUNAR_LANDER.on_threads(1))
    actor = GaussianPolicies(LUNAR_LANDER, 2, 0).actor()
    table, floor = choice.distances([alone, alone], actor, [0])
    for i in (0, 1):
        by_hand = policy_divergences(actor, alone.select([i]), [0, i], n_rollouts=2)
        assert table[i].tolist() == (by_hand - floor[i]).tolist()


@pytest.mark.verify
def test_who_balances_between_two_others_is_their_mixture():
    """Three who hold in a row, and one apart in kind: the middle one is a mixture of the outer two."""
    actor = balancers([-0.6, 0.6, 0.0], sigma=0.05)
    easy = replace(INVERTED_PENDULUM, comparison=StateComparison(others_at_least=1.0))
    actor.domain = easy
    _, takes, found = choice.choose_demonstrators(easy, actor, DiaynSettings(), 0, 3)
    above = dict(zip(found["kept"], found["above_mixtures_of_others"], strict=True))
    assert found["kind"] == ["holder"] * 3
    assert above[2] < choice.OUTSIDE < 5 < min(above[0], above[1])
    assert takes[0].strategy_labels.tolist() == [0, 1, 2]
