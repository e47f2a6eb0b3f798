from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import PENDULUM, TINY, assert_same, copied, everything, same

from dmsrd_lite.domains import InputError
from dmsrd_lite.method.airl import AIRL
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.method.msrd import MSRD
from dmsrd_lite.method.state import State

LOOKS = {
    "shown": lambda s: s.shown,
    "policies": lambda s: s.policies(),
    "rewards": lambda s: s.rewards(),
    "mixtures": lambda s: s.mixtures(),
    "divergences": lambda s: s.divergences([0], 0, 1),
    "recognized": lambda s: s.recognized(range(3)),
}


@pytest.mark.parametrize("look", LOOKS)
def test_before_the_first_demonstration_there_is_nothing_to_look_at(look):
    with pytest.raises(
        InputError, match=r"^nothing has been learned yet; expected at least one demonstration"
    ):
        LOOKS[look](State(PENDULUM, 0))


@pytest.mark.parametrize("look", LOOKS)
def test_looking_builds_no_learner_and_changes_nothing(look, states, monkeypatch):
    def never(*arguments, **keywords):
        raise AssertionError("a learner was built")

    for learner in (AIRL, MSRD):
        monkeypatch.setattr(learner, "__init__", never)
    before = copied(states[3])
    LOOKS[look](states[3])
    assert same(everything(states[3]), before)


def test_what_explains_each_demonstration(three, states):
    """A pure demonstration is explained by its own strategy alone, and a mixture by the weighted means."""
    state = states[2].explained(three.select([2]), np.array([0.25, 0.75]))
    assert state.weights.tolist() == [[1, 0], [0, 1], [0.25, 0.75]]
    assert (state.pure, state.n_strategies) == ((0, 1), 2)
    x, actor = three.observations[:, 0], state.policies().actor()
    first, second = (actor.select([j] * 3).mean(x) for j in range(2))
    by_hand = [first[0], second[1], 0.25 * first[2] + 0.75 * second[2]]
    assert np.allclose(state.mixtures().mean(x), by_hand, atol=1e-6)
    assert np.allclose(state.mixtures([2]).mean(x[2:]), by_hand[2:], atol=1e-6)
    found = state.divergences([1, 2], 7, 3)
    assert np.array_equal(
        found, policy_divergences(state.mixtures([1, 2]), three.select([1, 2]), 7, n_rollouts=3)
    )


def test_recognized_is_of_the_averaged_rewards_among_some(three, states):
    state, answers = states[2].explained(three.select([2]), np.array([0.25, 0.75])), []
    for sign in (1, -1):  # as learned, and with the opposite rewards
        turned = {k: v * sign if "strategy_reward" in k else v for k, v in state.networks.items()}
        means = (one := replace(state, networks=turned)).rewards().mean_rewards(three)
        for some in ([0, 1], [0, 1, 2]):
            answers += (by_hand := [means[j, some].argmax() == j for j in range(2)])
            assert one.recognized(some).tolist() == by_hand
    assert set(answers) == {True, False}


def test_the_rewards_are_the_averaged_ones_with_the_states_alpha(states):
    last = {k: v + 1 if k.startswith("rewards.") else v for k, v in states[2].networks.items()}
    rewards, x = replace(states[2], networks=last, alpha=0.7).rewards(), np.ones((9, 4)) / 9
    assert states[2].alpha == TINY.msrd.alpha
    assert np.array_equal(rewards.evaluate(x), states[2].rewards().evaluate(x))
    assert torch.equal(rewards.task_reward.weights[0], last["averaged.task_reward.weights.0"])
    total = rewards.evaluate(x, "task") + 0.7 * rewards.evaluate(x)
    assert np.allclose(rewards.evaluate(x, "total"), total, atol=1e-5)


def test_a_new_strategy_stands_behind_the_others_and_shares_the_task_reward(three, states):
    old, before, new = states[2], copied(states[2]), {k: v + 1 for k, v in states[1].networks.items()}
    state = old.with_strategy(three.select([2]), new)
    assert (state.pure, state.weights.tolist()) == ((0, 1, 2), np.eye(3).tolist())
    assert np.array_equal(state.shown.observations, three.observations)
    for name, tensor in state.networks.items():
        shared = ".task_reward." in name
        assert torch.equal(
            tensor, old.networks[name] if shared else torch.cat([old.networks[name], new[name]])
        )
    assert state.networks.keys() == old.networks.keys()
    x = three.observations[:, 0]
    means = state.policies().actor().mean(x)
    assert np.allclose(means[:2], old.policies().actor().mean(x[:2]), atol=1e-6)
    assert same(everything(old), before)
    first = State(PENDULUM, 0).with_strategy(three.select([0]), states[1].networks)
    assert_same(replace(first, records=states[1].records, alpha=states[1].alpha), states[1])
