"""What records stored, restored; and how nearly it must score again.

Another CPU rounds differently. What stored networks say about stored states hardly notices. A rollout does:
rounding grows from step to step, and now and then a policy falls on one machine and not on the other.
"""

from functools import cache

import numpy as np
import pytest

from dmsrd_lite.demonstrations import load_shipped, load_shipped_test_set
from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.evaluation.comparison import METHODS, restore
from dmsrd_lite.workbook import presets
from dmsrd_lite.workbook.records import RECORDS, load_record

LIKELIHOOD = 1e-3  # nats per step: stored networks on stored actions
CORRELATION = 1e-3  # stored networks on 10,000 stored trajectories
FLOOR = 1e-6  # nats: distances between stored states, no network
CEILING = 0.02  # of a correlation: a network is trained anew
DIVERGENCE = 0.3  # nats: new rollouts of policies that seldom fail ...
DIVERGENCE_FAILING = 0.5  # ... and where some fail: rivals, and the hundred users
OTHER_DRAWS = {"inverted_pendulum": (3, 0.5), "lunar_lander": (6, 2.5)}  # rollouts; nats in the mean of five
# Who is recognised must come back exactly: the margins between mean rewards are far wider than rounding.

NAMES = {
    "inverted_pendulum": [*METHODS, *(f"{name}, as in the paper" for name in METHODS[1:])],
    "lunar_lander": list(METHODS),
}
RUNS = [(domain, seed) for domain in NAMES for seed in range(3)]  # of lesson 06
STREAMS = sorted(path.stem for path in RECORDS.glob("08_lifelong_*.json"))

record_of = cache(load_record)


@cache
def demonstrations(domain, kind="demonstrations"):
    return load_shipped(DOMAINS[domain], kind)


@cache
def rewards_test_set(domain, kind="test_set"):
    return load_shipped_test_set(DOMAINS[domain], kind)


def ten_users(domain, seed):
    """Lesson 06: results, what was shown and shown again in the order of arrival, tensors."""
    record, tensors = record_of(f"06_dmsrd_{domain}_seed{seed}")
    arrival = record["results"]["arrival"]
    takes = (demonstrations(domain, kind).select(arrival) for kind in ("demonstrations", "second_take"))
    return record["results"], *takes, tensors


def learned(domain, seed, name):
    """What a method of lesson 06 ended with."""
    results, shown, _, tensors = ten_users(domain, seed)
    kept = {k.removeprefix(f"{name}/"): v for k, v in tensors.items() if k.startswith(f"{name}/")}
    alpha = presets.METHODS[domain].msrd.alpha if "MSRD" in name else 0.0
    return restore(kept, shown, alpha, results["pure"][name])


def stream(name, some=slice(None)):
    """Lesson 08: the record, what ``some`` of its users showed, and what explains them."""
    record, tensors = record_of(name)
    results, domain = record["results"], record["parameters"]["domain"]
    shown = demonstrations(domain, "lifelong").select(np.array(results["arrival"])[some])
    kept = {**tensors, "weights": tensors["weights"][some]}
    return record, shown, restore(kept, shown, presets.METHODS[domain].msrd.alpha, results["pure"])


def assert_equal(scores, row, divergence):
    """New scores are those of the record's row, each within its tolerance."""
    assert scores["divergence"] == pytest.approx(row["divergence"], abs=divergence)
    assert scores["log_likelihood_per_step"] == pytest.approx(row["log_likelihood_per_step"], abs=LIKELIHOOD)
    for key, tolerance in {"task_correlation": CORRELATION, "recognized": 0, "recognized_again": 0}.items():
        expected = np.nan if row[key] is None else row[key]
        assert scores[key] == pytest.approx(expected, abs=tolerance, nan_ok=True), key
