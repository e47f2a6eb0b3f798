"""Every method goes through the same door, and what it learned can be stored and scored again."""

import dataclasses

import numpy as np
import pytest

from dmsrd_lite import methods
from dmsrd_lite.airl import AIRLSettings
from dmsrd_lite.demonstrations import RewardTestSet
from dmsrd_lite.envs import InputError
from dmsrd_lite.lifelong import LifelongSettings
from dmsrd_lite.metrics import correlations_on, reward_correlation
from dmsrd_lite.mixture import MixtureSettings
from dmsrd_lite.msrd import MSRDSettings
from dmsrd_lite.policy_optimization import PPOSettings

SMALL = {"n_iterations": 1, "episodes": 1, "cloning_steps": 40, "coverage_episodes": 1, "coverage_levels": ((3, 0),),
         "discriminator_steps": 2,
         "discriminator_batch": 16, "replay_samples": 30, "ppo": PPOSettings(minibatch=25)}  # fmt: skip
LOOP = LifelongSettings(airl=AIRLSettings(**SMALL), msrd=MSRDSettings(**SMALL, between_class_extra=1),
                        mixture=MixtureSettings(4, 2, search_rollouts=1, n_finalists=1, final_rollouts=1))  # fmt: skip
TINY = methods.MethodSettings(AIRLSettings(**SMALL), MSRDSettings(**SMALL), LOOP)


def make_truth(domain, n=30):
    rng = np.random.default_rng(0)
    states = rng.normal(size=(n, 5, domain.obs_dim)) * rng.uniform(0, 1, (n, 1, 1))
    return RewardTestSet(domain, states.astype(np.float32), -np.abs(states[..., 1]).sum(1), np.zeros(n), np.zeros(n), {})


@pytest.fixture
def truth(domain):
    return make_truth(domain)


@pytest.mark.parametrize("variant", ["ours", "paper"])
@pytest.mark.parametrize("method", methods.METHODS)
@pytest.mark.parametrize("task", ["inverted_pendulum", "lunar_lander"])
def test_what_is_stored_scores_the_same(task, method, variant, small_set, lander_set):
    small_set = {"inverted_pendulum": small_set, "lunar_lander": lander_set}[task]
    truth = make_truth(small_set.domain)
    if (method, variant) == ("cloning", "paper"):
        pytest.skip("cloning has nothing to switch off")
    settings = TINY if variant == "ours" else TINY.as_in_the_paper()
    learned = methods.train_method(method, small_set, settings, 0)
    scores = methods.score_method(learned, small_set, small_set, truth, [0, 9])
    assert learned.weights.shape == (2, learned.policies.n_strategies)
    assert learned.weights.sum(1) == pytest.approx([1, 1])
    alpha = learned.rewards.alpha if learned.rewards else 0.0
    again = methods.score_method(methods.restore(learned.tensors(), small_set, alpha, learned.pure), small_set, small_set, truth, [0, 9])
    for name in ("divergence", "log_likelihood_per_step", "task_correlation", "recognized", "environment_return"):
        assert scores[name] == pytest.approx(again[name], nan_ok=True), name
    if method != "cloning" and np.isfinite(scores["task_correlation"]):
        part = learned.rewards.evaluate(truth.observations, learned.task_part).mean(2)
        assert scores["task_correlation"] == pytest.approx(np.mean([reward_correlation(p, truth.returns) for p in part]))
    assert (method == "cloning") == (learned.rewards is None)
    assert scores["recognized"] == scores["recognized_again"] or method in ("cloning", "AIRL Batch")


def test_a_method_spends_what_its_settings_say(small_set):
    assert methods.train_method("cloning", small_set, TINY, 0).steps == 0
    two_levels, two_users, training = 2 * 50, 2, 50
    assert methods.train_method("AIRL Single", small_set, TINY, 0).steps == two_users * (two_levels + training)
    assert methods.train_method("AIRL Single", small_set, TINY.as_in_the_paper(), 0).steps == two_users * training


def test_as_in_the_paper_switches_three_things_off_everywhere():
    for part in ("airl", "msrd"):
        for owner in (TINY.as_in_the_paper(), TINY.as_in_the_paper().lifelong):
            changed = getattr(owner, part)
            assert (changed.warm_start, changed.cloning_weight, changed.coverage) == (False, 0.0, False)
            ours = getattr(TINY if isinstance(owner, methods.MethodSettings) else TINY.lifelong, part)
            assert dataclasses.replace(changed, warm_start=True, cloning_weight=1.0, coverage=True) == ours


def test_unknown_method(small_set):
    with pytest.raises(InputError, match="unknown method 'GAIL': expected one of cloning, AIRL Single"):
        methods.train_method("GAIL", small_set, TINY, 0)


def test_the_ceiling_is_what_a_state_reward_can_know(domain):
    known, test = make_truth(domain, 600), make_truth(domain, 600)
    held = dataclasses.replace(test, observations=test.observations[::-1], returns=test.returns[::-1])
    assert correlations_on(held, methods.fit_reward(known, 0, 500))[0] > 0.95, "the return is a function of the states"
    noise = dataclasses.replace(known, returns=np.random.default_rng(1).normal(size=600))
    assert abs(correlations_on(held, methods.fit_reward(noise, 0, 100))[0]) < 0.6, "nothing can be known about noise"
