"""Settings so small that a test can learn a whole stream, and ways to watch and to compare."""

from dataclasses import replace

import numpy as np
import torch
from helpers import balancers, shown_by

from dmsrd_lite.domains import INVERTED_PENDULUM
from dmsrd_lite.learning.policy_optimization import PPOSettings
from dmsrd_lite.method import dmsrd
from dmsrd_lite.method.airl import AIRLSettings
from dmsrd_lite.method.dmsrd import DMSRDSettings
from dmsrd_lite.method.msrd import MSRDSettings
from dmsrd_lite.method.policy_mixture import MixtureSettings

AIRL_ONE = AIRLSettings(
    n_iterations=2, episodes=1, cloning_steps=20, coverage_episodes=1, coverage_levels=((1, 0), (3, 0)),
    discriminator_steps=2, discriminator_batch=16, replay_samples=30, ppo=PPOSettings(minibatch=25),
)  # fmt: skip
MSRD_ONE = MSRDSettings(**vars(AIRL_ONE), between_class_batch=16)
TINY = DMSRDSettings(
    kl_threshold=1e-3,
    airl=replace(AIRL_ONE, n_iterations=1, cloning_steps=150),
    msrd=replace(MSRD_ONE, n_iterations=1, between_class_extra=2),
    mixture=MixtureSettings(4, 2, search_rollouts=1, n_finalists=2, final_rollouts=2),
    measured_rollouts=2,
    own_rollouts=0,
)
ROUGH = replace(TINY, airl=replace(TINY.airl, cloning_steps=10))  # where no KL of a new strategy counts
GENEROUS = replace(ROUGH, kl_threshold=1e9)  # every mixture will do
PENDULUM = INVERTED_PENDULUM.on_threads(1)


def three_users():
    """Three demonstrations of 50 steps that balance in three places."""
    return replace(shown_by(balancers([-0.4, 0.4, 0.0]), 50), domain=PENDULUM)


def after(state, demonstrations, settings=TINY):
    """What is known after all of them."""
    *_, last = dmsrd.learn(state, demonstrations, settings)
    return last


def same(a, b):
    """Two dictionaries of tensors or arrays, bit for bit."""
    return a.keys() == b.keys() and all(
        a[k].dtype == b[k].dtype and np.array_equal(np.asarray(a[k]), np.asarray(b[k])) for k in a
    )


def everything(state):
    """All arrays and tensors of a state by name."""
    shown = {} if state.demonstrations is None else state.demonstrations.arrays()
    return {"weights": state.weights, **state.networks, **shown}


def assert_same(a, b):
    """Two states bit for bit, but for the time they took."""
    assert (a.domain.name, a.seed, a.pure, a.alpha) == (b.domain.name, b.seed, b.pure, b.alpha)
    assert [{**r, "seconds": 0} for r in a.records] == [{**r, "seconds": 0} for r in b.records]
    assert same(everything(a), everything(b))


def copied(state):
    """A snapshot of ``everything``."""
    return {k: v.clone() if isinstance(v, torch.Tensor) else v.copy() for k, v in everything(state).items()}


def forbid(monkeypatch, *names):
    """Let nothing of these be made: ``(module, name)``."""

    def never(*arguments, **keywords):
        raise AssertionError("must not be made")

    for module, name in names:
        monkeypatch.setattr(module, name, never)


def watch(monkeypatch, module, name):
    """A list that collects every learner ``module.name`` that is made, with what it was given."""
    original, seen = getattr(module, name), []

    def make(demonstrations, settings, seed, **keywords):
        seen.append({"demonstrations": demonstrations, **keywords})
        seen[-1]["learner"] = original(demonstrations, settings, seed, **keywords)
        return seen[-1]["learner"]

    monkeypatch.setattr(module, name, make)
    return seen
