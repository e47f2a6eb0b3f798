import numpy as np
import torch
from scipy.stats import norm

from dmsrd_lite.networks import Actor, BatchedMLP, GaussianPolicies, to_tensor


def test_batched_network_equals_each_network_alone():
    network = BatchedMLP(3, (4, 32, 32, 2), 0)
    x = torch.randn(3, 7, 4, generator=torch.Generator().manual_seed(0))
    for j in range(3):
        y = x[j]
        for layer, (w, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            y = y @ w[j] + b[j]
            y = torch.tanh(y) if layer < 2 else y
        assert torch.allclose(network(x)[j], y, atol=1e-6)


def test_log_density_is_the_normal_density(domain):
    policies = GaussianPolicies(domain, 2, 0)
    rng = np.random.default_rng(0)
    states, actions = rng.normal(0, 0.5, (2, 6, 4)), rng.uniform(-3, 3, (2, 6, 1))
    actor = policies.actor()
    truth = norm.logpdf(actions, actor.mean(states), actor.sigma)[..., 0]
    assert np.allclose(actor.log_density(states, actions), truth, rtol=1e-5)
    tensor = policies.log_density(to_tensor(domain.network_input(states)), to_tensor(actions))
    assert np.allclose(tensor.detach().numpy(), truth, rtol=1e-4)


def test_actor_select_repeats_and_widens(domain):
    actor = GaussianPolicies(domain, 3, 0).actor()
    wide = actor.select([2, 2], 3.0)
    x = np.random.default_rng(0).normal(size=(1, 5, 4))
    assert np.allclose(wide.mean(np.repeat(x, 2, 0))[0], actor.mean(np.repeat(x, 3, 0))[2])
    assert np.allclose(wide.sigma, 3 * actor.sigma[[2, 2]])


def test_joined_actors_act_as_each(domain):
    actors = [GaussianPolicies(domain, n, n).actor() for n in (1, 2)]
    x = np.random.default_rng(0).normal(size=(3, 5, 4))
    both = Actor.joined(actors)
    assert np.array_equal(both.mean(x), np.concatenate([actors[0].mean(x[:1]), actors[1].mean(x[1:])]))
    assert both.n_strategies == 3


def test_network_input_is_clipped_and_scaled(domain):
    x = domain.network_input(np.array([[100.0, -100.0, 2.0, 4.0]]))
    assert np.allclose(x, [[2.0, -2.0, 1.0, 1.0]])
