import numpy as np
import torch
from scipy.stats import norm
from threadpoolctl import threadpool_info

from dmsrd_lite.learning import networks
from dmsrd_lite.learning.networks import Actor, BatchedMLP, GaussianPolicies, to_tensor


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
    policies, rng = GaussianPolicies(domain, 2, 0), np.random.default_rng(0)
    states, actions = rng.normal(0, 0.5, (2, 6, 4)), rng.uniform(-3, 3, (2, 6, 1))
    actor = policies.actor()
    truth, wide = (norm.logpdf(actions, actor.mean(states), s)[..., 0] for s in (actor.sigma, 2.0))
    assert np.allclose(actor.log_density(states, actions), truth, rtol=1e-5)
    assert np.allclose(actor.log_density(states, actions, sigma_floor=2.0), wide, rtol=1e-5)
    tensor = policies.log_density(to_tensor(domain.network_input(states)), to_tensor(actions))
    assert np.allclose(tensor.detach().numpy(), truth, rtol=1e-4)


def test_actors_are_selected_widened_disturbed_and_joined(domain):
    actor, x = GaussianPolicies(domain, 3, 0).actor(), np.random.default_rng(0).normal(size=(3, 5, 4))
    wide = actor.select([2, 2], 3.0)
    assert np.allclose(wide.mean(x[[0, 0]])[0], actor.mean(x[[0, 0, 0]])[2])
    assert np.allclose(wide.sigma, 3 * actor.sigma[[2, 2]])
    worse = actor.disturbed(10.0, 2.0, np.random.default_rng(0))
    drift = 2.0 * domain.half_range * np.random.default_rng(0).standard_normal((3, 1, 1))
    assert np.allclose(worse.mean(x) - actor.mean(x), drift, atol=1e-5)
    assert np.allclose(worse.sigma, 10 * actor.sigma)
    both = Actor.joined([actor.select([0]), actor.select([1, 2])])
    assert np.array_equal(both.mean(x), actor.mean(x))


def test_one_thread_within_and_as_before_after():
    before = torch.get_num_threads()
    with networks.one_thread():
        assert torch.get_num_threads() == 1
        assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
    assert torch.get_num_threads() == before


def test_names_under_a_prefix():
    assert networks.under("a", {"a.x": 1, "a.b.x": 2, "ab.x": 3, "b.a.x": 4}) == {"x": 1, "b.x": 2}
