"""The recorded streams of lesson 08, scored anew from the networks that they stored."""

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import assert_decisions_follow

from dmsrd_lite.demonstrations import load_shipped
from dmsrd_lite.envs import DOMAINS
from dmsrd_lite.lifelong import SETTINGS
from dmsrd_lite.methods import restore, score_method
from dmsrd_lite.runs import RECORDS, ROOT, load_record

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


def _cells(domain: str, trials: list[dict]) -> list[str]:
    """The README's column of a task, from the results of its trials, trial by trial."""

    def each(number, form: str) -> str:
        return " / ".join(format(number(r), form) for r in trials)

    def ratio(r):
        seconds = [x["seconds"] for x in r["records"]]
        return np.mean(seconds[90:100]) / np.mean(seconds[10:20])

    def lost(r):
        return sum(kl > x["threshold"] for kl, x in zip(r["table"]["divergence"], r["records"], strict=True))

    horizon = DOMAINS[domain].horizon
    return [
        each(lambda r: len(r["pure"]), "d"),
        each(lambda r: np.mean(np.subtract(r["table"]["divergence"], r["floor"])), ".2f"),
        each(lost, "d"),
        each(lambda r: np.mean(r["table"]["log_likelihood_per_step"]) * horizon, ".0f"),
        each(lambda r: np.mean(r["table"]["environment_return"]), ".1f"),
        each(lambda r: np.mean(r["table"]["failure_share"]), ".1%"),
        each(lambda r: r["table"]["task_correlation"], ".3f"),
        each(lambda r: r["table"]["recognized"], ".0%"),
        each(lambda r: r["weight_error"], ".3f"),
        each(ratio, ".2f"),
        each(lambda r: r["stream_seconds"] / 60 if not r["resumed"] else float("nan"), ".1f"),
        each(lambda r: r["peak_gb"], ".2f"),
    ]


ROWS = {
    "strategies found": "5 / 9",
    "KL above the floor (nats)": "12.5 (KL itself)",
    "users above their own threshold at the end": "-",
    "log-likelihood of a trajectory": "-2298.4",
    "return": "-8.0",
    "failures": "-",
    "task reward's correlation with the true return": "0.889",
    "strategies recognised": "100%",
    "mean absolute error of the weights": "-",
    "seconds of the last ten users over those of users 10 to 19": "-",
    "minutes": "-",
    "memory (GB)": "-",
}


def readme_rows() -> list[str]:
    columns = []
    for domain in DOMAINS:
        names = [name for name in NAMES if re.fullmatch(rf"08_lifelong_{domain}_seed\d+", name)]
        columns.append(_cells(domain, [load_record(name)[0]["results"] for name in names]))
    return [f"| {row} | {' | '.join(cells)} | {paper} |" for (row, paper), *cells in zip(ROWS.items(), *columns, strict=True)]


@pytest.mark.skipif(len(NAMES) < 4, reason="the trials are not recorded")
def test_readme_shows_the_recorded_numbers():
    text = " ".join((ROOT / "README.md").read_text().split())
    for row in readme_rows():
        assert row in text


if __name__ == "__main__":
    print(*readme_rows(), sep="\n")
