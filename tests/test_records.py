"""Recorded runs are checked by computing their results anew from the networks that they stored."""

import numpy as np
import pytest
import torch

from dmsrd_lite.airl import Rewards
from dmsrd_lite.demonstrations import load_shipped
from dmsrd_lite.metrics import correlations_on, divergence_floor, score_policies
from dmsrd_lite.networks import GaussianPolicies
from dmsrd_lite.runs import ROOT, load_record


@pytest.fixture(scope="module")
def record():
    return load_record("02_airl_inverted_pendulum_seed0")


def restore(module, tensors, prefix):
    module.load_state_dict({k.removeprefix(prefix): torch.tensor(v) for k, v in tensors.items() if k.startswith(prefix)})
    return module


def test_form(record):
    stored, tensors = record
    assert stored["parameters"] == {"domain": "inverted_pendulum", "preset": "full", "seed": 0}
    assert {"torch", "mujoco", "python"} <= set(stored["versions"])
    assert stored["results"]["environment_steps"] <= 300_000
    assert sum(t.nbytes for t in tensors.values()) < 1_000_000


def test_airl_single_scores_as_recorded_and_as_claimed(record, domain):
    stored, tensors = record
    shown, again = load_shipped(domain), load_shipped(domain, "second_take")
    policies = restore(GaussianPolicies(domain, 10, 0), tensors, "single.policy.")
    scores = score_policies(policies.actor(), shown, [0, 99])
    results = stored["results"]
    assert scores["log_likelihood_per_step"] == pytest.approx(results["log_likelihood"]["AIRL Single"], abs=1e-3)
    assert scores["divergence"] == pytest.approx(results["kl"]["AIRL Single"], abs=0.3)  # other machines may round differently
    floor = divergence_floor(shown, again)
    assert floor == pytest.approx(results["floor"], abs=1e-6)
    assert (scores["divergence"] <= floor + 1).sum() >= 9
    own = shown.log_likelihoods.mean(1) / shown.horizon
    assert np.abs(scores["log_likelihood_per_step"] - own).mean() <= 0.15
    assert scores["failure_share"].max() <= 0.05


def test_airl_batch_reward_correlates_as_recorded(record, domain):
    stored, tensors = record
    rewards = restore(Rewards(domain, 1, 0.99, [0]), tensors, "batch.reward.")
    correlation = correlations_on(load_shipped(domain, "test_set"), rewards)[0]
    assert correlation == pytest.approx(stored["results"]["correlation"]["AIRL Batch"], abs=1e-3)
    assert correlation >= 0.9


def result_rows(results):
    """The README's result table, made from the record."""
    floor, own = np.array(results["floor"]), np.array(results["own_log_likelihood"])
    rows = []
    for method in ("cloning", "AIRL Single", "AIRL Batch"):
        kl = np.array(results["kl"][method]) - floor
        gap = np.array(results["log_likelihood"][method]) - own
        within = f"{(kl <= 1).sum()} of {len(kl)}"
        failures, value = np.mean(results["failures"][method]), np.mean(results["returns"][method])
        rows.append(f"| {method} | {kl.mean():.2f} | {within} | {gap.mean():.3f} | {failures:.0%} | {value:.1f} |")
    correlation = results["correlation"]
    rows.append(f"correlates {correlation['AIRL Batch']:.3f} with the true return")
    rows.append(f"without coverage {correlation['without coverage']:.3f}")
    rows.append(f"{results['fresh_solved']} of {results['fresh_seeds']} fresh policies")
    rows.append(f"{results['environment_steps']:,} environment steps per user")
    return rows


def test_readme_shows_the_recorded_numbers(record):
    text = " ".join((ROOT / "README.md").read_text().split())
    for row in result_rows(record[0]["results"]):
        assert row in text


def test_a_frozen_reward_teaches_fresh_policies(record):
    results = record[0]["results"]
    curves = np.array(results["fresh_curves"])
    assert curves.shape[1] == results["fresh_seeds"] == 10
    assert results["fresh_solved"] >= 8
    assert (np.median(curves[-15:], 0) > -0.06).sum() >= 8, "the curves must end where the count says, single falls aside"
