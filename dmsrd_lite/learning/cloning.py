"""Behavioural cloning: the plainest way to learn from a demonstration."""

import math

import numpy as np
import torch

from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import SIGMA_FLOOR, GaussianPolicies, one_thread

MINIBATCH, RATE = 256, 3e-3  # samples of every strategy in a step; the largest learning rate


@one_thread()
def clone_behavior(
    policies: GaussianPolicies, x: torch.Tensor, actions: torch.Tensor, seed: Seed, n_steps: int
) -> None:
    """Behavioural cloning in place: minimise ``E_demo[-log pi_j(a|s)]`` for every strategy at once.

    x (M, n, obs_dim) network inputs, actions (M, n, action_dim) executed.
    """
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(policies.parameters(), lr=RATE, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=n_steps)
    for _ in range(n_steps):
        pick = torch.from_numpy(rng.integers(0, x.shape[1], MINIBATCH))
        loss = -policies.log_density(x[:, pick], actions[:, pick]).mean(1).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            policies.log_sigma.clamp_(min=math.log(SIGMA_FLOOR))
