from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import AIRL_ONE, same

from dmsrd_lite.domains import InputError
from dmsrd_lite.learning.networks import to_tensor
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method import airl
from dmsrd_lite.method.airl import AIRL, AIRLSettings, clone_demonstrations, discriminator_loss
from dmsrd_lite.method.rewards import Rewards

AS_IN_THE_PAPER = {"start": "nothing", "coverage": "none"}
ONCE = {"start": "nothing", "coverage": "once"}
FROM_NOTHING = {
    "start": "nothing", "coverage": "once", "penalty_weight": 1.0, "first_horizon": 20,
    "replay_iterations": 0, "n_iterates": 2, "entropy_weight": 0.05,
}  # fmt: skip


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
    "change",
    [{}, {"coverage_levels": ()}, {"policy_base": "f", "entropy_weight": 1.0}, AS_IN_THE_PAPER, ONCE],
)
def test_a_tiny_run_counts_steps_and_is_deterministic(change, small_set):
    settings, runs = replace(AIRL_ONE, **change), []
    for n_threads in (1, 2):
        shown = replace(small_set, domain=small_set.domain.on_threads(n_threads))
        learner = AIRL(shown, settings, 3)
        records = list(learner.train())
        runs.append(learner.networks())
    levels = settings.coverage_levels or small_set.domain.exploration
    explored = (1 + len(levels)) * 50 if settings.coverage != "none" else 0
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


def test_from_a_clone_the_policy_is_the_clone_and_from_nothing_untrained(small_set):
    cold, warm = (AIRL(small_set, replace(AIRL_ONE, start=s, discount=0.5), 0) for s in ("nothing", "clone"))
    assert cold.clone is None
    assert warm.optimizer.settings.discount == 0.5
    states = small_set.observations[:, 0, :5]
    assert np.array_equal(cold.policies.actor().mean(states), cold.untrained.mean(states))
    policies = clone_demonstrations(small_set, [0, 101], AIRL_ONE.cloning_steps)
    for clone in (warm.policies.actor(), warm.clone):
        assert np.array_equal(clone.mean(states), policies.actor().mean(states))


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


@pytest.mark.parametrize(("base", "c"), [("g", 0.0), ("g", 0.3), ("f", 1.0)])
def test_what_the_policy_is_paid_by_hand(base, c, small_set):
    """``R(s') - c log pi``, or ``log D - log(1 - D)`` with ``D = e^f / (e^f + pi)``."""
    learner = AIRL(small_set, replace(AIRL_ONE, policy_base=base, entropy_weight=c), 0)
    data = rollout(small_set.domain, actor := learner.policies.actor(), 2, 0, horizon=20)
    states, actions = data.observations[:, 1], data.executed_actions[:, 1]
    x = to_tensor(small_set.domain.network_input(states))
    f = learner.rewards.f(x[:, :-1], x[:, 1:]).detach().numpy().astype(float)
    log_pi = actor.log_density(states[:, :-1], actions)
    d = np.exp(f) / (np.exp(f) + np.exp(log_pi))
    g = learner.rewards.g(x[:, 1:]).detach().numpy()
    by_hand = g - c * log_pi if base == "g" else np.log(d) - np.log(1 - d)
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
    loss, accuracy = learner._discriminate(0, learner._log_densities())
    shown, flown, covered = (1 / (1 + np.exp(log_pi)) for log_pi in (-0.5, -2.0, 1.0))
    written = -np.log(shown) - (np.log(1 - flown) + np.log(1 - covered)) / 2
    assert loss.tolist() == pytest.approx([written] * 2, rel=1e-5)
    assert accuracy.tolist() == [(1 + 0.5) / 2] * 2


def test_the_discriminator_learns_to_tell_a_moved_demonstration(small_set):
    """Demonstrated states moved by 1 m: after training, g must prefer them."""
    moved = replace(small_set, observations=small_set.observations + np.array([1.0, 0, 0, 0]))
    more = {
        "n_iterations": 3,
        "discriminator_steps": 30,
        "discriminator_batch": 64,
        "start": "nothing",
        "coverage": "none",
    }
    learner = AIRL(moved, replace(AIRL_ONE, **more), 0)
    list(learner.train())
    assert learner.rewards.mean_rewards(moved)[0, 0] > learner.rewards.mean_rewards(small_set)[0, 0]


def test_the_gradient_penalty_by_finite_differences(small_set):
    """Its value by differences of R, and its gradient in a weight by differences of it (double precision)."""
    learner = AIRL(small_set, replace(AIRL_ONE, penalty_slope=0.2), 0)
    learner.rewards.double()
    shown, samples = (part.double() for part in learner.x.split(25, 1)[:2])
    share = np.random.default_rng(7).random((*shown.shape[:2], 1), dtype=np.float32)
    x = (share * shown.numpy() + (1 - share) * samples.numpy()).astype(np.float64)

    def total(at):
        return learner.rewards.total(torch.from_numpy(at)).detach().numpy()

    moves = 1e-5 * np.eye(x.shape[-1])
    slope = np.sqrt(sum(((total(x + d) - total(x - d)) / 2e-5) ** 2 for d in moves))
    penalty = learner.gradient_penalty(shown, samples, np.random.default_rng(7))
    assert penalty.detach().numpy() == pytest.approx((np.maximum(slope - 0.2, 0) ** 2).mean(1), rel=1e-4)
    assert (slope > 0.2).any(), "or this test says nothing"
    weight = learner.rewards.strategy_reward.weights[1]
    penalty.sum().backward()
    exact, found = weight.grad[0, 3, 5].item(), []
    for step in (1e-5, -1e-5):
        with torch.no_grad():
            weight[0, 3, 5] += step
        found.append(learner.gradient_penalty(shown, samples, np.random.default_rng(7)).sum().item())
        with torch.no_grad():
            weight[0, 3, 5] -= step
    assert exact == pytest.approx((found[0] - found[1]) / 2e-5, rel=1e-3)


def test_c_falls_while_the_policy_is_wider_than_what_was_shown(small_set):
    """``log N`` of actions 0.3 from the mean, by hand; a policy's own mean log-density: minus its entropy."""
    settings = replace(AIRL_ONE, entropy_weight=0.05, entropy_tuning=0.1, start="nothing")
    learner = AIRL(small_set, settings, 0)
    for sigma, direction in ((3.0, -1), (0.05, 1)):
        own = -0.5 - np.log(sigma) - 0.5 * np.log(2 * np.pi)
        shown = own + 0.5 - 0.5 * (0.3 / sigma) ** 2
        learner.entropy_weights = np.full(2, 0.05)
        learner.tune_entropy(np.full(2, shown), np.full(2, own))
        assert (np.sign(learner.entropy_weights - 0.05) == direction).all()
        expected = 0.05 * np.exp(0.1 * np.clip(0.5 * (0.3 / sigma) ** 2 - 0.5, -1, 1))
        assert learner.entropy_weights == pytest.approx(expected)
    for _ in range(100):
        learner.tune_entropy(np.zeros(2), np.full(2, 9.0))
    assert (learner.entropy_weights == 0.1).all(), "bounded"


def test_c_follows_the_demonstrations_while_training(small_set):
    settings = replace(AIRL_ONE, entropy_weight=0.05, start="nothing", first_sigma=1.0)
    (*_, fixed), (*_, tuned) = (
        [
            r["entropy_weight"].copy()
            for r in AIRL(small_set, replace(settings, entropy_tuning=rate), 0).train()
        ]
        for rate in (0.0, 0.1)
    )
    assert (fixed == 0.05).all()
    assert (tuned < 0.05).all(), "the untrained policy is wider than what was shown"


def test_the_average_of_policies_by_hand(small_set):
    learner = AIRL(small_set, replace(AIRL_ONE, n_iterations=3, policy_average=0.5), 0)
    seen = [learner.policies.log_sigma.clone().detach() for _ in learner.train()]
    first, second, third = seen
    second = 0.25 * first + 0.75 * second  # decays: 0, 1/4, 2/5, and never more than 0.5
    assert torch.allclose(learner.learned_policies.log_sigma, 0.4 * second + 0.6 * third)
    assert not torch.equal(learner.policies.log_sigma, learner.learned_policies.log_sigma)
    last = AIRL(small_set, AIRL_ONE, 0)
    assert last.learned_policies is last.policies


def test_the_policy_learns_more_slowly_in_the_second_half(small_set):
    learner, rates = AIRL(small_set, replace(AIRL_ONE, n_iterations=4, last_rate=0.2), 0), []
    for _ in learner.train():
        rates.append(learner.optimizer.optimizer.param_groups[0]["lr"] / AIRL_ONE.ppo.learning_rate)
    assert rates == pytest.approx([1, 1, 1, 0.6])


def test_it_ends_when_its_steps_are_spent(small_set):
    """The iteration that spends the last of them is the last, and the rate falls by steps."""
    changes = {"n_iterations": 50, "episodes": 1, "coverage": "none", "last_rate": 0.2}
    learner, rates = AIRL(small_set, replace(AIRL_ONE, **changes, max_steps=130), 0), []
    steps = []
    for record in learner.train():
        steps.append(record["steps"])
        rates.append(learner.optimizer.optimizer.param_groups[0]["lr"])
    each = steps[0]
    assert steps == [each * (i + 1) for i in range(-(-130 // each))]
    assert rates[-1] < rates[0]
    assert len(list(learner.train())) == 0


def test_episodes_grow_when_the_discriminator_can_no_longer_tell(small_set):
    learner = AIRL(small_set, replace(AIRL_ONE, first_horizon=20, growth=1.5, grow_below=0.75), 0)
    for iteration in range(12):
        learner._grow(np.array([0.9, 0.5]), iteration)
    assert learner.length == 20, "the 70 % quantile of the two is above"
    for _ in range(5):
        learner._grow(np.array([0.5, 0.5]), 12)
    assert 20 < learner.length <= 50
    for _ in range(10):
        learner._grow(np.array([0.5, 0.5]), 12)
    assert learner.length == 50, "the demonstrations' own length"


def test_short_episodes_are_compared_with_the_beginning_of_demonstrations(small_set, monkeypatch):
    learner = AIRL(small_set, replace(AIRL_ONE, **FROM_NOTHING), 0)
    seen, f = [], learner.rewards.f
    monkeypatch.setattr(learner.rewards, "f", lambda x, y: seen.append(x) or f(x, y))
    records = list(learner.train())
    assert [r["horizon"] for r in records] == [20, 20]
    early = learner.x[:, learner.time < 20]
    for x in seen[:2]:
        for row, known in zip(x[:, :16], early, strict=True):
            assert all((known == state).all(1).any() for state in row)


def test_the_replay_of_all_iterations_is_bounded_and_keeps_early_samples(small_set, monkeypatch):
    monkeypatch.setattr(airl, "REPLAY_SIZE", 100)
    learner = AIRL(small_set, replace(AIRL_ONE, replay_iterations=0), 0)
    for number in range(9):
        learner._remember(
            tuple(torch.full(shape, float(number)) for shape in ((2, 30, 4), (2, 30, 4), (2, 30)))
        )
    held = torch.cat([log_pi for *_, log_pi in learner.replay], 1)[0]
    assert len(held) <= 100
    assert set(held.tolist()) == set(range(9))
    sizes = [log_pi.shape[1] for *_, log_pi in learner.replay]
    assert max(sizes) <= 1.2 * min(sizes), "as many of each iteration"


def test_the_mean_of_iterates_is_of_functions_not_of_weights(small_set):
    learner = AIRL(small_set, replace(AIRL_ONE, n_iterations=5, n_iterates=3), 0)
    seen = []
    for _ in learner.train():
        seen.append(learner.rewards.evaluate(small_set.observations))
    assert (len(learner.iterates), learner.every) == (3, 2), "bounded: iterations 0, 2, 4"
    mean = learner.mean_of_iterates().evaluate(small_set.observations)
    assert mean == pytest.approx(np.mean(seen[::2], 0), abs=1e-6)
    assert learner.mean_of_iterates(0.34).evaluate(small_set.observations) == pytest.approx(seen[0], abs=1e-6)
    means = learner.mean_of_iterates().mean_rewards(small_set)
    assert means == pytest.approx(mean.mean((2, 3)), abs=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"policy_base": "h"}, "policy_base 'h': expected one of g, f"),
        ({"start": "warm"}, "start 'warm': expected one of clone, nothing"),
        ({"coverage": True}, "coverage True: expected one of half, once, none"),
        ({"penalty_weight": -1.0}, "penalty_weight -1.0: expected a number of at least 0"),
        ({"entropy_weight": -0.1}, "entropy_weight -0.1: expected a number of at least 0"),
        ({"penalty_slope": 0.0}, "penalty_slope 0.0: expected a positive number"),
        ({"max_steps": -1}, "max_steps -1: expected a number of steps, or 0 for no limit"),
        ({"growth": 0.9}, "growth 0.9 from first_horizon 0: expected a growth above 1 from"),
        ({"growth": 1.0, "first_horizon": 30}, "growth 1.0 from first_horizon 30: expected a growth above 1"),
        ({"discount": 1.0}, "discount 1.0: expected a number of at least 0 and below 1"),
        ({"policy_average": 1.5}, "policy_average 1.5: expected a share of at most 1"),
        ({"iterates_share": 0.0}, "iterates_share 0.0: expected a share of at most 1"),
    ],
)
def test_settings_that_cannot_be_are_one_sentence(change, sentence):
    with pytest.raises(InputError, match=f"^{sentence}[^\\n]*$"):
        AIRLSettings(**change)


def test_a_first_horizon_needs_a_horizon_to_grow_to(small_set):
    with pytest.raises(InputError, match=r"^first_horizon 60: expected at most the demonstrations' 50 steps"):
        AIRL(small_set, replace(AIRL_ONE, first_horizon=60), 0)


def test_from_nothing_a_later_learner_still_sees_what_was_on_the_way(small_set, monkeypatch):
    """An even choice of all iterations goes on, unchanged from learner to learner, in every pool: also of
    those that the replay has forgotten."""
    monkeypatch.setattr(airl, "N_ANCHORS", 12)
    settings = replace(AIRL_ONE, **{**AS_IN_THE_PAPER, "replay_iterations": 1, "anchor_samples": 6})
    first = AIRL(small_set, settings, 0)
    seen = [first.replay[0] for _ in first.train()]
    assert len(seen) == settings.n_iterations == 2
    networks = first.networks()
    for part in range(3):
        taken = [one[part][:, np.linspace(0, one[part].shape[1] - 1, 6).astype(int)] for one in seen]
        assert torch.equal(networks[f"anchors.{part}"], torch.cat(taken, 1))
    second = AIRL(small_set, settings, 1, networks=networks)
    pools = []
    joined = AIRL._joined
    monkeypatch.setattr(AIRL, "_joined", staticmethod(lambda parts: pools.append(parts) or joined(parts)))
    list(second.train())
    assert all(torch.equal(pool[0][0], networks["anchors.0"]) for pool in pools)
    assert second.steps == 2 * 50, "nothing is explored anew"
    kept = second.networks()
    assert same(*({k: v for k, v in n.items() if k.startswith("anchors")} for n in (networks, kept)))
    first.settings = replace(settings, anchor_samples=0)
    first.passed = []
    last = [part[:, np.linspace(0, part.shape[1] - 1, 12).astype(int)] for part in seen[-1]]
    assert all(torch.equal(first.networks()[f"anchors.{i}"], part) for i, part in enumerate(last))
    warm = AIRL(small_set, replace(AIRL_ONE, n_iterations=1), 0)
    list(warm.train())
    assert not any(name.startswith("anchors") for name in warm.networks()), "from a clone there is coverage"
