import numpy as np

from dmsrd_lite.learning.cloning import clone_behavior
from dmsrd_lite.learning.networks import SIGMA_FLOOR, GaussianPolicies, to_tensor


def test_cloning_recovers_a_linear_gaussian_policy(domain):
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (2, 2000, 4)).astype(np.float32)
    gain, sigma = np.array([0.5, -0.3, 0.2, 0.1]), np.array([0.2, 0.5])[:, None, None]
    actions = x @ gain[:, None] + sigma * rng.standard_normal((2, 2000, 1))
    policies = GaussianPolicies(domain, 2, 1)
    clone_behavior(policies, to_tensor(x), to_tensor(actions), 0, n_steps=800)
    loss = -policies.log_density(to_tensor(x), to_tensor(actions)).mean(1).detach().numpy()
    entropy = 0.5 * np.log(2 * np.pi * np.e * sigma[:, 0, 0] ** 2)  # the best that any policy can reach
    assert np.all(loss < entropy + 0.05)
    assert np.allclose(policies.actor().sigma, sigma, rtol=0.15)


def test_no_policy_gets_narrower_than_the_floor(domain):
    policies = GaussianPolicies(domain, 1, 0, sigma=0.021 / 3)
    x = np.random.default_rng(0).uniform(-1, 1, (1, 100, 4)).astype(np.float32)
    clone_behavior(policies, to_tensor(x), to_tensor(np.zeros((1, 100, 1))), 0, n_steps=400)
    assert policies.actor().sigma == np.float32(SIGMA_FLOOR)
