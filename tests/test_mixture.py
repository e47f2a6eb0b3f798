import numpy as np
import pytest
from scipy.stats import kstest, norm

from dmsrd_lite import mixture
from dmsrd_lite.demonstrations import DemonstrationSet, demonstrations_from
from dmsrd_lite.envs import INVERTED_PENDULUM, InputError
from dmsrd_lite.metrics import policy_divergences
from dmsrd_lite.mixture import Mixtures, MixtureSettings, check_weights, likeliest_weights, regress_weights, search_mixture
from dmsrd_lite.networks import Actor, GaussianPolicies
from dmsrd_lite.rollouts import rollout

QUICK = MixtureSettings(n_candidates=16, n_refinements=8, n_finalists=4, final_rollouts=4)
WEIGHTS = np.array([[0.2, 0.8, 0.0], [1 / 3, 1 / 3, 1 / 3]])


def balancers(places, sigma=0.1):
    """Linear policies ``k . (s - (place, 0, 0, 0))`` with the gains of an LQR: the cart balances at ``place`` (m)."""
    gain = np.array([0.741, 6.023, 0.868, 1.012]) * INVERTED_PENDULUM.observation_scale
    shift = -0.741 * np.array(places)[:, None, None]
    weights = np.tile(gain[None, :, None], (len(places), 1, 1))
    return Actor(INVERTED_PENDULUM, [weights.astype(np.float32)], [shift.astype(np.float32)], np.full_like(shift, sigma, np.float32))


def shown_by(actor, horizon=60, seed=1):
    """One demonstration of two trajectories by every policy."""
    data = rollout(INVERTED_PENDULUM, actor, 2, seed, horizon=horizon)
    labels = np.arange(actor.n_strategies)
    return DemonstrationSet(INVERTED_PENDULUM, data.observations, data.executed_actions, data.rewards, labels, data.reset_seeds)


@pytest.fixture
def actor(domain):
    """Three networks with means and sigmas far from each other."""
    policies = GaussianPolicies(domain, 3, 0)
    policies.network.weights[-1].data.mul_(100)
    policies.log_sigma.data[:, 0, 0].copy_(policies.log_sigma.data.new_tensor([-2.0, -1.0, 0.5]))
    return policies.actor()


@pytest.fixture
def states():
    return np.random.default_rng(0).normal(size=(2, 5, 4))


def test_mean_is_the_weighted_mean_and_sigma_the_weighted_sum(actor, states):
    mixed = Mixtures(actor, WEIGHTS)
    means, sigmas = mixed.mean(states), mixed.sigma
    for k in range(2):
        for e in range(5):
            by_hand = sum(WEIGHTS[k, j] * actor.mean(np.tile(states[k, e], (3, 1, 1)))[j, 0, 0] for j in range(3))
            assert means[k, e, 0] == pytest.approx(by_hand, rel=1e-5)
        assert sigmas[k, 0, 0] == pytest.approx(sum(WEIGHTS[k, j] * actor.sigma[j, 0, 0] for j in range(3)), rel=1e-6)
    assert np.ptp(actor.mean(np.repeat(states[:1], 3, 0)), axis=0).mean() > 0.1, "alike means would prove nothing"


def test_a_pure_weight_is_the_pure_policy(actor):
    states, actions = (np.random.default_rng(0).normal(size=(3, 5, d)) for d in (4, 1))
    pure = Mixtures(actor, np.eye(3))
    assert pure.n_strategies == 3
    assert np.array_equal(pure.sigma, actor.sigma)
    assert np.allclose(pure.mean(states), actor.mean(states), atol=1e-6)
    assert np.allclose(pure.log_density(states, actions), actor.log_density(states, actions), rtol=1e-4)


def test_log_density_is_that_of_one_normal(actor, states):
    actions = np.random.default_rng(1).normal(size=(2, 5, 1))
    mixed = Mixtures(actor, WEIGHTS)
    written = norm.logpdf(actions, mixed.mean(states), mixed.sigma)[..., 0]
    assert np.allclose(mixed.log_density(states, actions), written, rtol=1e-5)
    floored = norm.logpdf(actions, mixed.mean(states), np.maximum(mixed.sigma, 0.9))[..., 0]
    assert np.allclose(mixed.log_density(states, actions, 0.9), floored, rtol=1e-5)
    assert mixed.sigma[0] < 0.9 < actor.sigma.max(), "the floor must hold for the mixture and not for every policy in it"


def test_what_is_executed_is_what_is_counted(actor, domain):
    mixed = Mixtures(actor, WEIGHTS)
    data = rollout(domain, mixed, 4, 5, horizon=50)
    states, actions = data.observations[:, :, :-1].reshape(2, 200, 4), data.actions.reshape(2, 200, 1)
    noise = (actions - mixed.mean(states)) / mixed.sigma
    assert kstest(noise.ravel(), "norm").pvalue > 0.05
    alone = rollout(domain, actor.select([0, 0]), 4, 5, horizon=50)  # the same seed, so the same noise
    mean = actor.mean(np.repeat(alone.observations[:, :, :-1].reshape(1, 400, 4), 3, 0))[0].reshape(2, 200, 1)
    assert np.allclose(noise, (alone.actions.reshape(2, 200, 1) - mean) / actor.sigma[0], atol=1e-3)
    assert np.allclose(data.log_densities.reshape(2, 200), mixed.log_density(states, actions), atol=1e-3)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_finds_the_strategy_that_gave_the_demonstration(place):
    actor = balancers([-0.4, 0.0, 0.4])
    fit = search_mixture(actor, shown_by(actor).select([place]), QUICK, 0)
    assert np.eye(3)[place] == pytest.approx(fit.weights, abs=0.05)
    others = np.delete(fit.divergences[:3], place)
    assert fit.divergence < 1.0 < others.min(), "the other strategies must be far, or finding the right one is luck"


def test_finds_the_mixture_that_gave_the_demonstration():
    actor, truth = balancers([-0.4, 0.4]), np.array([0.3, 0.7])
    fit = search_mixture(actor, shown_by(Mixtures(actor, truth)), QUICK, 0)
    assert fit.weights == pytest.approx(truth, abs=0.05)
    assert fit.divergence < 1.0 < fit.divergences[:2].min()


def test_candidates_lie_on_the_simplex_with_the_pure_ones_and_the_incumbent_among_them():
    actor, incumbent = balancers([-0.4, 0.0, 0.4]), np.array([0.15, 0.6, 0.25])
    fit = search_mixture(actor, shown_by(actor).select([0]), QUICK, 0, incumbent=incumbent)
    assert np.array_equal(fit.candidates[:4], [*np.eye(3), incumbent])
    assert fit.candidates.shape == (4 + 16 + 8, 3)
    assert fit.candidates.min() >= 0
    assert fit.candidates.sum(1) == pytest.approx(np.ones(28))
    assert len(np.unique(fit.candidates, axis=0)) == 28
    assert fit.divergences.shape == (28,)
    finalists = 4 + (fit.divergences[3] > np.sort(fit.divergences)[3])  # and the incumbent, where it is none of the best four
    assert fit.steps == 60 * (28 * 2 + finalists * 4 + 4)


def test_the_search_is_deterministic_for_any_number_of_threads():
    actor = balancers([-0.4, 0.0, 0.4])
    shown = shown_by(actor).select([1])
    one, two = (search_mixture(actor, shown, QUICK, 3, n_threads=n) for n in (1, 2))
    for name in ("weights", "divergence", "candidates", "divergences", "steps"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    other = search_mixture(actor, shown, QUICK, 4)
    assert not np.array_equal(one.candidates, other.candidates)


def test_one_strategy_has_one_mixture():
    actor = balancers([0.0])
    shown = shown_by(actor)
    fit = search_mixture(actor, shown, QUICK, 0)
    assert fit.weights.tolist() == [1.0]
    assert fit.candidates.tolist() == [[1.0]]
    assert fit.divergence == pytest.approx(policy_divergences(actor, shown, [0, 4], n_rollouts=4)[0])
    assert search_mixture(actor, shown, QUICK, 0, incumbent=[1.0]).weights.tolist() == [1.0]


def test_the_choice_by_hand(monkeypatch):
    """With made-up divergences: the finals decide among the best of the search and the incumbent, and the winner is measured anew."""
    incumbent, seeds = np.array([0.2, 0.5, 0.3]), []

    def divergences(mixtures, demonstration, seed, *, n_rollouts, n_threads):
        seeds.append(seed)
        weights = mixtures.weights
        if len(seeds) <= 2:  # the search: the nearer to strategy 2, the better
            return 1 - weights[:, 2].astype(float)
        finals.append(weights)
        if len(seeds) == 4:
            return np.array([7.0])
        return np.where(np.abs(weights - incumbent).max(1) < 1e-6, -1.0, 1.0)

    finals = []
    monkeypatch.setattr(mixture, "policy_divergences", divergences)
    fit = search_mixture(balancers([-0.4, 0.0, 0.4]), shown_by(balancers([0.0])), QUICK, 0, incumbent=incumbent)
    assert len(finals[0]) == 5
    assert finals[0][0].tolist() == [0, 0, 1], "strategy 2 was the best of the search"
    assert np.array_equal(fit.weights, incumbent)
    assert fit.divergence == 7.0
    assert np.allclose(finals[1], [incumbent])
    assert len({str(s) for s in seeds}) == 4, "each measurement has rollouts of its own"
    around = fit.candidates[-8:]
    assert around[:, 2].mean() > 0.9, "refinements are drawn around the best of the search"


@pytest.mark.parametrize("change", [{"n_candidates": 0}, {"n_refinements": 0}])
def test_a_part_of_the_search_can_be_left_out(change):
    actor = balancers([-0.4, 0.4])
    settings = MixtureSettings(**{"n_candidates": 4, "n_refinements": 4, "n_finalists": 2, "final_rollouts": 2, **change})
    fit = search_mixture(actor, shown_by(actor).select([0]), settings, 0)
    assert len(fit.candidates) == 2 + 4


BAD_WEIGHTS = {
    "negative": ([1.2, -0.2], "mixture weights -0.2: expected weights of at least 0"),
    "sum": ([0.5, 0.4], "mixture weights that sum to 0.9: expected a sum of 1"),
    "sum of one row": ([[0.5, 0.5], [0.0, 0.0]], "mixture weights that sum to 0: expected a sum of 1"),
    "number": ([0.5, 0.3, 0.2], r"mixture weights of shape \(1, 3\): expected 2 weights in a row, one for each strategy"),
    "axes": ([[[0.5, 0.5]]], r"mixture weights of shape \(1, 1, 2\): expected 2 weights in a row"),
    "nan": ([np.nan, 1.0], "mixture weights nan: expected weights of at least 0"),
    "infinite": ([np.inf, 0.0], "mixture weights inf: expected"),
    "none": ([], "a mixture of no strategies: expected at least one strategy and one row of weights"),
}


@pytest.mark.parametrize("fault", BAD_WEIGHTS)
def test_bad_weights_are_refused_in_one_sentence(fault):
    weights, sentence = BAD_WEIGHTS[fault]
    actor = balancers([-0.4, 0.4])
    for use in (lambda: check_weights(weights, 2), lambda: Mixtures(actor, weights)):
        with pytest.raises(InputError, match=f"^{sentence}") as caught:
            use()
        assert "\n" not in str(caught.value)
    shown = shown_by(balancers([0.0]), 10)
    with pytest.raises(InputError, match=f"^{sentence}"):
        search_mixture(actor, shown, QUICK, 0, incumbent=weights)


def test_no_strategies_and_several_demonstrations_are_refused():
    with pytest.raises(InputError, match="a mixture of no strategies"):
        check_weights(np.zeros((1, 0)), 0)
    actor = balancers([-0.4, 0.4])
    with pytest.raises(InputError, match="one demonstration at a time; expected a set of 1, not 2"):
        search_mixture(actor, shown_by(actor, 10), QUICK, 0)


def test_rounding_is_forgiven():
    table = check_weights([1 + 1e-10, -1e-10], 2)
    assert table.min() == 0


def test_regressed_weights_are_the_least_squares_on_the_simplex(actor):
    """Against SciPy's general minimiser, and exact where the demonstration is a noiseless mixture."""
    from scipy.optimize import minimize

    true = np.array([0.2, 0.5, 0.3])
    quiet = Mixtures(actor.select(range(3), 1e-6), [true])
    exact = demonstrations_from(rollout(INVERTED_PENDULUM, quiet, 2, 0, horizon=60), quiet)
    assert regress_weights(actor, exact) == pytest.approx(true, abs=0.02)
    noisy = shown_by(balancers([-0.1]), 60)
    found = regress_weights(actor, noisy)
    means = actor.mean(noisy.observations[0, :, :60].reshape(1, -1, 4))[..., 0]
    wanted = noisy.actions[0].ravel()
    best = minimize(lambda w: np.square(wanted - w @ means).mean(), np.ones(3) / 3, bounds=[(0, 1)] * 3, tol=1e-12,
                    constraints={"type": "eq", "fun": lambda w: w.sum() - 1})  # fmt: skip
    error = [np.square(wanted - w @ means).mean() for w in (found, best.x)]
    assert error[0] <= error[1] + 1e-6
    assert found.sum() == pytest.approx(1)
    assert found.min() >= 0


def test_likeliest_weights_are_told_by_sigma_where_the_means_are_equal():
    """Closed form: ``w s_0 + (1 - w) s_1`` is the root mean square distance of the actions from the mean."""
    one = balancers([0.0], sigma=0.1)
    actor = Actor.joined([one, one.select([0], 3.0)])
    shown = shown_by(Mixtures(actor, [[0.35, 0.65]]), 400)
    means = actor.mean(np.repeat(shown.observations[:, :, :400].reshape(1, -1, 4), 2, 0))[0, :, 0]
    spread = np.sqrt(np.square(shown.actions.ravel() - means).mean())
    assert likeliest_weights(actor, shown)[0] == pytest.approx((spread - 0.3) / (0.1 - 0.3), abs=1e-3)
    assert likeliest_weights(actor, shown)[0] == pytest.approx(0.35, abs=0.05)


def test_likeliest_weights_are_the_least_squares_where_the_sigmas_are_equal():
    actor = balancers([-0.3, 0.0, 0.4])
    shown = shown_by(Mixtures(actor, [[0.2, 0.5, 0.3]]), 200)
    means = actor.mean(np.repeat(shown.observations[:, :, :200].reshape(1, -1, 4), 3, 0))[..., 0]
    likeliest, regressed = likeliest_weights(actor, shown), regress_weights(actor, shown)
    assert likeliest @ means == pytest.approx(regressed @ means, abs=1e-3)  # of the weights only one direction shows: the place
    assert likeliest.sum() == pytest.approx(1)
    assert likeliest.min() >= 0


def test_near_weights_from_actions_save_the_search():
    actor = balancers([-0.4, 0.4])
    shown = shown_by(balancers([0.4]), 60)
    settings = MixtureSettings(4, 2, search_rollouts=1, n_finalists=2, final_rollouts=2, from_actions=True)
    near = search_mixture(actor, shown, settings, 0, enough=1e9)
    assert (len(near.candidates), near.steps) == (1, 2 * 60)
    assert np.array_equal(near.weights, likeliest_weights(actor, shown))
    far = search_mixture(actor, shown, settings, 0, enough=-1e9)
    assert far.steps > near.steps
    assert any(np.array_equal(row, near.weights) for row in far.candidates), "it is a candidate all the same"
