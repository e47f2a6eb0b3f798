"""What a domain is: checks, bounds, threads, and a third domain that a reader writes in a notebook."""

import dataclasses
import inspect

import matplotlib.pyplot as plt
import numpy as np
import pytest

from dmsrd_lite.demonstrations import demonstrations_from, load_demonstrations, save_demonstrations
from dmsrd_lite.demonstrators.diayn import diversity_of
from dmsrd_lite.domains import DOMAINS, LUNAR_LANDER, InputError, get_domain
from dmsrd_lite.domains.domain import Domain, Drawing, Simulator, check_whole, extend
from dmsrd_lite.learning.networks import GaussianPolicies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.airl import AIRL, AIRLSettings, clone_demonstrations
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.workbook.figures import plot_phase


def test_names_numbers_and_seeds():
    with pytest.raises(InputError, match=r"unknown domain 'cartpole': expected one of inverted_pendulum"):
        get_domain("cartpole")
    for bad in ("1.5", "x", -1, None):
        with pytest.raises(InputError, match=f"^seed {bad!r}: expected a whole number of at least 0"):
            check_whole(bad, "seed")
    assert (check_whole("7", "seed"), check_whole(10, "n", 10)) == (7, 10)
    assert (extend(3, 1), extend([3, 1], 2, 4)) == ([3, 1], [3, 1, 2, 4])


@pytest.mark.parametrize("domain", DOMAINS.values(), ids=lambda d: d.name)
def test_names_and_bounds_fit_the_simulator(domain):
    batch = domain.simulator.make_batch(2, 1)
    assert batch.reset(np.array([0, 1])).shape == (2, domain.obs_dim)
    low, high = (np.tile(bound, (2, 1)) for bound in (domain.action_low, domain.action_high))
    assert np.array_equal(domain.clip_action(np.stack([low - 1, high + 1])), [low, high])
    assert [part.shape for part in batch.step(high)] == [(2, domain.obs_dim), (2,), (2,)]
    seen = domain.network_input(np.full((1, domain.obs_dim), 1e9))
    assert np.allclose(seen, np.array(domain.observation_high) / domain.observation_scale)
    assert seen.dtype == np.float32
    on_one = domain.on_threads(1)
    assert on_one.simulator.n_threads == 1
    assert dataclasses.replace(on_one, simulator=domain.simulator) == domain


def point_mass():
    """A third domain: a mass that is pushed along a line, and wants to be in its middle."""

    class Line:
        def __init__(self, n_environments, n_threads):
            self.state = np.zeros((n_environments, 2))

        def reset(self, seeds):
            self.state = np.array([np.random.default_rng(seed).uniform(-1, 1, 2) for seed in seeds])
            return self.state.copy()

        def step(self, actions):
            velocity = self.state[:, 1] + 0.1 * actions[:, 0]
            self.state = np.stack([self.state[:, 0] + 0.1 * velocity, velocity], 1)
            return self.state.copy(), -np.abs(self.state[:, 0]), np.zeros(len(actions), bool)

    return Domain(
        name="point_mass",
        title="Point Mass",
        horizon=60,
        seconds_per_step=0.1,
        observation_names=("position (m)", "velocity (m/s)"),
        observation_low=(-10.0, -5.0),
        observation_high=(10.0, 5.0),
        observation_scale=(1.0, 1.0),
        action_names=("force (N)",),
        action_low=(-1.0,),
        action_high=(1.0,),
        reward_text="-|position| of the new state, in m",
        failure_text="strays",
        failed=lambda states, rewards: np.abs(states[..., 0]) > 5,
        success_return=-20.0,
        simulator=Simulator(Line),
        drawing=Drawing(lambda s: np.zeros((9, 9, 3), np.uint8), (0, 1), (0, 1), ((-2, 2), (-2, 2))),
    )


class TestThirdDomain:
    @pytest.fixture(scope="class")
    def shown(self):
        actor = GaussianPolicies(point_mass(), 2, 0).actor()
        return demonstrations_from(rollout(actor.domain, actor, 3, 0), actor)

    def test_it_is_written_in_under_40_lines(self):
        assert len(inspect.getsource(point_mass).splitlines()) < 40

    def test_it_is_simulated_drawn_and_learned_from(self, shown):
        assert shown.rewards == pytest.approx(-np.abs(shown.observations[:, :, 1:, 0]))
        assert len(plot_phase(shown.domain, shown.observations[:, 0], ax=plt.figure().subplots()).lines) == 4
        cloned = clone_demonstrations(shown, 0, n_steps=100)
        assert np.isfinite(policy_divergences(cloned.actor(), shown, 0)).all()
        settings = AIRLSettings(n_iterations=1, episodes=2, cloning_steps=100, discriminator_steps=2)
        learner = AIRL(shown, settings, 0)
        (record,) = learner.train()
        assert np.isfinite(record["discriminator_loss"]).all()
        assert learner.averaged_rewards.mean_rewards(shown).shape == (2, 2)

    def test_its_file_is_read_where_the_domain_is_given(self, shown, tmp_path):
        path = save_demonstrations(tmp_path / "set.npz", shown)
        again = load_demonstrations(path, shown.domain)
        assert again.domain is shown.domain
        assert np.array_equal(again.observations, shown.observations)
        for other in (None, LUNAR_LANDER):
            with pytest.raises(InputError, match="domain 'point_mass' is unknown; expected one of"):
                load_demonstrations(path, other)

    def test_what_it_does_not_say_is_asked_for(self, shown):
        with pytest.raises(InputError, match="point_mass: says nothing of how people differ; expected"):
            diversity_of(shown.domain)
        with pytest.raises(InputError, match="point_mass: says nothing of how a state is drawn; expected"):
            plot_phase(dataclasses.replace(shown.domain, drawing=None), shown.observations[0])
