import numpy as np
import pytest
import torch

from dmsrd_lite.learning import policy_optimization as po
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout


def test_advantages_by_hand():
    rewards, values = np.array([1.0, 2.0, 3.0]), np.array([0.5, 1.0, -1.0, 2.0])
    gamma, lam = 0.9, 0.8
    delta = [rewards[t] + gamma * values[t + 1] - values[t] for t in range(3)]
    last_two = [delta[1] + gamma * lam * delta[2], delta[2]]
    by_hand = [delta[0] + gamma * lam * last_two[0], *last_two]
    assert np.allclose(po.generalized_advantages(rewards, values, gamma, lam), by_hand)


def test_gradients_are_clipped_per_strategy():
    p = torch.nn.Parameter(torch.zeros(2, 3))
    p.grad = torch.tensor([[3.0, 0.0, 4.0], [0.1, 0.0, 0.0]])
    po.clip_gradients([p], 1.0)
    assert torch.allclose(p.grad, torch.tensor([[0.6, 0.0, 0.8], [0.1, 0.0, 0.0]]))


def test_training_together_equals_training_alone(domain):
    """Strategy 1 of two must come out as if strategy 0 had had other rewards: nothing is shared."""
    results = []
    for factor in (1.0, -5.0):
        policies = GaussianPolicies(domain, 2, 0)
        data = rollout(domain, policies.actor(), 2, 1, horizon=60)
        rewards = data.rewards * np.array([factor, 1.0])[:, None, None]
        po.PolicyOptimizer(policies, po.PPOSettings(minibatch=30), 2).update(data, rewards, 3)
        results.append([p.detach().clone() for p in policies.parameters()])
    assert all(torch.equal(a[1], b[1]) for a, b in zip(*results, strict=True))
    assert not torch.equal(results[0][0][0], results[1][0][0])


def test_ppo_moves_towards_the_paid_action(domain):
    policies = GaussianPolicies(domain, 1, 0)
    optimizer = po.PolicyOptimizer(policies, po.PPOSettings(learning_rate=1e-2, minibatch=100), 0)
    for i in range(15):
        data = rollout(domain, policies.actor(), 4, i, horizon=50)
        optimizer.update(data, -((data.actions[..., 0] - 1.0) ** 2), i)
    mean = policies.actor().mean(data.observations[:, 0]).mean()
    assert abs(mean - 1.0) < 0.5, "paid for actions near 1, the mean must move there"


def test_a_schedule_by_hand(domain):
    settings = po.TrainingSettings(1, last_sigma=0.05, last_rate=0.1, last_discount=0.9999)
    policies = GaussianPolicies(domain, 1, 0, sigma=1.0)
    optimizer = po.PolicyOptimizer(policies, settings.ppo, 0)
    for share, sigma in ((0.4, 1.0), (0.65, 0.05**0.5), (1.0, 0.05)):
        po.anneal(policies, optimizer, settings, share)
        assert policies.actor().sigma[0, 0, 0] == pytest.approx(sigma)
        assert optimizer.settings.discount == pytest.approx(1 - 0.01 ** (1 + share))
        assert optimizer.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 * (1 - 0.9 * share))


def test_train_policies_is_deterministic_and_grows_the_horizon(domain):
    ppo = po.PPOSettings(minibatch=50)
    settings = po.TrainingSettings(2, n_iterations=3, episodes=1, first_horizon=20, growing=5.0, ppo=ppo)
    domains = domain.on_threads(1), domain.on_threads(2)
    one, two = (list(po.train_policies(d, lambda data, seed: data.rewards, settings, 0)) for d in domains)
    horizons = [r["horizon"] for r in one]
    assert horizons == sorted(horizons)
    assert horizons[-1] > horizons[0] == 20
    assert one[0]["steps"] == 2 * 4 * 20, "four times as many episodes while they are short"
    for a, b in zip(one[-1]["policies"].parameters(), two[-1]["policies"].parameters(), strict=True):
        assert torch.equal(a, b)
