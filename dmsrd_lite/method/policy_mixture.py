"""Policy mixtures: a demonstration explained as a blend of known strategies. Paper: Equations 2 and 3."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space
from scipy.optimize import minimize

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import InputError
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.networks import Actor, Policies, one_thread
from dmsrd_lite.method.divergence import Measure, demonstration_divergence, policy_divergences, steps_measured


def check_weights(weights: ArrayLike, n_strategies: int) -> np.ndarray:
    """``weights`` as rows on the simplex, (K, n_strategies), or ``InputError``; one row may be flat."""
    table = np.atleast_2d(np.asarray(weights, dtype=np.float64))
    if n_strategies < 1 or table.size == 0:
        raise InputError("a mixture of no strategies: expected at least one strategy and one row of weights")
    if table.ndim != 2 or table.shape[1] != n_strategies:
        expected = f"expected {n_strategies} weights in a row, one for each strategy"
        raise InputError(f"mixture weights of shape {table.shape}: {expected}")
    faulty = ~np.isfinite(table) | (table < -1e-9)
    if faulty.any():
        raise InputError(f"mixture weights {table[faulty][0]:g}: expected weights of at least 0")
    wrong = np.abs(table.sum(1) - 1) > 1e-6
    if wrong.any():
        raise InputError(f"mixture weights that sum to {table[wrong][0].sum():g}: expected a sum of 1")
    return np.maximum(table, 0.0)


class Mixtures(Policies):
    """K mixtures ``pi_w(a|s) = N(sum_j w_j mu_j(s), (sum_j w_j sigma_j)^2)`` of M policies, to act and to
    score with.

    Equation 2. One Gaussian around the weighted mean: what is executed is what the likelihood counts, and a
    pure weight is the pure policy. weights (K, M).
    """

    def __init__(self, actor: Actor, weights: ArrayLike):
        self.actor, self.weights = actor, check_weights(weights, actor.n_strategies).astype(np.float32)
        self.sigma = np.einsum("km,mua->kua", self.weights, actor.sigma)  # (K, 1, action_dim)

    def mean(self, observations: np.ndarray) -> np.ndarray:
        k, e = observations.shape[:2]
        means = self.actor.mean(observations.reshape(1, k * e, -1))  # (M, K * E, action_dim)
        return np.einsum("km,mkea->kea", self.weights, means.reshape(-1, k, e, means.shape[-1]))


@dataclass(frozen=True)
class MixtureSettings:
    n_candidates: int = 64  # drawn from the simplex, beside the pure strategies and the incumbent
    n_refinements: int = 32  # drawn around the best of them
    concentration: float = 40.0  # of the refinements: Dirichlet(concentration * best + 0.1)
    search_rollouts: int = 2  # per candidate, to choose the finalists
    n_finalists: int = 6
    final_rollouts: int = 10  # of the protocol (``policy_divergences``)
    common: bool = False  # all of a round meet the same starts and the same noise (common random numbers)
    from_actions: bool = False  # ``likeliest_weights`` first: near enough, no search (beyond the paper)


@dataclass(frozen=True)
class MixtureFit:
    """The best mixture: weights (M,), its divergence in nats on fresh rollouts, and what the search saw."""

    weights: np.ndarray
    divergence: float
    candidates: np.ndarray  # (n, M)
    divergences: np.ndarray  # (n,), of the few rollouts of the search
    steps: int  # environment steps spent ...
    searched: int = 0  # ... and those before the finalists were measured again


def inside_bounds(actor: Actor, demonstration: DemonstrationSet) -> tuple[np.ndarray, ...]:
    """Actions (N,) of one demonstrator, and the actor's means and sigmas there (M, N), in half ranges.

    Without those at a bound: an action there says only that at least so much was wished.
    """
    domain, actions = (
        demonstration.domain,
        demonstration.actions[0].reshape(-1, demonstration.domain.action_dim),
    )
    states = demonstration.observations[0, :, : demonstration.horizon].reshape(1, len(actions), -1)
    low, high = np.array(domain.action_low), np.array(domain.action_high)
    inside, means = (actions > low + 1e-6) & (actions < high - 1e-6), actor.mean(states)
    sigmas = np.broadcast_to(actor.sigma, means.shape)
    return tuple((x / domain.half_range)[..., inside] for x in (actions, means, sigmas))


def action_loss(actor: Actor, demonstration: DemonstrationSet, weights: ArrayLike) -> float:
    """How unlikely one demonstrator's actions are under a mixture: ``-log N(a; w mu, (w sigma)^2)``, in nats
    for each coordinate of an action inside its bounds (in half ranges, without ``log(2 pi) / 2``)."""
    a, mu, sigma = (x.astype(np.float64) for x in inside_bounds(actor, demonstration))
    return _loss(check_weights(weights, actor.n_strategies)[0], a, mu, sigma)[0]


def _loss(w: np.ndarray, a: np.ndarray, mu: np.ndarray, sigma: np.ndarray) -> tuple[float, np.ndarray]:
    """``action_loss`` and its gradient, (M,)."""
    spread = w @ sigma
    z = (a - w @ mu) / spread
    gradient = ((sigma * (1 - z * z) - mu * z) / spread).mean(1)
    return float(np.mean(np.log(spread) + z * z / 2)), gradient


@one_thread()
def likeliest_weights(actor: Actor, demonstration: DemonstrationSet) -> np.ndarray:
    """The mixture under which one demonstrator's actions are the most likely: weights (M,), without a
    rollout.

    ``max_w sum_t log N(a_t; sum_j w_j mu_j(s_t), (sum_j w_j sigma_j)^2)`` over the simplex. Least squares if
    all sigmas are equal; where they are not, how widely somebody acts tells the weights as well. Equal
    weights where every action stands at a bound and says nothing.
    """
    a, mu, sigma = (x.astype(np.float64) for x in inside_bounds(actor, demonstration))
    m = len(mu)
    if not a.size:
        return np.full(m, 1 / m)
    simplex = {"type": "eq", "fun": lambda w: w.sum() - 1, "jac": np.ones_like}
    options: dict = {"bounds": [(0, 1)] * m, "constraints": simplex, "options": {"ftol": 1e-9}}
    found = minimize(_loss, np.full(m, 1 / m), (a, mu, sigma), jac=True, method="SLSQP", **options)
    weights = np.clip(found.x, 0, None)
    return weights / weights.sum()


def weight_deviations(actor: Actor, demonstration: DemonstrationSet, weights: ArrayLike) -> np.ndarray:
    """How well actions could tell the weights at best: the Cramer-Rao bound of their deviations, (M,).

    ``I = sum_t (Delta Delta^T + 2 Gamma Gamma^T) / sigma_w^2`` with ``Delta_j = mu_j - sum_k w_k mu_k`` and
    ``Gamma_j = sigma_j - sum_k w_k sigma_k``: where somebody acts tells their weights, and how widely.
    Weights move within the simplex, ``sum_j d_j = 0``. Where two people act alike everywhere it is huge:
    nobody can say whose share it is. It holds for known policies; learned ones are wrong by more.
    """
    w = check_weights(weights, actor.n_strategies)[0]
    _, mu, sigma = (x.astype(np.float64) for x in inside_bounds(actor, demonstration))
    where, how_widely = (mu - w @ mu) / (w @ sigma), sigma / (w @ sigma) - 1  # (M, N)
    along = null_space(np.ones((1, len(w))))  # (M, M - 1): directions within the simplex
    information = along.T @ (where @ where.T + 2 * how_widely @ how_widely.T) @ along
    values, directions = np.linalg.eigh(information)
    spread = (along @ directions) / np.sqrt(np.maximum(values, 1e-12 * values.max()))  # (M, M - 1)
    return np.sqrt((spread**2).sum(1))


class Search:
    """What every search over weights does: measure candidates, and choose the best in the end."""

    def __init__(
        self,
        actor: Actor,
        demonstration: DemonstrationSet,
        settings: MixtureSettings,
        seed: Seed,
        measure: Measure = demonstration_divergence,
    ):
        self.actor, self.demonstration, self.settings, self.seed = actor, demonstration, settings, seed
        self.of, self.steps = measure, 0
        if (n := demonstration.n_demonstrations) != 1:
            text = f"a mixture is searched for one demonstration at a time; expected a set of 1, not {n}"
            raise InputError(text)
        if (name := actor.domain.name) != demonstration.domain.name:
            text = f"a mixture of policies of {name} cannot explain a demonstration of"
            raise InputError(f"{text} {demonstration.domain.name}; expected one domain")

    def measure(self, weights: np.ndarray, part: int, n_rollouts: int) -> np.ndarray:
        """Divergences (K,) of mixtures (K, M) by so many rollouts; ``part`` of the seed."""
        self.steps += len(weights) * steps_measured(self.demonstration, n_rollouts)
        return policy_divergences(
            Mixtures(self.actor, weights),
            self.demonstration,
            extend(self.seed, part),
            n_rollouts=n_rollouts,
            common=self.settings.common,
            measure=self.of,
        )

    def best(
        self, candidates: np.ndarray, divergences: np.ndarray, always: tuple[int, ...] = ()
    ) -> MixtureFit:
        """The finalists measured by the protocol of every KL here, and the winner once more on rollouts of
        its own, because the least of several noisy numbers is too low."""
        s, searched = self.settings, self.steps
        finalists = np.union1d(np.argsort(divergences, kind="stable")[: s.n_finalists], always).astype(int)
        chosen = candidates[finalists[self.measure(candidates[finalists], 3, s.final_rollouts).argmin()]]
        divergence = float(self.measure(chosen[None], 4, s.final_rollouts)[0])
        return MixtureFit(chosen, divergence, candidates, divergences, self.steps, searched)


def search_mixture(
    actor: Actor,
    demonstration: DemonstrationSet,
    settings: MixtureSettings,
    seed: Seed,
    *,
    incumbent: ArrayLike | None = None,
    enough: float = 0.0,
) -> MixtureFit:
    """Random search on the simplex for the mixture whose rollouts are nearest to one demonstration (a set of
    one).

    Equation 3. Candidates: the pure strategies, the incumbent, Dirichlet(1) draws, half of them cut down to
    two or three strategies, then refinements around the best; each round is one batch of rollouts. With
    ``from_actions`` ``likeliest_weights`` are measured first, and taken if they come below ``enough`` nats.
    """
    m, s, rng = actor.n_strategies, settings, np.random.default_rng(seed)
    search = Search(actor, demonstration, settings, seed)
    drawn = rng.dirichlet(np.ones(m), s.n_candidates)
    for row in drawn[::2]:  # half of them are sparse: few strategies in a mixture are the common case
        kept = rng.permutation(m)[: 2 + rng.integers(2)]
        row[np.setdiff1d(np.arange(m), kept)] = 0.0
    drawn /= drawn.sum(1, keepdims=True)
    given = np.eye(m) if incumbent is None else np.vstack([np.eye(m), check_weights(incumbent, m)[:1]])
    candidates = np.vstack([given, drawn]) if m > 1 else given
    if s.from_actions and m > 1:
        likeliest = likeliest_weights(actor, demonstration)[None]
        divergences = search.measure(likeliest, 5, s.final_rollouts)
        if divergences[0] < enough:
            return MixtureFit(likeliest[0], float(divergences[0]), likeliest, divergences, search.steps)
        candidates = np.vstack([candidates, likeliest])
    divergences = search.measure(candidates, 1, s.search_rollouts)
    if m > 1 and s.n_refinements:
        around = rng.dirichlet(s.concentration * candidates[divergences.argmin()] + 0.1, s.n_refinements)
        divergences = np.append(divergences, search.measure(around, 2, s.search_rollouts))
        candidates = np.vstack([candidates, around])
    return search.best(candidates, divergences, () if incumbent is None else (m,))
