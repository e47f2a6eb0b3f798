import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.evaluation import searches
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.method.policy_mixture import MixtureFit, Mixtures, weight_deviations

THREE = balancers([-0.4, 0.0, 0.3])


def test_newcomers_mix_two_or_three_and_say_their_weights():
    shown, weights, floor = searches.newcomers(THREE, 6, 0)
    assert shown.n_demonstrations == len(floor) == 6
    assert np.allclose(weights.sum(1), 1)
    assert set((weights > 0).sum(1)) == {2, 3}
    again, same_weights, _ = searches.newcomers(THREE, 6, 0)
    assert np.array_equal(weights, same_weights)
    assert np.array_equal(shown.observations, again.observations)
    places = shown.observations[:, :, 500:, 0].mean((1, 2))
    assert places == pytest.approx(weights @ [-0.4, 0.0, 0.3], abs=0.03), "who mixes places is between them"


def test_a_row_for_each_newcomer_search_and_budget():
    """A search with made-up numbers: after one candidate it has the first, after three the third."""
    tried = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.2, 0.3, 0.5]])

    def find(actor, shown, seed):
        assert shown.n_demonstrations == 1
        return MixtureFit(tried[2], 0.0, tried, np.array([2.0, 3.0, 1.0]), 4000, 3000)

    rows = list(searches.compare({"made up": find}, THREE, THREE, 2, (1, 3), 0))
    assert [row["search"] for row in rows] == ["made up", "made up", "likeliest actions"] * 2
    assert [row["steps"] for row in rows[:3]] == [1000, 3000, 0]
    shown, weights, floor = searches.newcomers(THREE, 2, 0)
    for i in range(2):
        first, third, likeliest = rows[3 * i : 3 * i + 3]
        assert first["error"] == pytest.approx(np.abs(tried[0] - weights[i]).max())
        assert third["error"] == pytest.approx(np.abs(tried[2] - weights[i]).max())
        parents = np.flatnonzero(weights[i])
        own = shown.select([i])
        bound = weight_deviations(THREE.select(parents), own, weights[i, parents]).max()
        assert first["deviation"] == third["deviation"] == likeliest["deviation"] == pytest.approx(bound)
        near = policy_divergences(Mixtures(THREE, weights[[i]]), shown.select([i]), 7)[0] - floor[i]
        assert likeliest["above_floor"] < near + 1
