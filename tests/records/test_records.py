"""Every record: its form, and the settings that made it."""

from itertools import islice

import numpy as np
import pytest
from records import stored

from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.evaluation import comparison
from dmsrd_lite.evaluation.metrics import reward_correlations, score_policies
from dmsrd_lite.evaluation.worth import able
from dmsrd_lite.learning.networks import under
from dmsrd_lite.learning.policy_optimization import train_policies
from dmsrd_lite.workbook import presets
from dmsrd_lite.workbook.records import RECORDS, settings_of


def holding(settings, key):
    """The settings, or those within them, that hold ``key``."""
    found = [holding(value, key) for value in settings.values() if isinstance(value, dict)]
    return settings if key in settings else next(filter(None, found), None)


@pytest.mark.parametrize("name", sorted(path.stem for path in RECORDS.glob("*.json")))
def test_a_record_is_small_and_says_what_made_it(name):
    record, _ = stored.record_of(name)
    assert record["name"] == name
    assert {"domain", "preset", "seed"} <= set(record["parameters"])
    assert {"torch", "mujoco", "python"} <= set(record["versions"])
    assert holding(record["settings"], "discriminator_rate")["ppo"]["learning_rate"] > 0
    assert (RECORDS / f"{name}.safetensors").stat().st_size < 1_000_000


FROM_NOTHING = sorted(path.stem for path in RECORDS.glob("0[23]_*.json"))


def restored(name, method):
    """A method's policies and rewards, as its record stored them."""
    record, tensors = stored.record_of(name)
    shown = stored.demonstrations(record["parameters"]["domain"])
    return comparison.restore(under(method, tensors), shown, record["results"].get("alpha", 0.0))


@pytest.mark.verify
@pytest.mark.parametrize("name", FROM_NOTHING)
def test_recorded_policies_score_again_as_recorded(name):
    record, _ = stored.record_of(name)
    domain = DOMAINS[record["parameters"]["domain"]]
    shown, seed = stored.demonstrations(domain.name), record["parameters"]["seed"]
    for method, known in record["results"]["table"].items():
        actor = restored(name, method).actor()
        scores = score_policies(actor, shown, [seed, 99])
        likelihood = scores["log_likelihood_per_step"]
        assert likelihood == pytest.approx(known["log_likelihood_per_step"], abs=stored.LIKELIHOOD), method
        spared = np.equal(known["failure_share"], 0) & (scores["failure_share"] == 0)
        close = np.abs(scores["divergence"] - known["divergence"]) < stored.DIVERGENCE
        assert close[spared].sum() >= 0.9 * spared.sum(), f"{method}: of those that never fail"
        n_able, n_known = (able(domain, row).sum() for row in (scores, known))
        assert abs(n_able - n_known) <= 1, f"{method}: one may fall here and not there"


@pytest.mark.verify
@pytest.mark.parametrize("name", FROM_NOTHING)
def test_recorded_rewards_correlate_again_as_recorded(name):
    record, _ = stored.record_of(name)
    test, part = stored.rewards_test_set(record["parameters"]["domain"]), "task" if name[:2] == "03" else "g"
    for label, known in record["results"]["correlations"].items():
        if not label.startswith(("AIRL", "MSRD")):
            continue
        found = reward_correlations(
            test, restored(name, label).rewards.evaluate(test.observations, part)[0].mean(1)
        )
        assert vars(found) == pytest.approx(known, abs=stored.CORRELATION, nan_ok=True)


@pytest.mark.verify
@pytest.mark.parametrize("name", FROM_NOTHING)
def test_fresh_policies_learn_again_as_recorded(name):
    """The whole training takes minutes; its first iterations, which depend on the reward, come back."""
    record, _ = stored.record_of(name)
    domain, seed = DOMAINS[record["parameters"]["domain"]], record["parameters"]["seed"]
    fresh, part = presets.choose(name[:7], domain.name, "full").fresh, "task" if name[:2] == "03" else "g"
    assert settings_of(fresh) == record["settings"]["fresh"]
    for label, known in record["results"]["worth"].items():
        assert np.shape(known["curves"]) == (fresh.n_iterations, fresh.n_strategies)
        if label in record["results"]["table"]:
            rewards = restored(name, label).rewards

            def paid(data, _seed, rewards=rewards):
                return rewards.evaluate(data.observations[:, :, 1:], part)[0]

            steps = islice(train_policies(domain, paid, fresh, seed + 100), 3)
            again = [r["environment_return"] / r["horizon"] for r in steps]
            assert again == pytest.approx(np.array(known["curves"][:3]), abs=stored.FIRST_STEPS), label
