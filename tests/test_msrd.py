import dataclasses
import math

import numpy as np
import pytest
import torch
from test_mixture import balancers, shown_by

from dmsrd_lite import airl
from dmsrd_lite.airl import AIRL, AIRLSettings, Rewards, discriminator_loss
from dmsrd_lite.envs import InputError
from dmsrd_lite.msrd import MSRD, MSRDSettings
from dmsrd_lite.networks import to_tensor
from dmsrd_lite.policy_optimization import PPOSettings
from dmsrd_lite.rollouts import rollout

TINY = MSRDSettings(n_iterations=2, episodes=1, cloning_steps=60, coverage_episodes=1, coverage_levels=((1, 0), (3, 0)),
                    discriminator_steps=2,
                    discriminator_batch=16, replay_samples=30, ppo=PPOSettings(minibatch=25), between_class_batch=16)  # fmt: skip
WEIGHTS, PURE = np.array([[1.0, 0.0], [0.0, 1.0], [0.4, 0.6]]), (0, 1)


@pytest.fixture
def everyone(small_set):
    """Three demonstrations: the two of ``small_set`` and one between them."""
    return small_set.joined(dataclasses.replace(small_set.select([0]), observations=small_set.observations.mean(0, keepdims=True)))


@pytest.fixture
def trained(small_set, everyone):
    """After a tiny run, with a task reward that says something."""
    learner = MSRD(small_set, TINY, 0, between=(everyone, WEIGHTS, PURE))
    list(learner.train())
    stir(learner.rewards)
    return learner


def stir(rewards, seed=0):
    """The output weights of the rewards at random: where they are still near zero, much would hold by itself."""
    with torch.no_grad():
        for i, net in enumerate((rewards.task_reward, rewards.strategy_reward)):
            net.weights[-1].copy_(torch.randn(net.weights[-1].shape, generator=torch.Generator().manual_seed(2 * seed + i)))


def same(a: dict, b: dict):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def test_equation_1(trained):
    states = np.random.default_rng(0).normal(size=(3, 5, 4))
    total, task, g = (trained.rewards.evaluate(states, part) for part in ("total", "task", "g"))
    assert total.shape == g.shape == (2, 3, 5)
    assert task.shape == (1, 3, 5)
    assert np.allclose(total, task + TINY.alpha * g, atol=1e-6)
    assert min(np.abs(task).mean(), np.abs(g).mean(), np.abs(g[0] - g[1]).mean()) > 0.1
    assert max(np.abs(task).max(), np.abs(g).max()) <= Rewards.bound


def test_f_and_the_policys_pay_are_of_the_total(trained, small_set):
    rewards, x = trained.rewards, trained.x
    f = rewards.f(x[:, :-1], x[:, 1:]).detach()
    h = rewards.shaping(x)[..., 0].detach()
    by_hand = rewards.task(x) + 0.3 * rewards.g(x)
    assert torch.allclose(f, (by_hand[:, :-1] + 0.99 * h[:, 1:] - h[:, :-1]).detach(), atol=1e-5)
    data = rollout(small_set.domain, trained.policies.actor(), 2, 0, horizon=20)
    paid = rewards.evaluate(data.observations[:, :, 1:], "total")
    assert np.allclose(trained.policy_rewards(data), [paid[0, 0], paid[1, 1]], atol=1e-5)


def test_the_task_reward_starts_at_zero_and_learns(small_set):
    states = np.random.default_rng(0).normal(size=(50, 4))
    learner = MSRD(small_set, TINY, 0)
    assert not learner.rewards.evaluate(states, "task").any()
    assert not learner.averaged_rewards.evaluate(states, "task").any()
    assert np.abs(learner.rewards.evaluate(states)).min() > 0
    list(learner.train())
    assert np.abs(learner.rewards.evaluate(states, "task")).max() > 0
    assert np.abs(learner.averaged_rewards.evaluate(states, "task")).max() > 0


def one_step(learner):
    """What a gradient step of size 1 subtracts from the rewards' parameters: the gradient of the loss."""
    learner.reward_optimizer = torch.optim.SGD(learner.rewards.parameters(), lr=1.0)
    before = {k: v.clone() for k, v in learner.rewards.state_dict().items()}
    learner._discriminate(7)
    return {k: before[k] - v for k, v in learner.rewards.state_dict().items()}


def test_the_task_rewards_gradient_is_the_sum_of_the_strategies_alone(small_set, trained):
    settings = dataclasses.replace(TINY, discriminator_steps=1)
    networks = trained.networks()
    both = MSRD(small_set, settings, 0, networks=networks)
    both.replay.append(trained.replay[0])
    together, alone = one_step(both), []
    for j in range(2):
        own = {k: v if ".task_reward." in k else v[j : j + 1] for k, v in networks.items()}
        learner = MSRD(small_set.select([j]), settings, 0, networks=own)
        learner.replay.append(tuple(part[j : j + 1] for part in trained.replay[0]))
        alone.append(one_step(learner))
    for name, gradient in together.items():
        if name.startswith("task_reward."):
            assert torch.allclose(gradient, alone[0][name] + alone[1][name], atol=1e-5)
            assert (alone[0][name] - alone[1][name]).abs().max() > 1e-3, "alike gradients would prove nothing"
        else:
            assert torch.allclose(gradient, torch.cat([a[name] for a in alone]), atol=1e-5)


def test_regularizer_is_alpha_times_the_mean_absolute_strategy_reward(small_set):
    x = torch.randn(2, 7, 4, generator=torch.Generator().manual_seed(0))
    for alpha in (0.3, 2.0):
        learner = MSRD(small_set, dataclasses.replace(TINY, alpha=alpha), 0)
        stir(learner.rewards)
        g = learner.rewards.g(x).detach().numpy()
        by_hand = alpha * sum(np.mean([abs(v) for v in g[j]]) for j in range(2))
        assert learner.regularizer(x, np.random.default_rng(0)).item() == pytest.approx(by_hand, rel=1e-5)
        assert g.min() < 0 < g.max()


@pytest.mark.parametrize("count_from_own", [False, True])
def test_regularizer_with_between_class_discrimination_by_hand(count_from_own, small_set, everyone):
    """Every demonstration stands still at a state of its own, so that any draw of its states has the same mean reward."""
    still = everyone.observations.copy()
    still[:] = np.array([[0.1, 0.2, 0.3, 0.4], [-0.5, 0.1, 0.2, 0.0], [0.3, -0.3, 0.1, 0.9]])[:, None, None]
    still = dataclasses.replace(everyone, observations=still)
    settings = dataclasses.replace(TINY, between_class_weight=7.0, between_class_relative=count_from_own)
    learner = MSRD(small_set, settings, 0, between=(still, WEIGHTS, PURE))
    stir(learner.rewards)
    x = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0))
    eta = learner.rewards.evaluate(still.observations[:, 0, 0])  # (2 strategies, 3 demonstrations)
    by_hand = 0.0
    for j in range(2):
        zero = eta[j, PURE[j]] if count_from_own else 0.0
        for i in range(3):
            by_hand += 7.0 * (math.exp(eta[j, i] - zero) - WEIGHTS[i, j] * math.exp(eta[j, PURE[j]] - zero)) ** 2
    absolute = 0.3 * learner.rewards.g(x).abs().mean(1).sum().item()
    assert learner.regularizer(x, np.random.default_rng(0)).item() == pytest.approx(absolute + by_hand, rel=1e-4)
    assert by_hand > 0.1


def test_gradient_of_the_whole_loss_by_finite_differences(trained):
    """Discriminator, penalty and between-class discrimination (centred, so that no term is held fixed) in float64."""
    rewards = trained.rewards.double()
    x, x_next, actions = trained.x.double(), trained.x_next.double(), trained.actions
    log_pi = trained.policies.log_density(trained.x, actions).detach().double()
    trained.between = (trained.between[0].double(), trained.between[1].double(), trained.between[2])
    samples, samples_next, density = (part.double() for part in trained.replay[0])

    def loss():
        real, drawn = rewards.f(x, x_next) - log_pi, rewards.f(samples, samples_next) - density
        return discriminator_loss(real, drawn).sum() + trained.regularizer(samples, np.random.default_rng(0))

    rewards.zero_grad()
    loss().backward()
    for net in (rewards.task_reward, rewards.strategy_reward, rewards.shaping):
        for weight, index in ((net.weights[0], (0, 1, 2)), (net.weights[-1], (-1, 5, 0)), (net.biases[1], (-1, 0, 3))):
            with torch.no_grad():
                weight[index] += 1e-6
                up = loss().item()
                weight[index] -= 2e-6
                down = loss().item()
                weight[index] += 1e-6
            numeric = (up - down) / 2e-6
            assert weight.grad[index].item() == pytest.approx(numeric, rel=1e-4, abs=1e-7)
            assert abs(numeric) > 1e-6


def test_between_class_discrimination_reaches_the_strategy_rewards_only(small_set, everyone):
    """The first gradient step with and without it: the task reward and the shaping terms feel nothing of it."""
    settings = dataclasses.replace(TINY, discriminator_steps=1, n_iterations=1)
    plain = MSRD(small_set, settings, 0)
    list(plain.train())
    networks = plain.networks()
    steps = []
    for between in (None, (everyone, WEIGHTS, PURE)):
        learner = MSRD(small_set, settings, 0, networks=networks, between=between)
        learner.replay.append(plain.replay[0])
        steps.append(one_step(learner))
    for name in steps[0]:
        assert torch.equal(steps[0][name], steps[1][name]) == (not name.startswith("strategy_reward.")), name


def test_a_tiny_run_is_deterministic_for_any_number_of_threads(small_set, everyone):
    runs = []
    for n_threads in (1, 2):
        learner = MSRD(small_set, TINY, 3, n_threads, between=(everyone, WEIGHTS, PURE))
        records = list(learner.train())
        runs.append(learner.networks())
    assert [r["steps"] for r in records] == [150 + 50, 150 + 100]
    assert all(np.isfinite(r["discriminator_loss"]).all() and r["accuracy"].shape == (2,) for r in records)
    assert same(*runs)


def test_stopping_and_going_on_equals_one_run(small_set, everyone):
    straight, broken = (MSRD(small_set, TINY, 0, between=(everyone, WEIGHTS, PURE)) for _ in range(2))
    list(straight.train())
    next(broken.train())
    halfway = broken.networks()
    kept = {name: tensor.clone() for name, tensor in halfway.items()}
    assert [r["iteration"] for r in broken.train()] == [1]
    assert same(halfway, kept), "networks() gives copies"
    assert same(straight.networks(), broken.networks())


def test_networks_go_from_one_learner_to_the_next(small_set, trained):
    networks = trained.networks()
    again = MSRD(small_set, TINY, 99, networks=networks)
    assert same(again.networks(), networks)
    states = np.random.default_rng(0).normal(size=(2, 5, 4))
    assert np.array_equal(again.policies.actor().mean(states), trained.policies.actor().mean(states))
    assert np.array_equal(again.policies.actor().sigma, trained.policies.actor().sigma)
    for name in ("rewards", "averaged_rewards"):
        assert np.array_equal(getattr(again, name).evaluate(states, "total"), getattr(trained, name).evaluate(states, "total"))
    x = torch.randn(2, 5, 4)
    assert torch.equal(again.optimizer.values(x), trained.optimizer.values(x))
    list(again.train())
    assert again.steps == 2 * 50, "it goes on with the coverage that was handed over"
    assert same(networks, trained.networks()), "what was handed over is a copy"
    assert not same(again.networks(), networks)


def test_recognition_is_of_the_averaged_rewards_among_all(small_set, everyone):
    learner = MSRD(small_set, TINY, 0, between=(everyone, WEIGHTS, PURE))
    answers = []
    for seed in range(6):  # many random rewards, so that both answers come up
        stir(learner.averaged_rewards, seed)
        means = learner.averaged_rewards.evaluate(everyone.observations[:, :, :-1]).mean((2, 3))
        by_hand = [all(means[j, PURE[j]] >= means[j, i] for i in range(3)) for j in range(2)]
        assert learner.recognized().tolist() == by_hand
        answers += by_hand
    assert set(answers) == {True, False}


def test_settling_updates_rewards_until_all_are_recognized(monkeypatch):
    shown = shown_by(balancers([-0.4, 0.4]), 50)
    settings = dataclasses.replace(TINY, discriminator_steps=4, reward_average=0.5)
    learner = MSRD(shown, settings, 0, between=(shown, np.eye(2), PURE))
    list(learner.train())
    with torch.no_grad():  # unlearn: each strategy reward with the other's sign
        for rewards in (learner.rewards, learner.averaged_rewards):
            rewards.strategy_reward.weights[-1].mul_(-1)
    assert not learner.recognized().all()
    before, steps = learner.networks(), learner.steps
    monkeypatch.setattr(airl, "rollout", None)  # nothing is simulated
    updates = learner.settle()
    assert 0 < updates < settings.between_class_extra
    assert learner.recognized().all()
    assert learner.n_averaged == settings.n_iterations + updates
    assert learner.steps == steps
    for name, tensor in learner.networks().items():
        if name.startswith(("policies.", "values.", "coverage.")) or ".task_reward." in name:
            assert torch.equal(tensor, before[name]), name
    settled = learner.networks()
    assert learner.settle() == 0, "recognised already"
    assert same(learner.networks(), settled)


def test_settling_has_an_end_and_needs_weights(small_set, everyone):
    settings = dataclasses.replace(TINY, between_class_extra=3)
    twins = everyone.select([0, 0, 0])  # all demonstrations alike: the second strategy can never be recognised
    learner, without = MSRD(small_set, settings, 0, between=(twins, WEIGHTS, PURE)), MSRD(small_set, settings, 0)
    for one in (learner, without):
        list(one.train())
    before = without.networks()
    assert learner.settle() == 3
    assert learner.n_averaged == 2 + 3
    assert without.settle() == 0
    assert same(without.networks(), before)


@pytest.mark.parametrize("alpha", [0.0, -0.1, float("nan")])
def test_alpha_must_be_positive(alpha, small_set):
    with pytest.raises(InputError, match=f"^alpha {alpha!r}: expected a positive weight of the strategy rewards$"):
        MSRD(small_set, dataclasses.replace(TINY, alpha=alpha), 0)


AIRL_TINY = AIRLSettings(**{f.name: getattr(TINY, f.name) for f in dataclasses.fields(AIRLSettings)})


def test_a_shared_task_reward_is_added_and_stays_frozen(small_set, trained):
    shared, states = trained.rewards, np.random.default_rng(0).normal(size=(50, 4))
    task = {k: v.clone() for k, v in shared.task_reward.state_dict().items()}
    learner = AIRL(small_set.select([1]), AIRL_TINY, 5, shared=shared)
    g = learner.rewards.evaluate(states)
    list(learner.train())
    assert same(dict(learner.rewards.task_reward.state_dict()), task)
    assert same(dict(shared.task_reward.state_dict()), task)
    assert np.allclose(learner.averaged_rewards.evaluate(states, "task"), shared.evaluate(states, "task"), atol=1e-5)
    assert not np.allclose(learner.rewards.evaluate(states), g), "the strategy reward must have moved, or this test says nothing"
    total = learner.rewards.evaluate(states, "total")
    assert np.allclose(total, shared.evaluate(states, "task") + 0.3 * learner.rewards.evaluate(states), atol=1e-5)
    data = rollout(small_set.domain, learner.policies.actor(), 1, 0, horizon=20)
    assert np.allclose(learner.policy_rewards(data)[0, 0], learner.rewards.evaluate(data.observations[0, 0, 1:], "total")[0], atol=1e-5)


def test_without_a_shared_reward_airl_has_no_task_reward(small_set):
    learner = AIRL(small_set, AIRL_TINY, 0)
    x = to_tensor(np.random.default_rng(0).normal(size=(2, 5, 4)))
    assert torch.equal(learner.rewards.total(x), learner.rewards.g(x))
    assert not any("task_reward" in name for name in learner.networks())


def test_the_average_of_the_rewards_goes_on(small_set):
    """The running average is ``a <- d a + (1 - d) r`` with d = min(0.9, n / (n + 3)) for n rewards averaged before."""
    learner = MSRD(small_set, dataclasses.replace(TINY, n_iterations=4), 0)
    learner.n_averaged = 25
    average = learner.averaged_rewards.task_reward.weights[-1].detach().clone()
    for n, _ in enumerate(learner.train(), 25):
        decay = min(0.9, n / (n + 3))
        average = decay * average + (1 - decay) * learner.rewards.task_reward.weights[-1].detach()
    assert torch.allclose(learner.averaged_rewards.task_reward.weights[-1], average, atol=1e-6)
    assert learner.n_averaged == 29
