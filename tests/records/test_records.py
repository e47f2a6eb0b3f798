"""Every record: form, settings, decisions; and a fixed sample of them scored anew (all: ``verify``)."""

import dataclasses

import numpy as np
import pytest
from helpers import assert_decisions_follow
from records import stored

from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.evaluation.comparison import score_method
from dmsrd_lite.evaluation.metrics import demonstration_log_likelihood
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.workbook.records import RECORDS

EVERY = sorted(path.stem for path in RECORDS.glob("*.json"))
SOME = [0, 4, 5, 50, 99]  # of a hundred users: two who are base users, three who are mixtures


def holding(settings, key):
    """The settings, or those within them, that hold ``key``."""
    found = [holding(value, key) for value in settings.values() if isinstance(value, dict)]
    return settings if key in settings else next(filter(None, found), None)


@pytest.mark.parametrize("name", EVERY)
def test_a_record_is_small_and_says_what_made_it(name):
    record, _ = stored.record_of(name)
    assert record["name"] == name
    assert {"domain", "preset", "seed"} <= set(record["parameters"])
    assert {"torch", "mujoco", "python"} <= set(record["versions"])
    assert holding(record["settings"], "discriminator_rate")["ppo"]["learning_rate"] > 0
    assert (RECORDS / f"{name}.safetensors").stat().st_size < 1_000_000


@pytest.mark.parametrize("name", [name for name in EVERY if name[:2] != "02"])
def test_its_numbers_follow_from_its_settings(name):
    """The threshold's margin, and a new strategy's steps: of its iterations and four kinds of coverage."""
    record, _ = stored.record_of(name)
    loop, horizon = holding(record["settings"], "kl_margin"), DOMAINS[record["parameters"]["domain"]].horizon
    airl = loop["airl"]
    steps = (airl["n_iterations"] * airl["episodes"] + 4 * airl["coverage_episodes"]) * horizon
    for r in record["results"]["records"]:
        reference = r["reference"] if "reference" in r else r["own_divergence"]
        assert r["threshold"] - reference == pytest.approx(loop["kl_margin"])
        assert r["steps"]["airl"] == (0 if r["branch"] == "mixture" else steps)


@pytest.mark.parametrize(("domain", "seed"), stored.RUNS)
def test_ten_users(domain, seed):
    results, *_ = stored.ten_users(domain, seed)
    assert set(results["table"]) == set(results["pure"]) == set(stored.NAMES[domain])
    assert sorted(results["arrival"]) == list(range(10))
    assert (results["arrival"] == list(range(10))) == (seed == 0)
    assert_decisions_follow(results["records"], len(results["pure"]["DMSRD"]))
    for number, r in enumerate(results["records"]):
        assert len(r["kl_after_round"]) == len(r["kl_before_round"]) == number + 1


@pytest.mark.parametrize("name", stored.STREAMS)
def test_a_stream(name):
    record, tensors = stored.record_of(name)
    results, used = record["results"], record["parameters"]
    assert tensors["weights"].shape == (used["users"], len(results["pure"]))
    assert_decisions_follow(results["records"], len(results["pure"]))
    for number, r in enumerate(results["records"]):
        assert len(r["remembered"]) <= len(results["pure"]) + 1 + (used["remembered"] or number)
    audits = [r["audit"]["kl"] for r in results["records"] if "audit" in r]
    assert [len(kl) for kl in audits] == list(range(10, used["users"] + 1, 10))
    first, last = (np.mean(np.subtract(kl[:10], results["floor"][:10])) for kl in (audits[0], audits[-1]))
    assert last - first <= 1.0, "nobody is forgotten: the first ten, after all others"


def test_dmsrd_scores_as_recorded():
    """The first run of lesson 06 on the pendulum."""
    results, shown, again, _ = stored.ten_users("inverted_pendulum", 0)
    test_set = stored.rewards_test_set("inverted_pendulum")
    scores = score_method(stored.learned("inverted_pendulum", 0, "DMSRD"), shown, again, test_set, [0, 99])
    stored.assert_equal(scores, results["table"]["DMSRD"], stored.DIVERGENCE)


@pytest.mark.parametrize("name", [name for name in stored.STREAMS if "users40" not in name])
def test_five_of_a_hundred_users_score_as_recorded(name):
    record, shown, learned = stored.stream(name, SOME)
    row = record["results"]["table"]
    likelihood = demonstration_log_likelihood(learned.actor(), shown) / shown.horizon
    recorded = np.array(row["log_likelihood_per_step"])[SOME]
    assert likelihood == pytest.approx(recorded, abs=stored.LIKELIHOOD)
    n, tolerance = stored.OTHER_DRAWS[shown.domain.name]
    alone = dataclasses.replace(shown, domain=shown.domain.on_threads(1))  # no worker processes to start
    found = policy_divergences(learned.actor(), alone, 0, n_rollouts=n)
    assert found.mean() == pytest.approx(np.array(row["divergence"])[SOME].mean(), abs=tolerance)
