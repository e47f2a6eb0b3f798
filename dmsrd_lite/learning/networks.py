"""Small networks for many strategies at once: every weight has a leading strategy axis."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from threadpoolctl import ThreadpoolController

from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Seed

LOG_2PI = math.log(2 * math.pi)
SIGMA_FLOOR = 0.02  # action units: no policy gets narrower, and no likelihood is counted with less


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch and NumPy on one thread: faster for small networks, and the bits do not depend on the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _blas().limit(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


class BatchedMLP(torch.nn.Module):
    """M networks side by side: ``y[j] = W3[j] tanh(W2[j] tanh(W1[j] x[j] + b1[j]) + b2[j]) + b3[j]``.

    Input (M, n, n_in), output (M, n, n_out). Orthogonal start; ``last_gain`` scales the last layer.
    """

    def __init__(self, n_strategies: int, sizes: tuple[int, ...], seed: Seed, last_gain: float = 1.0):
        super().__init__()
        rng = np.random.default_rng(seed)
        self.weights, self.biases = torch.nn.ParameterList(), torch.nn.ParameterList()
        for layer, (n_in, n_out) in enumerate(pairwise(sizes)):
            gain = last_gain if layer == len(sizes) - 2 else math.sqrt(2)
            q = np.linalg.qr(rng.standard_normal((n_strategies, max(n_in, n_out), min(n_in, n_out))))[0]
            q = q if n_in >= n_out else q.transpose(0, 2, 1)
            self.weights.append(torch.nn.Parameter(torch.tensor(gain * q, dtype=torch.float32).contiguous()))
            self.biases.append(torch.nn.Parameter(torch.zeros(n_strategies, 1, n_out)))

    @property
    def n_strategies(self) -> int:
        return self.weights[0].shape[0]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        *hidden, (last_weight, last_bias) = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:  # slices of a ParameterList would be new modules, which takes longer
            x = torch.tanh(torch.baddbmm(bias, x, weight))
        return torch.baddbmm(last_bias, x, last_weight)


def gaussian_log_density(actions: Any, mean: Any, sigma: Any) -> Any:
    """``log N(a | mu, sigma^2)`` summed over the last axis; NumPy arrays or tensors, in nats."""
    log = torch.log if isinstance(sigma, torch.Tensor) else np.log
    return (-0.5 * (((actions - mean) / sigma) ** 2 + LOG_2PI) - log(sigma)).sum(-1)


class GaussianPolicies(torch.nn.Module):
    """M policies ``pi_j(a|s) = N(mu_j(s), sigma_j^2)``, ``mu_j`` an MLP (32, 32), ``sigma_j`` learned and
    state-free.

    Means and sigmas are in the action's own units.
    """

    def __init__(self, domain: Domain, n_strategies: int, seed: Seed, sigma: float = 0.2):
        super().__init__()
        self.domain = domain
        self.network = BatchedMLP(
            n_strategies, (domain.obs_dim, 32, 32, domain.action_dim), seed, last_gain=0.01
        )
        log_sigma = torch.tensor(np.log(sigma * domain.half_range), dtype=torch.float32)
        self.log_sigma = torch.nn.Parameter(log_sigma.repeat(n_strategies, 1, 1))

    @property
    def n_strategies(self) -> int:
        return self.network.n_strategies

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Network inputs (M, n, obs_dim) -> means (M, n, action_dim), sigmas (M, 1, action_dim)."""
        return self.network(x), self.log_sigma.exp()

    def log_density(self, x: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """``log pi_j(a|s)``: x (M, n, obs_dim), actions (M, n, action_dim) -> (M, n) in nats."""
        return gaussian_log_density(actions, *self(x))

    def actor(self) -> "Actor":
        """A frozen copy to act with."""
        weights = [p.detach().numpy().copy() for p in self.network.weights]
        biases = [p.detach().numpy().copy() for p in self.network.biases]
        return Actor(self.domain, weights, biases, self.log_sigma.detach().exp().numpy())


class Policies:
    """M Gaussian policies in NumPy, to act with: far less overhead per simulator step than a tensor library.

    ``sigma`` (M, 1, action_dim) in the action's own units, and ``mean``.
    """

    sigma: np.ndarray

    @property
    def n_strategies(self) -> int:
        return len(self.sigma)

    def mean(self, observations: np.ndarray) -> np.ndarray:
        """Observations (M, E, obs_dim) -> (M, E, action_dim)."""
        raise NotImplementedError

    def log_density(
        self, observations: np.ndarray, actions: np.ndarray, sigma_floor: float = 0.0
    ) -> np.ndarray:
        """``log pi_j(a|s)``: (M, n, obs_dim), (M, n, action_dim) -> (M, n); sigma >= ``sigma_floor``."""
        return gaussian_log_density(actions, self.mean(observations), np.maximum(self.sigma, sigma_floor))


class Actor(Policies):
    """A frozen copy of ``GaussianPolicies``."""

    def __init__(
        self, domain: Domain, weights: list[np.ndarray], biases: list[np.ndarray], sigma: np.ndarray
    ):
        self.domain, self.weights, self.biases, self.sigma = domain, weights, biases, sigma

    @classmethod
    def joined(cls, actors: "list[Actor]") -> "Actor":
        """All policies of several actors as one."""
        weights = [np.concatenate(layer) for layer in zip(*(a.weights for a in actors), strict=True)]
        biases = [np.concatenate(layer) for layer in zip(*(a.biases for a in actors), strict=True)]
        return cls(actors[0].domain, weights, biases, np.concatenate([a.sigma for a in actors]))

    def arrays(self) -> dict[str, np.ndarray]:
        """All that makes these policies, by name, for a file."""
        layers = {"weights": self.weights, "biases": self.biases}
        found = {f"{part}.{i}": array for part, arrays in layers.items() for i, array in enumerate(arrays)}
        return {**found, "sigma": self.sigma}

    @classmethod
    def from_arrays(cls, domain: Domain, arrays: dict[str, np.ndarray]) -> "Actor":
        """The policies that ``arrays`` names."""
        n_layers = len(arrays) // 2
        weights, biases = ([arrays[f"{part}.{i}"] for i in range(n_layers)] for part in ("weights", "biases"))
        return cls(domain, weights, biases, arrays["sigma"])

    def mean(self, observations: np.ndarray) -> np.ndarray:
        x = self.domain.network_input(observations)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.tanh(x @ weight + bias)
        return x @ self.weights[-1] + self.biases[-1]

    def select(self, indices: Sequence[int] | np.ndarray, sigma_factor: float = 1.0) -> "Actor":
        """The policies ``indices`` (repeats allowed), with every sigma times ``sigma_factor``."""
        pick = np.asarray(indices)
        sigma = self.sigma[pick] * np.float32(sigma_factor)
        return Actor(self.domain, [w[pick] for w in self.weights], [b[pick] for b in self.biases], sigma)

    def disturbed(self, noise: float, drift: float, rng: np.random.Generator) -> "Actor":
        """Worse policies: sigmas times ``noise``; ``drift * N(0, 1)`` half ranges added to the actions."""
        worse = self.select(range(self.n_strategies), noise)
        drawn = drift * self.domain.half_range * rng.standard_normal(worse.biases[-1].shape)
        moved = worse.biases[-1] + drawn.astype(np.float32)
        return Actor(self.domain, worse.weights, [*worse.biases[:-1], moved], worse.sigma)


def under(name: str, tensors: dict) -> dict:
    """The entries of ``tensors`` whose names start with ``name.``, without that prefix."""
    return {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}


def to_tensor(x: np.ndarray) -> torch.Tensor:
    """A float32 tensor with its own contiguous memory."""
    return torch.from_numpy(np.ascontiguousarray(x, dtype=np.float32))
