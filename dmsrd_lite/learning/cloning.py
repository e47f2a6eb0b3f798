"""Behavioural cloning: the plainest way to learn from a demonstration."""

import math
from collections.abc import Callable

import numpy as np
import torch

from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import SIGMA_FLOOR, GaussianPolicies, one_thread


@one_thread()
def clone_behavior(
    policies: GaussianPolicies,
    x: torch.Tensor,
    actions: torch.Tensor,
    seed: Seed,
    *,
    n_steps: int = 2000,
    minibatch: int = 256,
    learning_rate: float = 3e-3,
    progress: Callable = iter,
) -> np.ndarray:
    """Behavioural cloning in place: minimise ``E_demo[-log pi_j(a|s)]`` for every strategy at once.

    x (M, n, obs_dim) network inputs, actions (M, n, action_dim) executed. Returns the loss every 50 steps,
    (k, M) nats. ``progress`` wraps the range of steps (``tqdm`` for a bar).
    """
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(policies.parameters(), lr=learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=n_steps)
    curve = []
    for step in progress(range(n_steps)):
        pick = torch.from_numpy(rng.integers(0, x.shape[1], minibatch))
        loss = -policies.log_density(x[:, pick], actions[:, pick]).mean(1)
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            policies.log_sigma.clamp_(min=math.log(SIGMA_FLOOR))
        if step % 50 == 0:
            curve.append(loss.detach().numpy().copy())
    return np.array(curve)
