from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import AIRL_ONE, same

from dmsrd_lite.domains import InputError
from dmsrd_lite.learning.networks import to_tensor
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.airl import AIRL, AIRLSettings, Rewards, clone_demonstrations, discriminator_loss

AS_IN_THE_PAPER = {"warm_start": False, "cloning_weight": 0.0, "coverage": False}


@pytest.fixture
def x():
    """Network inputs of two strategies."""
    return torch.randn(2, 50, 4, generator=torch.Generator().manual_seed(0))


def test_discriminator_loss_equals_the_written_formula():
    f, log_pi = torch.tensor(np.random.default_rng(0).normal(size=(2, 2, 5)))
    d = f.exp() / (f.exp() + log_pi.exp())
    written = -d.log().mean(1) - (1 - d).log().mean(1)
    assert torch.allclose(discriminator_loss(f - log_pi, f - log_pi), written)
    assert torch.isfinite(discriminator_loss(torch.full((1, 2), -1e4), torch.full((1, 2), 1e4))).all()


def test_f_is_g_plus_shaping_and_telescopes(domain, x):
    rewards = Rewards(domain, 2, 0.9, 0)
    x = x[:, :6]
    f, g = rewards.f(x[:, :-1], x[:, 1:]).detach(), rewards.g(x).detach()
    h, discount = rewards.shaping(x)[..., 0].detach(), 0.9 ** torch.arange(5)
    assert torch.equal(rewards.total(x), rewards.g(x)), "nothing is shared"
    assert torch.allclose((discount * (f - g[:, :-1])).sum(1), 0.9**5 * h[:, 5] - h[:, 0], atol=1e-5)


def test_g_is_bounded_with_unit_slope_at_zero_and_evaluated_at_raw_observations(domain, small_set, x):
    rewards, shown = Rewards(domain, 2, 0.99, 0), small_set.observations
    raw = rewards.strategy_reward(x)[..., 0].detach()
    assert torch.allclose(rewards.g(x).detach(), raw, atol=0.1 * raw.abs().max().item())
    values, inputs = rewards.evaluate(shown), to_tensor(domain.network_input(shown[1, 0])).expand(2, -1, -1)
    assert values.shape == (2, *shown.shape[:3])
    assert np.allclose(values[:, 1, 0], rewards.g(inputs).detach(), atol=1e-5)
    assert rewards.mean_rewards(small_set)[1, 0] == pytest.approx(values[1, 0].mean(), rel=1e-5)
    with torch.no_grad():
        rewards.strategy_reward.weights[-1].mul_(1e4)
    assert rewards.g(x).abs().max() <= rewards.bound


@pytest.mark.parametrize(
    "change", [{}, {"coverage_levels": ()}, {"policy_reward": "f_minus_log_pi"}, AS_IN_THE_PAPER]
)
def test_a_tiny_run_counts_steps_and_is_deterministic(change, small_set):
    settings, runs = replace(AIRL_ONE, **change), []
    for n_threads in (1, 2):
        shown = replace(small_set, domain=small_set.domain.on_threads(n_threads))
        learner = AIRL(shown, settings, 3)
        records = list(learner.train())
        runs.append(learner.networks())
    levels = settings.coverage_levels or small_set.domain.exploration.levels
    explored = (1 + len(levels)) * 50 if settings.coverage else 0
    assert [r["steps"] for r in records] == [explored + 50, explored + 100]
    for r in records:
        assert np.isfinite(r["discriminator_loss"]).all()
        assert r["accuracy"].shape == r["environment_return"].shape == (2,)
    assert same(*runs)


def test_stopping_and_going_on_equals_one_run(small_set):
    straight, broken, seen = AIRL(small_set, AIRL_ONE, 0), AIRL(small_set, AIRL_ONE, 0), []
    list(straight.train())
    next(broken.train())
    rest = list(broken.train(progress=lambda left: seen.extend(left) or left))
    assert [r["iteration"] for r in rest] == seen == [1]
    assert broken.steps == straight.steps
    assert same(straight.networks(), broken.networks())


def test_with_warm_start_the_policy_is_the_clone_and_without_it_untrained(small_set):
    cold, warm = (AIRL(small_set, replace(AIRL_ONE, warm_start=w, discount=0.5), 0) for w in (False, True))
    assert warm.optimizer.settings.discount == 0.5
    states = small_set.observations[:, 0, :5]
    assert np.array_equal(cold.policies.actor().mean(states), cold.untrained.mean(states))
    policies, curve = clone_demonstrations(small_set, [0, 101], AIRL_ONE.cloning_steps)
    for clone in (warm.policies.actor(), warm.clone, cold.clone):
        assert np.array_equal(clone.mean(states), policies.actor().mean(states))
    assert curve.shape == (1, 2), "every 50 steps, each of two policies"
    other, _ = clone_demonstrations(small_set, [0, 101], AIRL_ONE.cloning_steps, streams=(5, 6))
    assert not np.array_equal(other.actor().mean(states), policies.actor().mean(states))


def test_samples_keep_the_density_they_were_drawn_with(small_set):
    learner = AIRL(small_set, AIRL_ONE, 0)
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


@pytest.mark.parametrize("kind", ["g", "f_minus_log_pi"])
def test_what_the_policy_is_paid_by_hand(kind, small_set):
    """``R(s')``, or ``log D - log(1 - D)`` with ``D = e^f / (e^f + pi)``."""
    learner = AIRL(small_set, replace(AIRL_ONE, policy_reward=kind), 0)
    data = rollout(small_set.domain, actor := learner.policies.actor(), 2, 0, horizon=20)
    states, actions = data.observations[:, 1], data.executed_actions[:, 1]
    x = to_tensor(small_set.domain.network_input(states))
    f = learner.rewards.f(x[:, :-1], x[:, 1:]).detach().numpy().astype(float)
    d = np.exp(f) / (np.exp(f) + np.exp(actor.log_density(states[:, :-1], actions)))
    by_hand = learner.rewards.g(x[:, 1:]).detach() if kind == "g" else np.log(d) - np.log(1 - d)
    assert np.allclose(learner.policy_rewards(data)[:, 1], by_hand, atol=1e-4)


def test_the_discriminator_compares_f_with_log_pi_and_half_of_its_samples_are_coverage(
    small_set, monkeypatch
):
    """With f at zero and constant densities ``D = 1 / (1 + pi)``, whatever is drawn."""
    learner = AIRL(small_set, replace(AIRL_ONE, n_iterations=1, discriminator_steps=1), 0)
    list(learner.train())
    for parameter in learner.rewards.parameters():
        parameter.data.zero_()
    (replayed,), (x, x_next, _) = learner.replay, learner.coverage[0]
    learner.replay = [(*replayed[:2], torch.full((2, 30), -2.0))]
    learner.coverage = [(x, x_next, torch.full(x.shape[:2], 1.0))]
    monkeypatch.setattr(learner.policies, "log_density", lambda x, a: torch.full(x.shape[:2], -0.5))
    loss, accuracy = learner._discriminate(0)
    shown, flown, covered = (1 / (1 + np.exp(log_pi)) for log_pi in (-0.5, -2.0, 1.0))
    written = -np.log(shown) - (np.log(1 - flown) + np.log(1 - covered)) / 2
    assert loss.tolist() == pytest.approx([written] * 2, rel=1e-5)
    assert accuracy.tolist() == [(1 + 0.5) / 2] * 2


def test_the_discriminator_learns_to_tell_a_moved_demonstration(small_set):
    """Demonstrated states moved by 1 m: after training, g must prefer them."""
    moved = replace(small_set, observations=small_set.observations + np.array([1.0, 0, 0, 0]))
    more = {"n_iterations": 3, "discriminator_steps": 30, "discriminator_batch": 64, "warm_start": False}
    learner = AIRL(moved, replace(AIRL_ONE, **more), 0)
    list(learner.train())
    assert learner.rewards.mean_rewards(moved)[0, 0] > learner.rewards.mean_rewards(small_set)[0, 0]


def test_unknown_policy_reward(small_set):
    with pytest.raises(InputError, match=r"^policy_reward 'h': expected one of g, f_minus_log_pi$"):
        AIRL(small_set, AIRLSettings(policy_reward="h"), 0)
