import math

import numpy as np
import pytest
import torch

from dmsrd_lite.airl import Rewards
from dmsrd_lite.discrimination import between_class_loss, recognized, relative_to_own

PURE = torch.tensor([0, 3])
WEIGHTS = torch.tensor([[1.0, 0.0], [0.3, 0.7], [0.9, 0.1], [0.0, 1.0], [0.5, 0.5]], dtype=torch.float64)


@pytest.fixture
def mean_rewards():
    """Of two strategies on five demonstrations."""
    return torch.tensor(np.random.default_rng(0).normal(size=(2, 5)), requires_grad=True)


def equation_5(eta, weights, pure, fixed):
    """Written out; ``fixed[j]`` is the pure demonstration's mean reward, a number that no derivative sees."""
    total = 0.0
    for j in range(len(eta)):
        for i in range(len(weights)):
            total += (math.exp(eta[j][i]) - weights[i][j] * math.exp(fixed[j])) ** 2
    return total


def own(eta, pure):
    return [eta[j][pure[j]] for j in range(len(pure))]


def test_equation_5_written_out(mean_rewards):
    loss, eta, weights = between_class_loss(mean_rewards, WEIGHTS, PURE), mean_rewards.tolist(), WEIGHTS.tolist()
    for j in range(2):
        one_column = [[row[j]] for row in weights]
        assert loss[j].item() == pytest.approx(equation_5(eta[j : j + 1], one_column, PURE[j : j + 1], [eta[j][PURE[j]]]))


def test_by_hand():
    """One strategy, its own demonstration at 0 and a mixture with weight 1/2 at log 2: (1 - 1)^2 + (2 - 1/2)^2."""
    loss = between_class_loss(torch.tensor([[0.0, math.log(2)]]), torch.tensor([[1.0], [0.5]]), torch.tensor([0]))
    assert loss.item() == pytest.approx(2.25)


@pytest.mark.parametrize("count_from_own", [False, True])
def test_gradient_by_finite_differences_with_the_pure_term_fixed(count_from_own, mean_rewards):
    def written(eta):
        if count_from_own:  # then exp(eta_S-j(tau_m_j)) is exp(0) whatever the network says
            eta = [[value - row[m] for value in row] for row, m in zip(eta, PURE.tolist(), strict=True)]
            return equation_5(eta, WEIGHTS.tolist(), PURE, [0.0, 0.0])
        return equation_5(eta, WEIGHTS.tolist(), PURE, fixed)

    fixed = own(mean_rewards.tolist(), PURE)
    counted = relative_to_own(mean_rewards, PURE) if count_from_own else mean_rewards
    between_class_loss(counted, WEIGHTS, PURE).sum().backward()
    for j in range(2):
        for i in range(5):
            up, down = mean_rewards.tolist(), mean_rewards.tolist()
            up[j][i] += 1e-6
            down[j][i] -= 1e-6
            numeric = (written(up) - written(down)) / 2e-6
            assert mean_rewards.grad[j, i].item() == pytest.approx(numeric, rel=1e-5, abs=1e-6)


def test_it_is_least_where_rewards_say_the_weights():
    """The minimum of Equation 5: ``eta_S-j(tau_i) = eta_S-j(tau_m_j) + log w_ij``, at a loss of 0 and a gradient of 0."""
    eta = (0.4 + WEIGHTS.T.clamp(min=1e-30).log()).requires_grad_()
    loss = between_class_loss(eta, WEIGHTS, PURE)
    loss.sum().backward()
    assert loss.tolist() == pytest.approx([0, 0], abs=1e-12)
    assert eta.grad.abs().max() < 1e-12


def test_mean_rewards_of_long_trajectories_stay_finite(domain):
    """At the bound on 1000 states of each: means are finite, with their gradient; returns would have overflowed."""
    rewards = Rewards(domain, 2, 0.99, [0])
    with torch.no_grad():
        rewards.strategy_reward.biases[-1].fill_(1e3)
    g = rewards.g(torch.randn(2, 5 * 1000, 4, generator=torch.Generator().manual_seed(0))).view(2, 5, 1000)
    assert g.mean(2).min() > 0.99 * rewards.bound
    loss = between_class_loss(g.mean(2), WEIGHTS.float(), PURE).sum()
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(p.grad).all() for p in rewards.strategy_reward.parameters())
    assert not torch.isfinite(between_class_loss(g.sum(2), WEIGHTS.float(), PURE)).any()


def test_centered_does_not_see_a_constant(mean_rewards):
    moved = relative_to_own(mean_rewards + torch.tensor([[3.0], [-7.0]]), PURE)
    assert torch.allclose(relative_to_own(mean_rewards, PURE), moved)
    assert [moved[j, m].item() for j, m in enumerate(PURE)] == [0.0, 0.0]
    assert torch.allclose(moved[0] - moved[0, 1], mean_rewards[0] - mean_rewards[0, 1]), "differences are kept"
    loss = between_class_loss(mean_rewards, WEIGHTS, PURE)
    assert not torch.allclose(loss, between_class_loss(mean_rewards + 1, WEIGHTS, PURE)), "Equation 5 itself does see it"


def test_recognized_on_tables_by_hand():
    table = np.array([[3.0, 1.0, 2.0], [0.0, -1.0, -2.0]])
    assert recognized(table, [0, 1]).tolist() == [True, False]
    assert recognized(table, [2, 0]).tolist() == [False, True]
    assert recognized(table, (1, 2)).tolist() == [False, False]
    assert recognized(np.array([[1.0]]), [0]).tolist() == [True]
