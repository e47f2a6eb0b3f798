import math

import numpy as np
import pytest
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import INVERTED_PENDULUM, LUNAR_LANDER
from dmsrd_lite.method.between_class_discrimination import (
    between_class_loss,
    recognized,
    relative_to_own,
    states_of,
    train_rewards,
)
from dmsrd_lite.method.rewards import Rewards

PURE = torch.tensor([0, 3])
WEIGHTS = torch.tensor([[1.0, 0.0], [0.3, 0.7], [0.9, 0.1], [0.0, 1.0], [0.5, 0.5]], dtype=torch.float64)


@pytest.fixture
def mean_rewards():
    """Of two strategies on five demonstrations."""
    return torch.tensor(np.random.default_rng(0).normal(size=(2, 5)), requires_grad=True)


def equation_4(eta, fixed):
    """Written out; ``fixed[j]`` is the pure demonstration's mean reward, which no derivative sees."""
    return [
        sum((math.exp(eta[j][i]) - w[j] * math.exp(fixed[j])) ** 2 for i, w in enumerate(WEIGHTS.tolist()))
        for j in range(2)
    ]


def test_equation_4_written_out_and_by_hand(mean_rewards):
    """By hand: its own demonstration at 0, a mixture of weight 1/2 at log 2: (1 - 1)^2 + (2 - 1/2)^2."""
    eta = mean_rewards.tolist()
    written = equation_4(eta, [eta[j][m] for j, m in enumerate(PURE)])
    assert between_class_loss(mean_rewards, WEIGHTS, PURE).tolist() == pytest.approx(written)
    eta, weights = torch.tensor([[0.0, math.log(2)]]), torch.tensor([[1.0], [0.5]])
    assert between_class_loss(eta, weights, torch.tensor([0])).item() == pytest.approx(2.25)


@pytest.mark.parametrize("relative", [False, True])
def test_gradient_by_finite_differences_with_the_pure_term_fixed(relative, mean_rewards):
    fixed = [mean_rewards[j, m].item() for j, m in enumerate(PURE)]

    def written(eta):
        if relative:  # then exp(eta_S-j(tau_m_j)) is exp(0) whatever the network says
            eta = [[value - row[m] for value in row] for row, m in zip(eta, PURE.tolist(), strict=True)]
            return sum(equation_4(eta, [0.0, 0.0]))
        return sum(equation_4(eta, fixed))

    counted = relative_to_own(mean_rewards, PURE) if relative else mean_rewards
    between_class_loss(counted, WEIGHTS, PURE).sum().backward()
    for j, i in np.ndindex(2, 5):
        up, down = mean_rewards.tolist(), mean_rewards.tolist()
        up[j][i] += 1e-6
        down[j][i] -= 1e-6
        numeric = (written(up) - written(down)) / 2e-6
        assert mean_rewards.grad[j, i].item() == pytest.approx(numeric, rel=1e-5, abs=1e-6)


def test_it_is_least_where_rewards_say_the_weights():
    """The minimum: ``eta_S-j(tau_i) = eta_S-j(tau_m_j) + log w_ij``, at a loss of 0 and a gradient of 0."""
    eta = (0.4 + WEIGHTS.T.clamp(min=1e-30).log()).requires_grad_()
    loss = between_class_loss(eta, WEIGHTS, PURE)
    loss.sum().backward()
    assert loss.tolist() == pytest.approx([0, 0], abs=1e-12)
    assert eta.grad.abs().max() < 1e-12


def test_mean_rewards_of_long_trajectories_stay_finite(domain):
    """At the bound on 1000 states of each: means are finite, their gradient too; returns would overflow."""
    rewards = Rewards(domain, 2, 0.99, 0)
    with torch.no_grad():
        rewards.strategy_reward.biases[-1].fill_(1e3)
    x = torch.randn(2, 5 * 1000, 4, generator=torch.Generator().manual_seed(0))
    g = rewards.g(x).view(2, 5, 1000)
    assert g.mean(2).min() > 0.99 * rewards.bound
    loss = between_class_loss(g.mean(2), WEIGHTS.float(), PURE).sum()
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(p.grad).all() for p in rewards.strategy_reward.parameters())
    assert not torch.isfinite(between_class_loss(g.sum(2), WEIGHTS.float(), PURE)).any()


def test_relative_to_own_does_not_see_a_constant(mean_rewards):
    moved = relative_to_own(mean_rewards + torch.tensor([[3.0], [-7.0]]), PURE)
    assert torch.allclose(relative_to_own(mean_rewards, PURE), moved)
    assert [moved[j, m].item() for j, m in enumerate(PURE)] == [0.0, 0.0]
    assert torch.allclose(moved[0] - moved[0, 1], mean_rewards[0] - mean_rewards[0, 1]), "differences stay"
    losses = [between_class_loss(mean_rewards + c, WEIGHTS, PURE) for c in (0, 1)]
    assert not torch.allclose(*losses), "Equation 4 itself does see it"


def test_recognized_on_tables_by_hand():
    table = np.array([[3.0, 1.0, 2.0], [0.0, -1.0, -2.0]])
    answers = [recognized(table, pure).tolist() for pure in ([0, 1], [2, 0], (1, 2))]
    assert answers == [[True, False], [False, True], [False, False]]
    assert recognized(np.array([[1.0, 1.0]]), [0]).tolist() == [False], "a tie"
    assert recognized(np.array([[1.0]]), [0]).tolist() == [True], "one alone"


def test_states_that_are_everybodys_do_not_count():
    """A lander on its legs says nothing about who acts: neither Equation 4 nor the mean reward sees it."""
    observations = np.random.default_rng(0).normal(size=(2, 3, 6, 8))
    observations[..., 6:] = 0
    observations[:, :, 4:, 6] = 1  # the last two states: a leg touches
    lander = np.full((2, 3, 6), True)
    lander[:, :, 4:] = False
    assert np.array_equal(LUNAR_LANDER.tells(observations), lander)
    assert INVERTED_PENDULUM.tells(observations[..., :4]).all()
    states = states_of(LUNAR_LANDER, observations, [0], 50)
    assert states.shape == (2, 50, 8)
    for person in range(2):
        flown = {tuple(row) for row in observations[person, :, :4].reshape(-1, 8)}
        assert {tuple(row) for row in states[person]} <= flown
    assert len(np.unique(states[0], axis=0)) > 6, "drawn from all of them"
    shown = DemonstrationSet(LUNAR_LANDER, observations, np.zeros((2, 3, 5, 2)))
    rewards = Rewards(LUNAR_LANDER, 2, 0.99, 0)
    by_hand = rewards.evaluate(observations)[..., :4].mean((2, 3))
    assert np.allclose(rewards.mean_rewards(shown), by_hand, atol=1e-6)


def test_equation_4_alone_makes_ratios_the_weights():
    """Three people who stand apart, one of them half of each of the others; the task reward rests."""
    states = np.zeros((3, 50, 4))
    states[..., 0] = np.array([-1.0, 1.0, 0.0])[:, None] + np.random.default_rng(0).normal(0, 0.02, (3, 50))
    weights, pure = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]), (0, 1)
    rewards = Rewards(INVERTED_PENDULUM, 2, 0.99, 0, 0.3)
    task = rewards.task_reward.state_dict()["weights.0"].clone()
    train_rewards(rewards, states, weights, pure, 0)
    means = rewards.evaluate(states).mean(-1)  # (M, n)
    ratios = np.exp(means - means[[0, 1], [0, 1]][:, None])
    assert np.abs(ratios.T - weights).max() < 0.1
    assert torch.equal(rewards.task_reward.state_dict()["weights.0"], task)
    again = Rewards(INVERTED_PENDULUM, 2, 0.99, 0, 0.3)
    train_rewards(again, states, weights, pure, 0)
    assert np.array_equal(again.evaluate(states).mean(-1), means)
