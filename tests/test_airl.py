import dataclasses

import numpy as np
import pytest
import torch

from dmsrd_lite.airl import AIRL, AIRLSettings, Rewards, discriminator_loss
from dmsrd_lite.envs import InputError
from dmsrd_lite.networks import to_tensor
from dmsrd_lite.policy_optimization import PPOSettings
from dmsrd_lite.rollouts import rollout

TINY = AIRLSettings(n_iterations=2, episodes=1, cloning_steps=60, coverage_episodes=1, coverage_levels=((1, 0), (3, 0)),
                    discriminator_steps=2,
                    discriminator_batch=16, replay_samples=30, ppo=PPOSettings(minibatch=25))  # fmt: skip


def test_discriminator_loss_equals_the_written_formula():
    rng = np.random.default_rng(0)
    f, log_pi = torch.tensor(rng.normal(size=(2, 2, 5)))
    d = f.exp() / (f.exp() + log_pi.exp())
    written = -d.log().mean(1) - (1 - d).log().mean(1)
    assert torch.allclose(discriminator_loss(f - log_pi, f - log_pi), written)
    assert torch.isfinite(discriminator_loss(torch.full((1, 2), -1e4), torch.full((1, 2), 1e4))).all()


def test_f_is_g_plus_shaping_and_telescopes(domain):
    rewards = Rewards(domain, 2, 0.9, [0])
    x = torch.randn(2, 6, 4, generator=torch.Generator().manual_seed(0))
    f = rewards.f(x[:, :-1], x[:, 1:]).detach()
    g, h = rewards.g(x).detach(), rewards.shaping(x)[..., 0].detach()
    discount = 0.9 ** torch.arange(5)
    assert torch.allclose((discount * (f - g[:, :-1])).sum(1), 0.9**5 * h[:, 5] - h[:, 0], atol=1e-5)


def test_reward_gradient_by_finite_differences(domain):
    rewards = Rewards(domain, 1, 0.99, [0]).double()
    x = torch.randn(1, 8, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def loss():
        logits = rewards.f(x[:, :-1], x[:, 1:])
        return discriminator_loss(logits[:, :4], logits[:, 4:]).sum()

    loss().backward()
    weight = rewards.shaping.weights[0]
    for index in ((0, 0, 0), (0, 2, 5)):
        with torch.no_grad():
            weight[index] += 1e-6
            up = loss().item()
            weight[index] -= 2e-6
            down = loss().item()
            weight[index] += 1e-6
        assert weight.grad[index].item() == pytest.approx((up - down) / 2e-6, rel=1e-4, abs=1e-8)


def test_g_is_bounded_and_has_unit_slope_at_zero(domain):
    rewards = Rewards(domain, 1, 0.99, [0])
    x = torch.randn(1, 50, 4, generator=torch.Generator().manual_seed(0))
    small = rewards.g(x).detach()
    raw = rewards.strategy_reward(x)[..., 0].detach()
    assert torch.allclose(small, raw, atol=0.1 * raw.abs().max().item())
    with torch.no_grad():
        rewards.strategy_reward.weights[-1].mul_(1e4)
    assert rewards.g(x).abs().max() <= rewards.bound


def test_evaluate_equals_g_at_raw_observations(domain):
    rewards = Rewards(domain, 2, 0.99, [0])
    states = np.random.default_rng(0).normal(size=(3, 5, 4))
    values = rewards.evaluate(states)
    assert values.shape == (2, 3, 5)
    one = rewards.g(to_tensor(domain.network_input(states[1, 2])).expand(2, 1, 4))[1, 0].item()
    assert values[1, 1, 2] == pytest.approx(one, abs=1e-5)


AS_IN_THE_PAPER = {"warm_start": False, "cloning_weight": 0.0, "coverage": False}


@pytest.mark.parametrize("change", [{}, {"policy_reward": "f_minus_log_pi"}, AS_IN_THE_PAPER])
def test_a_tiny_run_counts_steps_and_is_deterministic(change, small_set):
    settings = dataclasses.replace(TINY, **change)
    runs = []
    for n_threads in (1, 2):
        learner = AIRL(small_set, settings, 3, n_threads)
        records = list(learner.train())
        runs.append((records, [p.detach().numpy() for p in (*learner.policies.parameters(), *learner.averaged_rewards.parameters())]))
    records = runs[0][0]
    explored = 3 * 50 if settings.coverage else 0
    assert [r["steps"] for r in records] == [explored + 50, explored + 100]
    assert all(np.isfinite(r["discriminator_loss"]).all() and r["accuracy"].shape == (2,) for r in records)
    for a, b in zip(runs[0][1], runs[1][1], strict=True):
        assert np.array_equal(a, b)


def test_stopping_and_going_on_equals_one_run(small_set):
    straight, broken = AIRL(small_set, TINY, 0), AIRL(small_set, TINY, 0)
    list(straight.train())
    next(broken.train())
    rest = list(broken.train())
    assert [r["iteration"] for r in rest] == [1]
    assert broken.steps == straight.steps
    for a, b in zip(straight.policies.parameters(), broken.policies.parameters(), strict=True):
        assert torch.equal(a, b)


def test_discount_reaches_the_policy(small_set):
    assert AIRL(small_set, dataclasses.replace(TINY, discount=0.5), 0).optimizer.settings.discount == 0.5


def test_without_warm_start_the_policy_starts_untrained(small_set):
    cold = AIRL(small_set, dataclasses.replace(TINY, warm_start=False), 0)
    warm = AIRL(small_set, TINY, 0)
    states = small_set.observations[:, 0, :5]
    assert np.allclose(cold.policies.actor().mean(states), cold.untrained.mean(states))
    assert np.allclose(warm.policies.actor().mean(states), warm.clone.mean(states))


def test_samples_keep_the_density_they_were_drawn_with(small_set):
    learner = AIRL(small_set, TINY, 0)
    actor = learner.policies.actor()
    list(learner.train())
    x, _, log_pi = learner.replay[0]
    assert x.shape == (2, 30, 4)
    data = rollout(small_set.domain, actor, 1, [*learner.seed, 10, 0], horizon=50)
    again = learner._samples(data, actor, 30, [*learner.seed, 11, 0])
    assert torch.equal(again[0], x)
    assert torch.equal(again[2], log_pi)
    now = learner._samples(data, learner.policies.actor(), 30, [*learner.seed, 11, 0])
    assert not torch.allclose(now[2], log_pi), "the policy must have moved, or this test says nothing"


def test_the_discriminator_learns_to_tell_a_moved_demonstration(small_set):
    """Demonstrated states moved by 1 m: after training, g must prefer them."""
    moved = dataclasses.replace(small_set, observations=small_set.observations + np.array([1.0, 0, 0, 0]))
    learner = AIRL(moved, dataclasses.replace(TINY, n_iterations=6, discriminator_steps=40, discriminator_batch=64, warm_start=False), 0)
    list(learner.train())
    g = [learner.rewards.evaluate(s.observations[0]).mean((1, 2))[0] for s in (moved, small_set)]
    assert g[0] > g[1]


def test_unknown_policy_reward(small_set):
    with pytest.raises(InputError, match="policy_reward 'h': expected one of g, f_minus_log_pi"):
        AIRL(small_set, AIRLSettings(policy_reward="h"), 0)
