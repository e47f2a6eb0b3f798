import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import AIRL_ONE, MSRD_ONE, same

from dmsrd_lite.domains import InputError
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import airl
from dmsrd_lite.method.airl import AIRL, discriminator_loss
from dmsrd_lite.method.msrd import MSRD
from dmsrd_lite.method.rewards import Rewards

WEIGHTS, PURE = np.array([[1.0, 0.0], [0.0, 1.0], [0.4, 0.6]]), (0, 1)
STATES = np.random.default_rng(0).normal(size=(50, 4))
X = torch.randn(2, 7, 4, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def everyone(small_set):
    """Three demonstrations: the two of ``small_set`` and one between them."""
    between = small_set.observations.mean(0, keepdims=True)
    return small_set.joined(replace(small_set.select([0]), observations=between))


@pytest.fixture
def trained(small_set, everyone):
    """After a tiny run, with a task reward that says something."""
    learner = MSRD(small_set, MSRD_ONE, 0, between=(flat(everyone.observations), WEIGHTS, PURE))
    list(learner.train())
    stir(learner.rewards)
    return learner


def flat(observations):
    """(n, k, T+1, d) -> (n, k (T+1), d)."""
    return observations.reshape(len(observations), -1, observations.shape[-1])


def stir(rewards, seed=0):
    """The output weights of the rewards at random: near zero, much would hold by itself."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for net in (rewards.task_reward, rewards.strategy_reward):
            net.weights[-1].copy_(torch.randn(net.weights[-1].shape, generator=generator))


def one_step(learner):
    """What a gradient step of size 1 subtracts from the rewards' parameters: the gradient of the loss."""
    learner.reward_optimizer = torch.optim.SGD(learner.rewards.parameters(), lr=1.0)
    before = {k: v.clone() for k, v in learner.rewards.state_dict().items()}
    learner._discriminate(7, learner._log_densities())
    return {k: before[k] - v for k, v in learner.rewards.state_dict().items()}


def test_equation_1(trained, small_set):
    rewards, x = trained.rewards, trained.x
    total, task, g = (rewards.evaluate(STATES.reshape(5, 10, 4), part) for part in ("total", "task", "g"))
    assert total.shape == g.shape == (2, 5, 10)
    assert task.shape == (1, 5, 10)
    assert np.allclose(total, task + MSRD_ONE.alpha * g, atol=1e-6)
    assert min(np.abs(task).mean(), np.abs(g).mean(), np.abs(g[0] - g[1]).mean()) > 0.1
    assert max(np.abs(task).max(), np.abs(g).max()) <= Rewards.bound
    f, h = rewards.f(x[:, :-1], x[:, 1:]), rewards.shaping(x)[..., 0]
    by_hand = (rewards.task(x) + 0.3 * rewards.g(x))[:, :-1] + 0.99 * h[:, 1:] - h[:, :-1]
    assert torch.allclose(f, by_hand, atol=1e-5), "f is of the total"
    data = rollout(small_set.domain, trained.policies.actor(), 2, 0, horizon=20)
    paid = rewards.evaluate(data.observations[:, :, 1:], "total")
    assert np.allclose(trained.policy_rewards(data), [paid[0, 0], paid[1, 1]], atol=1e-5), "and the pay is"


def test_the_task_reward_starts_at_zero_and_learns(small_set):
    learner = MSRD(small_set, MSRD_ONE, 0)
    both = learner.rewards, learner.averaged_rewards
    assert not any(rewards.evaluate(STATES, "task").any() for rewards in both)
    assert np.abs(learner.rewards.evaluate(STATES)).min() > 0
    list(learner.train())
    assert all(rewards.evaluate(STATES, "task").any() for rewards in both)


def test_the_task_rewards_gradient_is_the_sum_of_the_strategies_alone(small_set, trained):
    settings, networks = replace(MSRD_ONE, discriminator_steps=1), trained.networks()
    both = MSRD(small_set, settings, 0, networks=networks)
    both.replay.append(trained.replay[0])
    together, alone = one_step(both), []
    for j in range(2):
        own = {k: v if ".task_reward." in k else v[j : j + 1] for k, v in networks.items()}
        learner = MSRD(small_set.select([j]), settings, 0, networks=own)
        learner.replay.append(tuple(part[j : j + 1] for part in trained.replay[0]))
        alone.append(one_step(learner))
    for name, gradient in together.items():
        (a, b), shared = (one[name] for one in alone), name.startswith("task_reward.")
        assert torch.allclose(gradient, a + b if shared else torch.cat([a, b]), atol=1e-5)
        assert not shared or (a - b).abs().max() > 1e-3, "alike gradients would prove nothing"


@pytest.mark.parametrize(("alpha", "relative"), [(0.3, False), (2.0, True)])
def test_regularizer_by_hand(alpha, relative, small_set, everyone):
    """Every demonstration stands still: any draw of its states has the same mean reward."""
    still, places = everyone.observations.copy(), np.random.default_rng(0).normal(0, 0.4, (3, 4))
    still[:] = places[:, None, None]
    settings = replace(MSRD_ONE, alpha=alpha, between_class_weight=7.0, between_class_relative=relative)
    learner = MSRD(small_set, settings, 0, between=(flat(still), WEIGHTS, PURE))
    stir(learner.rewards)
    g = learner.rewards.g(X).detach().numpy()
    absolute = alpha * sum(np.mean([abs(v) for v in g[j]]) for j in range(2))
    eta, between = learner.rewards.evaluate(places), 0.0  # (2 strategies, 3 demonstrations)
    for j in range(2):
        zero = eta[j, PURE[j]] if relative else 0.0
        own = math.exp(eta[j, PURE[j]] - zero)
        between += 7.0 * sum((math.exp(eta[j, i] - zero) - WEIGHTS[i, j] * own) ** 2 for i in range(3))
    rng = np.random.default_rng(0)
    assert learner.regularizer(X, rng).item() == pytest.approx(absolute + between, rel=1e-4)
    assert g.min() < 0 < g.max()
    assert between > 0.1
    learner.between = None
    assert learner.regularizer(X, rng).item() == pytest.approx(absolute, rel=1e-5)


def test_gradient_of_the_whole_loss_by_finite_differences(trained):
    """Discriminator, penalty and between-class discrimination (relative, so that no term is held fixed)."""
    rewards = trained.rewards.double()
    x, x_next = trained.x.double(), trained.x_next.double()
    log_pi = trained.policies.log_density(trained.x, trained.actions).detach().double()
    trained.between = (trained.between[0].double(), trained.between[1].double(), trained.between[2])
    samples, samples_next, density = (part.double() for part in trained.replay[0])

    def loss():
        real, drawn = rewards.f(x, x_next) - log_pi, rewards.f(samples, samples_next) - density
        more = trained.regularizer(samples, np.random.default_rng(0))
        return discriminator_loss(real, drawn).sum() + more

    rewards.zero_grad()
    loss().backward()
    for net in (rewards.task_reward, rewards.strategy_reward, rewards.shaping):
        first, last, bias = net.weights[0], net.weights[-1], net.biases[1]
        for weight, index in ((first, (0, 1, 2)), (last, (-1, 5, 0)), (bias, (-1, 0, 3))):
            with torch.no_grad():
                weight[index] += 1e-6
                up = loss().item()
                weight[index] -= 2e-6
                down = loss().item()
                weight[index] += 1e-6
            numeric = (up - down) / 2e-6
            assert weight.grad[index].item() == pytest.approx(numeric, rel=1e-4, abs=1e-7)
            assert abs(numeric) > 1e-6


def test_between_class_discrimination_reaches_the_strategy_rewards_only(small_set, everyone, trained):
    """The gradient with and without it: the task reward and the shaping terms feel nothing of it."""
    settings, steps = replace(MSRD_ONE, discriminator_steps=1), []
    for between in (None, (flat(everyone.observations), WEIGHTS, PURE)):
        learner = MSRD(small_set, settings, 0, networks=trained.networks(), between=between)
        learner.replay.append(trained.replay[0])
        steps.append(one_step(learner))
    for name in steps[0]:
        assert torch.equal(steps[0][name], steps[1][name]) == (not name.startswith("strategy_reward.")), name


def test_networks_go_from_one_learner_to_the_next(small_set, trained):
    networks = trained.networks()
    again = MSRD(small_set, MSRD_ONE, 99, networks=networks)
    parts = {"policies", "values", "rewards", "averaged", "coverage"}
    assert {name.split(".")[0] for name in networks} == parts
    given = again.networks()
    list(again.train())
    assert again.steps == 2 * 50, "it goes on with the coverage that was handed over"
    assert same(networks, trained.networks()), "what was handed over is a copy"
    assert same(given, networks), "and so is this"
    assert not same(again.networks(), networks)


def test_settling_is_so_many_updates_of_the_strategy_rewards_alone(small_set, everyone, monkeypatch):
    settings = replace(MSRD_ONE, between_class_extra=3)
    for between, updates in (((flat(everyone.observations), WEIGHTS, PURE), 3), (None, 0)):
        learner = MSRD(small_set, settings, 0, between=between)
        list(learner.train())
        before, steps = learner.networks(), learner.steps
        with monkeypatch.context() as patch:
            patch.setattr(airl, "rollout", None)  # nothing is simulated
            learner.settle()
        assert learner.n_averaged == 2 + updates
        assert learner.steps == steps
        after = learner.networks()
        assert same(after, before) == (updates == 0)
        for name, tensor in after.items():
            if name.startswith(("policies.", "values.", "coverage.", "rewards.task_reward.")):
                assert torch.equal(tensor, before[name]), name
        assert all(p.requires_grad for p in learner.rewards.parameters()), "R_Task rested only meanwhile"


@pytest.mark.parametrize("alpha", [0.0, -0.1, float("nan")])
def test_alpha_must_be_positive(alpha, small_set):
    with pytest.raises(InputError, match=f"^alpha {alpha}: expected a positive weight of the strategy rew"):
        MSRD(small_set, replace(MSRD_ONE, alpha=alpha), 0)


def test_a_shared_task_reward_is_added_and_stays_frozen(small_set, trained):
    shared, domain = trained.rewards, small_set.domain
    task = {k: v.clone() for k, v in shared.task_reward.state_dict().items()}
    assert not any("task_reward" in name for name in AIRL(small_set, AIRL_ONE, 0).networks()), "none shared"
    learner = AIRL(small_set.select([1]), AIRL_ONE, 5, shared=shared)
    untrained = learner.rewards.evaluate(STATES)
    list(learner.train())
    for rewards in (learner.rewards, learner.averaged_rewards, shared):
        assert same(dict(rewards.task_reward.state_dict()), task)
    g, total = learner.rewards.evaluate(STATES), learner.rewards.evaluate(STATES, "total")
    assert not np.allclose(g, untrained), "the strategy reward must have moved, or this test says nothing"
    assert np.allclose(total, shared.evaluate(STATES, "task") + 0.3 * g, atol=1e-5)
    data = rollout(domain, learner.policies.actor(), 1, 0, horizon=20)
    paid = learner.rewards.evaluate(data.observations[:, :, 1:], "total")[0]
    assert np.allclose(learner.policy_rewards(data), paid, atol=1e-5)


@pytest.mark.parametrize("decay", [0.9, 0.0])
def test_the_average_of_the_rewards_goes_on(decay, small_set):
    """It is ``a <- d a + (1 - d) r`` with d = min(decay, n / (n + 3)) for n rewards averaged before."""
    learner = MSRD(small_set, replace(MSRD_ONE, n_iterations=4, reward_average=decay), 0)
    learner.n_averaged = 25
    mean, last = (r.task_reward.weights[-1] for r in (learner.averaged_rewards, learner.rewards))
    by_hand = mean.detach().clone()
    for n, _ in enumerate(learner.train(), 25):
        d = min(decay, n / (n + 3))
        by_hand = d * by_hand + (1 - d) * last.detach()
    assert torch.allclose(mean, by_hand, atol=1e-6)
    assert torch.equal(mean, last) == (decay == 0)
    assert learner.n_averaged == 29
