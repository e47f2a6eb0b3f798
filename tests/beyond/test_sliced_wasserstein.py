import numpy as np
import pytest
from helpers import balancers

from dmsrd_lite.beyond.sliced_wasserstein import sliced_wasserstein
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER
from dmsrd_lite.method.divergence import policy_divergences


@pytest.mark.parametrize("domain", [INVERTED_PENDULUM, LUNAR_LANDER], ids=lambda d: d.name)
def test_of_a_shift_it_is_the_mean_projection_of_the_shift(domain):
    """W_1 of p and p + c is |u . c| along u; over the sphere its mean is |c| E|u_1|."""
    rng, d = np.random.default_rng(0), len(domain.comparison.coordinates) or domain.obs_dim
    shown = 0.1 * rng.normal(size=(2, 50, domain.obs_dim))
    moved = shown.copy()
    moved[..., 0] += 0.3 * domain.observation_scale[0]
    directions = rng.standard_normal((100_000, d))
    expected = 0.3 * np.abs(directions[:, 0] / np.linalg.norm(directions, axis=1)).mean()
    assert sliced_wasserstein(domain, shown, moved) == pytest.approx(expected, rel=0.25)
    assert sliced_wasserstein(domain, shown, shown) == 0
    twice = moved.copy()
    twice[..., 0] += 0.3 * domain.observation_scale[0]
    ratio = sliced_wasserstein(domain, shown, twice) / sliced_wasserstein(domain, shown, moved)
    assert ratio == pytest.approx(2, rel=1e-3)


def test_it_can_take_the_place_of_the_kl(small_set):
    actor = balancers([-0.4, 0.4])
    found = policy_divergences(actor, small_set.select([0]), 0, n_rollouts=2, measure=sliced_wasserstein)
    assert found.shape == (2,)
    assert (found > 0).all()
