"""The recorded streams of lesson 08, scored anew from the networks that they stored."""

from pathlib import Path

import numpy as np
import pytest
from conftest import assert_decisions_follow

from dmsrd_lite.demonstrations import load_shipped
from dmsrd_lite.envs import DOMAINS
from dmsrd_lite.lifelong import SETTINGS
from dmsrd_lite.methods import restore, score_method
from dmsrd_lite.runs import RECORDS, load_record

NAMES = sorted(path.stem for path in Path(RECORDS).glob("08_lifelong_*.json"))


@pytest.mark.parametrize("name", NAMES)
class TestStream:
    def test_scores_as_recorded(self, name):
        record, tensors = load_record(name)
        results, domain = record["results"], DOMAINS[record["parameters"]["domain"]]
        everybody = load_shipped(domain, "lifelong")
        shown = everybody.select(results["arrival"])
        assert results["floor"] == np.array(everybody.metadata["floor"])[results["arrival"]].tolist()
        learned = restore(tensors, shown, SETTINGS[domain.name].msrd.alpha, results["pure"])
        scores, row = (
            score_method(learned, shown, None, load_shipped(domain, "test_set"), [record["parameters"]["seed"], 99]),
            results["table"],
        )
        assert scores["divergence"] == pytest.approx(row["divergence"], abs=0.5)  # other machines may round differently
        assert scores["log_likelihood_per_step"] == pytest.approx(row["log_likelihood_per_step"], abs=1e-3)
        assert scores["task_correlation"] == pytest.approx(row["task_correlation"], abs=1e-3)
        assert scores["recognized"] == pytest.approx(row["recognized"])

    def test_every_decision_follows_from_its_numbers(self, name):
        record, tensors = load_record(name)
        results = record["results"]
        assert tensors["weights"].shape == (record["parameters"]["users"], len(results["pure"]))
        assert_decisions_follow(results["records"], len(results["pure"]))
        for number, r in enumerate(results["records"]):
            assert len(r["remembered"]) <= len(results["pure"]) + 1 + (record["parameters"]["remembered"] or number)

    def test_the_audits_cover_everybody_and_nobody_is_forgotten(self, name):
        results = load_record(name)[0]["results"]
        audits = [r["audit"]["kl"] for r in results["records"] if "audit" in r]
        assert [len(kl) for kl in audits] == list(range(10, len(results["records"]) + 1, 10))
        first = np.mean(np.subtract(audits[0], results["floor"][:10]))
        last = np.mean(np.subtract(audits[-1][:10], results["floor"][:10]))
        assert last - first <= 1.0, "the first ten, after all others"
