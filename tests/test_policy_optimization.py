import numpy as np
import torch

from dmsrd_lite.networks import GaussianPolicies, to_tensor
from dmsrd_lite.policy_optimization import (
    PolicyOptimizer,
    PPOSettings,
    TrainingSettings,
    clip_gradients,
    clone_behavior,
    generalized_advantages,
    train_policies,
)
from dmsrd_lite.rollouts import rollout


def test_advantages_by_hand():
    rewards, values = np.array([1.0, 2.0, 3.0]), np.array([0.5, 1.0, -1.0, 2.0])
    gamma, lam = 0.9, 0.8
    delta = [rewards[t] + gamma * values[t + 1] - values[t] for t in range(3)]
    by_hand = [delta[0] + gamma * lam * (delta[1] + gamma * lam * delta[2]), delta[1] + gamma * lam * delta[2], delta[2]]
    assert np.allclose(generalized_advantages(rewards, values, gamma, lam), by_hand)


def test_gradients_are_clipped_per_strategy():
    p = torch.nn.Parameter(torch.zeros(2, 3))
    p.grad = torch.tensor([[3.0, 0.0, 4.0], [0.1, 0.0, 0.0]])
    clip_gradients([p], 1.0)
    assert torch.allclose(p.grad, torch.tensor([[0.6, 0.0, 0.8], [0.1, 0.0, 0.0]]))


def test_training_together_equals_training_alone(domain):
    """Strategy 1 of two must come out as if strategy 0 had had other rewards: nothing is shared."""
    results = []
    for factor in (1.0, -5.0):
        policies = GaussianPolicies(domain, 2, 0)
        data = rollout(domain, policies.actor(), 2, 1, horizon=60)
        rewards = data.rewards * np.array([factor, 1.0])[:, None, None]
        PolicyOptimizer(policies, PPOSettings(minibatch=30), 2).update(data, rewards, 3)
        results.append([p.detach().clone() for p in policies.parameters()])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a[1], b[1])
    assert not torch.equal(results[0][0][0], results[1][0][0])


def test_ppo_moves_towards_the_paid_action(domain):
    policies = GaussianPolicies(domain, 1, 0)
    optimizer = PolicyOptimizer(policies, PPOSettings(learning_rate=1e-2, minibatch=100), 0)
    for i in range(15):
        data = rollout(domain, policies.actor(), 4, i, horizon=50)
        optimizer.update(data, -((data.actions[..., 0] - 1.0) ** 2), i)
    mean = policies.actor().mean(data.observations[:, 0]).mean()
    assert abs(mean - 1.0) < 0.5, "paid for actions near 1, the mean must move there"


def test_cloning_recovers_a_linear_gaussian_policy(domain):
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (2, 3000, 4)).astype(np.float32)
    gain, sigma = np.array([0.5, -0.3, 0.2, 0.1]), np.array([0.2, 0.5])[:, None, None]
    actions = x @ gain[:, None] + sigma * rng.standard_normal((2, 3000, 1))
    policies = GaussianPolicies(domain, 2, 1)
    curve = clone_behavior(policies, to_tensor(x), to_tensor(actions), 0, n_steps=1500)
    entropy = 0.5 * np.log(2 * np.pi * np.e * sigma[:, 0, 0] ** 2)  # the best that any policy can reach
    assert np.all(curve[-1] < entropy + 0.15)
    assert np.allclose(policies.actor().sigma, sigma, rtol=0.15)


def test_train_policies_is_deterministic_and_grows_the_horizon(domain):
    settings = TrainingSettings(n_strategies=2, n_iterations=3, episodes=1, first_horizon=20, growing=5.0)
    runs = [list(train_policies(domain, lambda data, seed: data.rewards, settings, 0, n_threads=n)) for n in (1, 2)]
    horizons = [r["horizon"] for r in runs[0]]
    assert horizons == sorted(horizons)
    assert horizons[-1] > horizons[0] == 20
    for a, b in zip(runs[0][-1]["policies"].parameters(), runs[1][-1]["policies"].parameters(), strict=True):
        assert torch.equal(a, b)
