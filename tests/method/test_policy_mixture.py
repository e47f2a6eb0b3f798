from dataclasses import replace

import numpy as np
import pytest
from helpers import balancers
from scipy.optimize import minimize
from scipy.stats import kstest, norm
from tiny import same

from dmsrd_lite.demonstrations import demonstrations_from
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER, InputError
from dmsrd_lite.learning.networks import Actor, GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import policy_mixture
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.method.policy_mixture import Mixtures, MixtureSettings, check_weights, search_mixture

QUICK = MixtureSettings(n_candidates=16, n_refinements=8, n_finalists=4, final_rollouts=4)
WEIGHTS = np.array([[0.2, 0.8, 0.0], [1 / 3, 1 / 3, 1 / 3], [0.1, 0.3, 0.6]])
TWO, THREE = balancers([-0.4, 0.4]), balancers([-0.4, 0.0, 0.4])


def shown_by(actor, horizon=60):
    """One demonstration of two trajectories by every policy, or by every mixture."""
    return demonstrations_from(rollout(INVERTED_PENDULUM, actor, 2, 1, horizon=horizon), actor)


def states_of(shown, n):
    """The states in which the first demonstrator acted, for ``n`` policies."""
    return shown.observations[0, :, :-1].reshape(1, -1, 4).repeat(n, 0)


@pytest.fixture
def actor(domain):
    """Three networks with means and sigmas far from each other."""
    policies = GaussianPolicies(domain, 3, 0)
    policies.network.weights[-1].data.mul_(100)
    policies.log_sigma.data[:, 0, 0].copy_(policies.log_sigma.data.new_tensor([-2.0, -1.0, 0.5]))
    return policies.actor()


def test_equation_2(actor):
    """One Gaussian around the weighted mean, with the weighted sigmas; a pure weight is the pure policy."""
    states, actions = (np.random.default_rng(0).normal(size=(3, 5, d)) for d in (4, 1))
    for weights in (WEIGHTS, np.eye(3)):
        mixed = Mixtures(actor, weights)
        means = actor.mean(states.reshape(1, 15, 4).repeat(3, 0)).reshape(3, 3, 5, 1)
        assert np.allclose(mixed.mean(states), np.einsum("km,mkea->kea", weights, means), rtol=1e-4)
        assert np.allclose(mixed.sigma[:, 0, 0], weights @ actor.sigma[:, 0, 0], rtol=1e-6)
        for floor in (0.0, 0.9):  # of the mixture's sigma, not of every policy's
            written = norm.logpdf(actions, mixed.mean(states), np.maximum(mixed.sigma, floor))[..., 0]
            assert np.allclose(mixed.log_density(states, actions, floor), written, rtol=1e-4)
    assert np.allclose(mixed.log_density(states, actions), actor.log_density(states, actions), rtol=1e-4)
    assert np.ptp(means, axis=0).mean() > 0.1, "alike means would prove nothing"


def test_what_is_executed_is_what_is_counted(actor, domain):
    mixed = Mixtures(actor, WEIGHTS[:2])
    data = rollout(domain, mixed, 4, 5, horizon=50)
    states, actions = data.observations[:, :, :-1].reshape(2, 200, 4), data.actions.reshape(2, 200, 1)
    noise = (actions - mixed.mean(states)) / mixed.sigma
    assert kstest(noise.ravel(), "norm").pvalue > 0.05
    alone = rollout(domain, actor.select([0, 0]), 4, 5, horizon=50)  # the same seed, so the same noise
    mean = actor.select([0, 0]).mean(alone.observations[:, :, :-1].reshape(2, 200, 4))
    assert np.allclose(noise, (alone.actions.reshape(2, 200, 1) - mean) / actor.sigma[0], atol=1e-3)
    assert np.allclose(data.log_densities.reshape(2, 200), mixed.log_density(states, actions), atol=1e-3)


@pytest.mark.parametrize(("among", "truth"), [*((THREE, e) for e in np.eye(3)), (TWO, np.array([0.3, 0.7]))])
def test_finds_the_strategy_or_the_mixture_that_gave_the_demonstration(among, truth):
    fit = search_mixture(among, shown_by(Mixtures(among, truth)), QUICK, 0)
    assert fit.weights == pytest.approx(truth, abs=0.05)
    others = fit.divergences[: len(truth)][truth < 1]
    assert fit.divergence < 1.0 < others.min(), "the others must be far, or finding the right one is luck"


def test_candidates_are_the_pure_ones_the_incumbent_and_others_on_the_simplex():
    incumbent = np.array([0.15, 0.6, 0.25])
    fit = search_mixture(THREE, shown_by(THREE).select([0]), QUICK, 0, incumbent=incumbent)
    assert np.array_equal(fit.candidates[:4], [*np.eye(3), incumbent])
    assert len(np.unique(fit.candidates, axis=0)) == len(fit.divergences) == 4 + 16 + 8
    assert np.allclose(check_weights(fit.candidates, 3), fit.candidates)
    finalists = 4 + (fit.divergences[3] > np.sort(fit.divergences)[3])  # and the incumbent, where it is none
    assert fit.steps == 60 * (28 * 2 + finalists * 4 + 4)
    assert fit.searched == 60 * 28 * 2


def test_the_search_is_deterministic_for_any_number_of_threads(domain):
    shown = shown_by(THREE).select([1])
    alike = [search_mixture(THREE, replace(shown, domain=domain.on_threads(n)), QUICK, 3) for n in (1, 2)]
    assert same(*({k: np.asarray(v) for k, v in vars(fit).items()} for fit in alike))
    assert not np.array_equal(alike[0].candidates, search_mixture(THREE, shown, QUICK, 4).candidates)


def test_one_strategy_has_one_mixture():
    actor = balancers([0.0])
    shown = shown_by(actor)
    fit = search_mixture(actor, shown, QUICK, 0)
    assert (fit.weights.tolist(), fit.candidates.tolist()) == ([1.0], [[1.0]])
    assert fit.divergence == pytest.approx(policy_divergences(actor, shown, [0, 4], n_rollouts=4)[0])
    assert search_mixture(actor, shown, QUICK, 0, incumbent=[1.0]).weights.tolist() == [1.0]


def test_the_choice_by_hand(monkeypatch):
    """Made-up divergences: the finals choose of the best and the incumbent, the winner is measured anew."""
    incumbent, seeds, finals = np.array([0.2, 0.5, 0.3]), [], []

    def divergences(mixtures, demonstration, seed, *, n_rollouts, **_):
        seeds.append(seed)
        weights = mixtures.weights
        if len(seeds) <= 2:  # the search: the nearer to strategy 2, the better
            return 1 - weights[:, 2].astype(float)
        finals.append(weights)
        near = np.abs(weights - incumbent).max(1) < 1e-6
        return np.where(near, -1.0, 1.0) if len(seeds) == 3 else np.array([7.0])

    monkeypatch.setattr(policy_mixture, "policy_divergences", divergences)
    fit = search_mixture(THREE, shown_by(balancers([0.0])), QUICK, 0, incumbent=incumbent)
    assert len(finals[0]) == 5
    assert [0, 0, 1] in finals[0].tolist(), "strategy 2 was the best of the search"
    assert np.array_equal(fit.weights, incumbent)
    assert np.allclose(finals[1], [incumbent])
    assert fit.divergence == 7.0
    assert len({str(s) for s in seeds}) == 4, "each measurement has rollouts of its own"
    assert fit.candidates[-8:, 2].mean() > 0.9, "refinements are drawn around the best of the search"


def test_with_common_random_numbers_equal_candidates_have_equal_divergences():
    """The same starts and the same noise: what is left of a difference is the weights'."""
    shown = shown_by(TWO).select([0])
    twins = Mixtures(TWO, [[0.5, 0.5], [0.5, 0.5], [0.6, 0.4]])
    own, common = (policy_divergences(twins, shown, 0, n_rollouts=2, common=c) for c in (False, True))
    assert own[0] != own[1]
    assert common[0] == common[1] != common[2]
    data = rollout(INVERTED_PENDULUM, twins, 3, 0, horizon=20, common=True)
    assert (data.reset_seeds == data.reset_seeds[0]).all()
    noise = (data.actions - twins.mean(data.observations[:, :, 0])[:, :, None]) / twins.sigma[:, :, None]
    assert np.allclose(noise[:, :, 0], noise[0, :, 0], atol=1e-5)
    fit = search_mixture(TWO, shown, replace(QUICK, common=True), 0)
    assert fit.steps == search_mixture(TWO, shown, QUICK, 0).steps


def test_the_bound_on_weights_is_what_least_squares_reaches():
    """Many noisy people with known means: the deviation of the regression is the Cramer-Rao bound."""
    policies = GaussianPolicies(INVERTED_PENDULUM, 3, 0)
    policies.network.weights[-1].data.mul_(50)
    three, weights, found = policies.actor(), np.array([0.5, 0.2, 0.3]), []
    actor = Mixtures(three, [weights])
    data = rollout(INVERTED_PENDULUM, actor, 2, 1, horizon=200)
    shown = demonstrations_from(data, actor)
    bound = policy_mixture.weight_deviations(three, shown, weights)
    means, rng = actor.mean(data.observations[0, :, :-1].reshape(1, -1, 4)), np.random.default_rng(0)
    for _ in range(300):
        acted = means + actor.sigma * rng.standard_normal(means.shape)
        noisy = replace(shown, actions=acted.reshape(shown.actions.shape).astype(np.float32))
        a, mu, _ = policy_mixture.inside_bounds(three, noisy)
        third = np.linalg.lstsq((mu[:2] - mu[2]).T, a - mu[2], rcond=None)[0]
        found.append([*third, 1 - third.sum()])
    assert np.std(found, axis=0) == pytest.approx(bound, rel=0.2)


def test_where_two_people_act_alike_nobody_can_say_whose_share_it_is():
    twins = balancers([0.4, 0.4 + 1e-4, -0.4])
    shown = shown_by(Mixtures(twins, [[0.5, 0.0, 0.5]]), 200)
    alike, alike_too, other = policy_mixture.weight_deviations(twins, shown, [0.3, 0.2, 0.5])
    assert min(alike, alike_too) > 100 * other


def test_the_bound_knows_that_sigma_tells():
    """Closed form for equal means: ``sigma_w / (|sigma_0 - sigma_1| sqrt(2 N))``."""
    one = balancers([0.0], sigma=0.1)
    actor = Actor.joined([one, one.select([0], 3.0)])
    shown = shown_by(Mixtures(actor, [[0.4, 0.6]]), 200)
    n = policy_mixture.inside_bounds(actor, shown)[0].size
    narrow, wide = actor.sigma.ravel()
    expected = (0.4 * narrow + 0.6 * wide) / ((wide - narrow) * np.sqrt(2 * n))
    assert policy_mixture.weight_deviations(actor, shown, [0.4, 0.6]) == pytest.approx([expected] * 2)


def test_policies_of_another_domain_cannot_explain():
    lander = GaussianPolicies(LUNAR_LANDER, 2, 0).actor()
    with pytest.raises(
        InputError, match=r"^a mixture of policies of lunar_lander cannot explain a demonstra"
    ):
        search_mixture(lander, shown_by(TWO).select([0]), QUICK, 0)


@pytest.mark.parametrize("change", [{"n_candidates": 0}, {"n_refinements": 0}])
def test_a_part_of_the_search_can_be_left_out(change):
    settings = replace(MixtureSettings(4, 4, n_finalists=2, final_rollouts=2), **change)
    assert len(search_mixture(TWO, shown_by(TWO).select([0]), settings, 0).candidates) == 2 + 4


BAD_WEIGHTS = {
    "negative": ([1.2, -0.2], "mixture weights -0.2: expected weights of at least 0"),
    "sum": ([0.5, 0.4], "mixture weights that sum to 0.9: expected a sum of 1"),
    "sum of one row": ([[0.5, 0.5], [0.0, 0.0]], "mixture weights that sum to 0: expected a sum of 1"),
    "number": ([0.5, 0.3, 0.2], r"mixture weights of shape \(1, 3\): expected 2 weights in a row, one for"),
    "axes": ([[[0.5, 0.5]]], r"mixture weights of shape \(1, 1, 2\): expected 2 weights in a row"),
    "nan": ([np.nan, 1.0], "mixture weights nan: expected weights of at least 0"),
    "infinite": ([np.inf, 0.0], "mixture weights inf: expected"),
    "none": ([], "a mixture of no strategies: expected at least one strategy and one row of weights"),
}


@pytest.mark.parametrize("fault", BAD_WEIGHTS)
def test_bad_weights_are_refused_in_one_sentence(fault):
    weights, sentence = BAD_WEIGHTS[fault]
    shown = shown_by(balancers([0.0]), 10)
    for use in (
        lambda: check_weights(weights, 2),
        lambda: Mixtures(TWO, weights),
        lambda: search_mixture(TWO, shown, QUICK, 0, incumbent=weights),
    ):
        with pytest.raises(InputError, match=f"^{sentence}[^\n]*$"):
            use()


def test_no_strategies_and_several_demonstrations_are_refused_and_rounding_forgiven():
    with pytest.raises(InputError, match="a mixture of no strategies"):
        check_weights(np.zeros((1, 0)), 0)
    with pytest.raises(InputError, match="one demonstration at a time; expected a set of 1, not 2"):
        search_mixture(TWO, shown_by(TWO, 10), QUICK, 0)
    assert check_weights([1 + 1e-10, -1e-10], 2).min() == 0


def test_actions_at_a_bound_do_not_count(actor, domain):
    loud = shown_by(actor.select([0], 100.0))
    kept, means, sigmas = policy_mixture.inside_bounds(actor, loud)
    actions = loud.actions[0].ravel()
    inside = np.abs(actions) < domain.action_high[0]
    assert 0 < inside.sum() < len(actions)
    assert np.allclose(kept * domain.half_range, actions[inside])
    assert means.shape == sigmas.shape == (3, inside.sum())


def test_likeliest_weights_are_told_by_sigma_where_the_means_are_equal():
    """Closed form: ``w s_0 + (1 - w) s_1`` is the root mean square distance of the actions from the mean."""
    one = balancers([0.0], sigma=0.1)
    actor = Actor.joined([one, one.select([0], 3.0)])
    shown = shown_by(Mixtures(actor, [[0.35, 0.65]]), 400)
    spread = np.sqrt(np.square(shown.actions[0].ravel() - one.mean(states_of(shown, 1))[0, :, 0]).mean())
    found = policy_mixture.likeliest_weights(actor, shown)
    assert found[0] == pytest.approx((spread - 0.3) / (0.1 - 0.3), abs=1e-3)
    assert found[0] == pytest.approx(0.35, abs=0.05)


def test_the_loss_of_actions_is_their_negative_log_likelihood():
    shown, w = shown_by(Mixtures(TWO, [[0.3, 0.7]])), [0.3, 0.7]
    a, mu, sigma = (
        x[..., :] / 3 for x in (shown.actions[0].ravel(), TWO.mean(states_of(shown, 2)), TWO.sigma)
    )
    told = norm.logpdf(a, w @ mu[..., 0], w @ sigma[:, 0, 0])[np.abs(a) < 1]
    found = policy_mixture.action_loss(TWO, shown, w)
    assert found == pytest.approx(-told.mean() - np.log(2 * np.pi) / 2, abs=1e-5)
    assert policy_mixture.action_loss(TWO, shown, [0.9, 0.1]) > found + 0.01


def test_actions_that_all_stand_at_a_bound_say_nothing():
    shown = shown_by(TWO).select([0])
    weights = policy_mixture.likeliest_weights(TWO, replace(shown, actions=np.full_like(shown.actions, 3.0)))
    assert weights.tolist() == [0.5, 0.5]


def test_likeliest_weights_are_the_least_squares_where_the_sigmas_are_equal():
    """Of these weights only one direction shows: the place."""
    shown = shown_by(Mixtures(THREE, [[0.2, 0.5, 0.3]]), 200)
    found = check_weights(policy_mixture.likeliest_weights(THREE, shown), 3)
    means, acted = THREE.mean(states_of(shown, 3))[..., 0], shown.actions[0].ravel()
    simplex = {"bounds": [(0, 1)] * 3, "constraints": {"type": "eq", "fun": lambda w: w.sum() - 1}}
    best = minimize(lambda w: np.square(acted - w @ means).mean(), np.ones(3) / 3, tol=1e-12, **simplex)
    assert np.allclose(found @ means, best.x @ means, atol=1e-3)


def test_near_weights_from_actions_save_the_search():
    shown = shown_by(balancers([0.4]), 60)
    settings = MixtureSettings(4, 2, 40, 1, 2, 2, from_actions=True)
    near, far = (search_mixture(TWO, shown, settings, 0, enough=enough) for enough in (1e9, -1e9))
    assert (len(near.candidates), near.steps) == (1, 2 * 60)
    assert np.array_equal(near.weights, policy_mixture.likeliest_weights(TWO, shown))
    assert far.steps > near.steps
    assert any(np.array_equal(row, near.weights) for row in far.candidates), "it is a candidate all the same"
    at = search_mixture(TWO, shown, settings, 0, enough=near.divergence)
    assert at.steps == far.steps, "below, not at"
