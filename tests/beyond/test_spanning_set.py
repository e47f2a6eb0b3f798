import numpy as np
import pytest
from helpers import balancers, shown_by

from dmsrd_lite.beyond import spanning_set as spanning
from dmsrd_lite.domains import InputError
from dmsrd_lite.method.policy_mixture import MixtureFit, Mixtures, MixtureSettings, likeliest_weights

PLACES = np.array([-0.4, 0.0, 0.4, 0.1])
FOUR = balancers(PLACES)  # the second and the fourth are mixtures of the first and the third
WEIGHTS = np.eye(4)
EXPLAINED = MixtureSettings(from_actions=True)


@pytest.fixture(scope="module")
def shown():
    return shown_by(FOUR)


@pytest.fixture
def by_actions(monkeypatch):
    """In place of rollouts: how far the place of the likeliest mixture is from the demonstrator's own."""

    def search(actor, one, settings, seed, enough):
        weights = likeliest_weights(actor, one)
        mixed, own = Mixtures(actor, weights), one.actions[0].reshape(1, -1, 1)
        states = one.observations[0, :, : one.horizon].reshape(1, own.shape[1], -1)
        return MixtureFit(weights, float(np.abs((mixed.mean(states) - own).mean())), weights, weights, 7)

    monkeypatch.setattr(spanning, "search_mixture", search)


@pytest.mark.usefixtures("by_actions")
def test_what_lies_between_others_can_go(shown):
    found = spanning.spanning_set(FOUR, shown, WEIGHTS, np.full(4, 0.05), EXPLAINED, 0)
    assert found.kept == (0, 2)
    assert found.weights.sum(1) == pytest.approx(1)
    places = found.weights @ PLACES[[0, 2]]
    assert places == pytest.approx(PLACES, abs=0.15)
    assert set(found.divergences) == {1, 3}
    assert found.steps > 0


@pytest.mark.usefixtures("by_actions")
def test_whoever_cannot_be_explained_keeps_a_strategy(shown):
    found = spanning.spanning_set(FOUR, shown, WEIGHTS, np.zeros(4), EXPLAINED, 0)
    assert found.kept == (0, 1, 2, 3)
    assert np.array_equal(found.weights, WEIGHTS)
    assert found.divergences == {}


def test_by_rollouts_one_stays_where_everybody_is_content(shown):
    few = MixtureSettings(4, 0, n_finalists=1, search_rollouts=1, final_rollouts=1)
    found = spanning.spanning_set(FOUR, shown, WEIGHTS, np.full(4, 1e6), few, 0)
    assert len(found.kept) == 1
    assert np.array_equal(found.weights, np.ones((4, 1)))


def test_thresholds_for_other_people_are_refused(shown):
    with pytest.raises(InputError, match=r"^4 rows of weights and thresholds of shape \(3,\) for 4 demonstr"):
        spanning.spanning_set(FOUR, shown, WEIGHTS, np.ones(3), EXPLAINED, 0)
