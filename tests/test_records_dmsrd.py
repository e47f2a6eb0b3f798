"""The three recorded runs of lesson 06, scored anew from the networks that they stored."""

import numpy as np
import pytest

from dmsrd_lite.demonstrations import load_shipped
from dmsrd_lite.discrimination import recognized
from dmsrd_lite.envs import INVERTED_PENDULUM
from dmsrd_lite.methods import METHODS, MethodSettings, restore, score_method
from dmsrd_lite.metrics import demonstration_log_likelihood, divergence_floor
from dmsrd_lite.runs import RECORDS, ROOT, load_record

PAPER = ", as in the paper"
NAMES = [*METHODS, *(m + PAPER for m in METHODS if m != "cloning")]
RUNS = {seed: load_record(f"06_dmsrd_inverted_pendulum_seed{seed}") for seed in range(3)}


def shown(seed):
    """Demonstrations and second takes in the order in which they arrived."""
    arrival = RUNS[seed][0]["results"]["arrival"]
    return [load_shipped(INVERTED_PENDULUM, kind).select(arrival) for kind in ("demonstrations", "second_take")]


def learned(seed, name):
    record, tensors = RUNS[seed]
    kept = {k.removeprefix(f"{name}/"): v for k, v in tensors.items() if k.startswith(f"{name}/")}
    alpha = MethodSettings().msrd.alpha if "MSRD" in name else 0.0
    return restore(kept, shown(seed)[0], alpha, record["results"]["pure"][name])


@pytest.mark.parametrize("seed", RUNS)
class TestRecord:
    def test_form(self, seed):
        record, tensors = RUNS[seed]
        results = record["results"]
        assert record["parameters"] == {"domain": "inverted_pendulum", "preset": "full", "seed": seed}
        assert set(results["table"]) == set(results["pure"]) == set(NAMES)
        assert len(results["records"]) == 10
        assert sorted(results["arrival"]) == list(range(10))
        assert (results["arrival"] == list(range(10))) == (seed == 0)
        assert sum(t.nbytes for t in tensors.values()) < 1_000_000
        assert (RECORDS / f"06_dmsrd_inverted_pendulum_seed{seed}.safetensors").stat().st_size < 1_000_000

    @pytest.mark.parametrize("name", NAMES)
    def test_likelihood_and_recognition_of_every_method(self, seed, name):
        """A mixture's likelihood is that of what is executed; recognition is among all demonstrations."""
        row, kept = RUNS[seed][0]["results"]["table"][name], learned(seed, name)
        demonstrations, _ = shown(seed)
        likelihood = demonstration_log_likelihood(kept.actor(), demonstrations) / demonstrations.horizon
        assert likelihood == pytest.approx(row["log_likelihood_per_step"], abs=1e-3)
        if kept.pure:
            share = recognized(kept.rewards.evaluate(demonstrations.observations).mean((2, 3)), kept.pure).mean()
            assert share == pytest.approx(row["recognized"])
        else:
            assert row["recognized"] is None

    def test_dmsrd_scores_as_recorded_and_as_claimed(self, seed):
        results = RUNS[seed][0]["results"]
        row, (demonstrations, again) = results["table"]["DMSRD"], shown(seed)
        scores = score_method(learned(seed, "DMSRD"), demonstrations, again, load_shipped(INVERTED_PENDULUM, "test_set"), [seed, 99])
        floor = divergence_floor(demonstrations, again)
        assert floor == pytest.approx(results["floor"], abs=1e-6)
        assert scores["divergence"] == pytest.approx(row["divergence"], abs=0.3)  # other machines may round differently
        assert scores["task_correlation"] == pytest.approx(row["task_correlation"], abs=1e-3)
        assert scores["recognized_again"] == pytest.approx(row["recognized_again"])
        own = demonstrations.log_likelihoods.mean(1) / demonstrations.horizon
        assert (scores["divergence"] - floor).mean() <= 0.5
        assert np.abs(scores["log_likelihood_per_step"] - own).mean() <= 0.1
        assert scores["task_correlation"] >= 0.98
        assert scores["recognized"] == 1
        assert scores["failure_share"].max() <= 0.05

    def test_every_decision_follows_from_its_numbers(self, seed):
        results = RUNS[seed][0]["results"]
        known = 0
        for number, r in enumerate(results["records"]):
            if known and r["kl_mix"] <= r["threshold"]:
                assert (r["branch"], r["steps"]["airl"]) == ("mixture", 0)
            elif known and r["kl_mix"] < r["kl_new"]:
                assert r["branch"] == "mixture, better than a new strategy"
            else:
                assert r["branch"] == "new strategy"
                known += 1
            assert r["n_strategies"] == known
            assert len(r["kl_after_round"]) == len(r["kl_before_round"]) == number + 1
        assert known == len(results["pure"]["DMSRD"])

    def test_nobody_is_forgotten(self, seed):
        """After the last arrival everybody is as near as after their own, within half a nat."""
        results = RUNS[seed][0]["results"]
        at_arrival = [r["kl_after_round"][-1] for r in results["records"]]
        last = np.array(results["records"][-1]["kl_after_round"])
        assert (last - at_arrival).mean() <= 0.1
        assert (last - results["floor"]).mean() <= 0.5
        assert np.mean(results["records"][-1]["recognized"]) == 1
        assert min(np.mean(r["recognized"]) for r in results["records"]) >= 0.75, (
            "the updates after a round are limited, so it may miss one"
        )

    def test_mixtures_of_known_people_need_no_new_strategy(self, seed):
        results = RUNS[seed][0]["results"]
        assert len(results["later"]) == 3
        for r, floor in zip(results["later"], results["later_floor"], strict=True):
            assert (r["branch"], r["steps"]["airl"]) == ("mixture", 0)
            assert r["kl_after_round"][-1] <= floor + 0.5

    def test_fresh_policies_balance_on_the_task_reward(self, seed):
        results = RUNS[seed][0]["results"]
        curves = np.array(results["fresh_curves"])
        assert curves.shape[1] == 10
        assert results["fresh_solved"] >= 8
        assert (np.median(curves[-15:], 0) > -0.06).sum() >= 8

    def test_training_stays_within_five_percent_of_the_authors_steps(self, seed):
        row = RUNS[seed][0]["results"]["table"]["DMSRD"]
        assert row["steps"] / len(RUNS[seed][0]["results"]["pure"]["DMSRD"]) <= 0.05 * 6e6


@pytest.mark.parametrize("name", ["cloning", "AIRL Batch", "MSRD"])
def test_rivals_score_as_recorded(name):
    demonstrations, again = shown(0)
    row = RUNS[0][0]["results"]["table"][name]
    scores = score_method(learned(0, name), demonstrations, again, load_shipped(INVERTED_PENDULUM, "test_set"), [0, 99])
    assert scores["divergence"] == pytest.approx(row["divergence"], abs=0.5)
    if name != "cloning":
        assert scores["task_correlation"] == pytest.approx(row["task_correlation"], abs=1e-3)


def readme_rows():
    """The README's table: means over the three runs, and what the rewards know run by run."""
    rows, results = [], [record["results"] for record, _ in RUNS.values()]
    for name in NAMES:
        scores = [r["table"][name] for r in results]
        kl = np.mean([np.subtract(s["divergence"], r["floor"]) for s, r in zip(scores, results, strict=True)])
        own = np.mean([r["own_log_likelihood"] for r in results])
        gap = np.mean([s["log_likelihood_per_step"] for s in scores]) - own
        failures, value = (np.mean([s[key] for s in scores]) for key in ("failure_share", "environment_return"))
        correlation = " / ".join("-" if s["task_correlation"] is None else f"{s['task_correlation']:.3f}" for s in scores)
        known = " / ".join("-" if s["recognized"] is None else f"{s['recognized']:.0%}" for s in scores)
        rows.append(f"| {name} | {kl:.2f} | {gap:.3f} | {failures:.0%} | {value:.1f} | {correlation} | {known} |")
    found = [len(r["pure"]["DMSRD"]) for r in results]
    again = [f"{r['table']['DMSRD']['recognized_again']:.0%}" for r in results]
    fresh = [r["fresh_solved"] for r in results]
    most = [max(r["table"]["DMSRD"][key] / m for r, m in zip(results, found, strict=True)) for key in ("steps", "search_steps")]
    rows.append(f"it found {found[0]}, {found[1]} and {found[2]} strategies")
    rows.append(f"{fresh[0]}, {fresh[1]} and {fresh[2]} of ten fresh policies")
    rows.append(f"{again[0]}, {again[1]} and {again[2]}).")
    rows.append(f"at most {most[0]:,.0f} environment steps per strategy, the mixture search at most {most[1]:,.0f} more")
    return rows


def test_readme_shows_the_recorded_numbers():
    text = " ".join((ROOT / "README.md").read_text().split())
    for row in readme_rows():
        assert row in text


if __name__ == "__main__":
    print("\n".join(readme_rows()))
