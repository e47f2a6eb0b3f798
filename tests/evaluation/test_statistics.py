import numpy as np
import pytest
from scipy import stats

from dmsrd_lite.domains import InputError
from dmsrd_lite.evaluation.statistics import compare_correlations, mean_interval, rank_methods

# Demsar (2006), table 6: error of C4.5 without and with m, cf and both, on 14 data sets (AUC)
DEMSAR = np.array([
    [0.763, 0.768, 0.771, 0.798], [0.599, 0.591, 0.590, 0.569], [0.954, 0.971, 0.968, 0.967],
    [0.628, 0.661, 0.654, 0.657], [0.882, 0.888, 0.886, 0.898], [0.936, 0.931, 0.916, 0.931],
    [0.661, 0.668, 0.609, 0.685], [0.583, 0.583, 0.563, 0.625], [0.775, 0.838, 0.866, 0.875],
    [1.000, 1.000, 1.000, 1.000], [0.940, 0.962, 0.965, 0.962], [0.619, 0.666, 0.614, 0.669],
    [0.972, 0.981, 0.9751, 0.975], [0.957, 0.978, 0.946, 0.970],
])  # fmt: skip


def test_the_worked_example_of_demsar():
    """Mean ranks 3.143, 2.000, 2.893, 1.964; chi-square 9.28 there, without the correction for ties."""
    found = rank_methods(DEMSAR)
    assert found.mean_ranks == pytest.approx([3.143, 2.000, 2.893, 1.964], abs=1e-3)
    k, n = 4, 14
    uncorrected = 12 * n / (k * (k + 1)) * ((found.mean_ranks**2).sum() - k * (k + 1) ** 2 / 4)
    assert uncorrected == pytest.approx(9.28, abs=0.01)
    assert found.q > uncorrected
    assert found.critical_difference() == pytest.approx(2.569 * np.sqrt(4 * 5 / (6 * 14)), abs=2e-3)
    assert found.critical_difference(0.1) == pytest.approx(2.291 * np.sqrt(4 * 5 / (6 * 14)), abs=2e-3)


def test_nemenyi_says_the_same_as_an_independent_library():
    posthocs = pytest.importorskip("scikit_posthocs")
    for table in (DEMSAR, np.random.default_rng(0).normal(size=(30, 3)) + np.array([0, 0.4, 1.2])):
        oracle = posthocs.posthoc_nemenyi_friedman(table).to_numpy()
        assert rank_methods(table).pairwise_p == pytest.approx(oracle, abs=1e-6)


def test_a_pair_apart_by_the_critical_difference_has_p_of_alpha():
    found = rank_methods(DEMSAR)
    apart = found.critical_difference(0.05) / np.sqrt(4 * 5 / (6 * 14)) * np.sqrt(2)
    assert stats.studentized_range.sf(apart, 4, np.inf) == pytest.approx(0.05)


def test_the_direction_of_better():
    table = np.array([[1.0, 2.0, 3.0], [1.5, 2.5, 9.0]])
    assert rank_methods(table).mean_ranks.tolist() == [3, 2, 1]
    assert rank_methods(table, larger_is_better=False).mean_ranks.tolist() == [1, 2, 3]
    alike = rank_methods(np.ones((5, 3)))
    assert (alike.q, alike.p, alike.pairwise_p.tolist()) == (0.0, 1.0, np.ones((3, 3)).tolist())


@pytest.mark.parametrize(("r", "other", "z"), [(0.614, 0.502, 11.5), (0.614, 0.586, 3.09)])
def test_fishers_z_gives_the_papers_numbers(r, other, z):
    found, p = compare_correlations(r, other, 10_000, 10_000)
    assert found == pytest.approx(z, abs=0.06)
    assert p < 0.01
    assert compare_correlations(other, r, 10_000, 10_000) == (-found, p)


def test_fishers_z_of_equal_correlations_is_standard_normal():
    rng, found = np.random.default_rng(0), []
    for _ in range(400):
        x, y = rng.normal(size=(2, 2, 50))
        r = [np.corrcoef(one)[0, 1] for one in (x, y)]
        found.append(compare_correlations(*r, 50, 50)[0])
    assert stats.kstest(found, "norm").pvalue > 0.01


def test_the_interval_of_a_mean_covers_it():
    rng = np.random.default_rng(0)
    hits = [low < 1.0 < high for low, high in (mean_interval(rng.normal(1, 2, 40)) for _ in range(200))]
    assert 0.89 < np.mean(hits) < 0.99
    assert mean_interval([1.0, 2.0, 3.0]) == mean_interval([1.0, 2.0, 3.0])


BAD = [
    (lambda: rank_methods([[1.0, 2.0]]), "scores of shape (1, 2): expected a row for each of two or more"),
    (lambda: rank_methods([[1, 2, np.nan]] * 3), "scores that are not finite cannot be ranked"),
    (lambda: compare_correlations(1.0, 0.5, 9, 9), "a correlation of 1.0 from 9 pairs: expected one within"),
    (lambda: compare_correlations(0.5, 0.5, 9, 3), "a correlation of 0.5 from 3 pairs: expected one within"),
    (lambda: mean_interval([1.0]), "values of shape (1,): expected two or more numbers in a row"),
]


@pytest.mark.parametrize(("call", "sentence"), BAD)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).startswith(sentence)
