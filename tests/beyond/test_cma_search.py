import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.beyond.cma_search import CMASettings, search_by_cma
from dmsrd_lite.demonstrations import demonstrations_from
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER, InputError
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.policy_mixture import Mixtures, MixtureSettings, Search

THREE = balancers([-0.4, 0.0, 0.4])
FEW = MixtureSettings(n_finalists=2, search_rollouts=1, final_rollouts=2)


def newcomer(weights):
    actor = Mixtures(THREE, [weights])
    return demonstrations_from(rollout(INVERTED_PENDULUM, actor, 2, 1, horizon=60), actor)


def test_it_finds_the_least_of_a_known_function(monkeypatch):
    """A quadratic in the weights instead of rollouts: the minimum is known."""
    best = np.array([0.6, 0.1, 0.3])
    monkeypatch.setattr(Search, "measure", lambda self, w, *_: ((np.atleast_2d(w) - best) ** 2).sum(1))
    fit = search_by_cma(THREE, newcomer([0.6, 0.1, 0.3]), FEW, 0, CMASettings(12, 25))
    assert np.abs(fit.weights - best).max() < 0.02
    assert fit.candidates.shape == (12 * 25, 3)
    assert np.allclose(fit.candidates.sum(1), 1)


def test_steps_are_counted_and_the_same_seed_finds_the_same():
    shown, settings = newcomer([0.5, 0.0, 0.5]), CMASettings(4, 2)
    fits = [search_by_cma(THREE, shown, FEW, seed, settings) for seed in (0, 0, 1)]
    assert fits[0].steps == 60 * (8 * 1 + 2 * 2 + 2)
    assert np.array_equal(fits[0].candidates, fits[1].candidates)
    assert fits[0].divergence == fits[1].divergence
    assert not np.array_equal(fits[0].candidates, fits[2].candidates)


def test_policies_of_another_domain_are_refused():
    with pytest.raises(InputError, match=r"^a mixture of policies of lunar_lander cannot explain a demonstr"):
        search_by_cma(GaussianPolicies(LUNAR_LANDER, 2, 0).actor(), newcomer([1.0, 0.0, 0.0]), FEW, 0)
