"""The statistics of the comparison: Friedman with Nemenyi, Fisher's z, bootstrap intervals.

As in the paper; Demsar (2006) for ranks and critical differences, Fisher (1921) for correlations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from dmsrd_lite.domains import InputError


@dataclass(frozen=True)
class Ranks:
    """Methods ranked within each demonstration (1 is best), Friedman's test and Nemenyi's for every pair."""

    mean_ranks: np.ndarray  # (k,)
    q: float  # Friedman's statistic, chi-square with k - 1 degrees of freedom
    p: float
    pairwise_p: np.ndarray  # (k, k), 1 on the diagonal
    n: int

    def critical_difference(self, alpha: float = 0.05) -> float:
        """Mean ranks that differ by less are not told apart: ``q_alpha sqrt(k (k + 1) / (6 n))``."""
        k = len(self.mean_ranks)
        studentized = stats.studentized_range.ppf(1 - alpha, k, np.inf) / np.sqrt(2)
        return float(studentized * np.sqrt(k * (k + 1) / (6 * self.n)))


def rank_methods(scores: ArrayLike, larger_is_better: bool = True) -> Ranks:
    """Friedman's test and Nemenyi's post hoc test of scores (n demonstrations, k methods).

    ``|R_i - R_j| / sqrt(k (k + 1) / (6 n))`` of two mean ranks, times sqrt(2), is a studentized range with
    infinitely many degrees of freedom. ``InputError`` for fewer than three methods or two demonstrations, and
    for scores that are not finite.
    """
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 2 or table.shape[0] < 2 or table.shape[1] < 3:
        expected = "expected a row for each of two or more demonstrations and three or more methods"
        raise InputError(f"scores of shape {table.shape}: {expected}")
    if not np.isfinite(table).all():
        raise InputError("scores that are not finite cannot be ranked; expected a number in every cell")
    n, k = table.shape
    ranks = stats.rankdata(-table if larger_is_better else table, axis=1).mean(0)
    if np.ptp(table, axis=1).max() == 0:
        return Ranks(ranks, 0.0, 1.0, np.ones((k, k)), n)
    found = stats.friedmanchisquare(*table.T)
    apart = np.abs(ranks[:, None] - ranks) / np.sqrt(k * (k + 1) / (6 * n))
    pairwise = stats.studentized_range.sf(apart * np.sqrt(2), k, np.inf)
    np.fill_diagonal(pairwise, 1.0)
    return Ranks(ranks, float(found.statistic), float(found.pvalue), pairwise, n)


def compare_correlations(r_1: float, r_2: float, n_1: int, n_2: int) -> tuple[float, float]:
    """z and two-sided p of two independent correlations: ``(atanh r_1 - atanh r_2) / sqrt(1 / (n_1 - 3) + 1 /
    (n_2 - 3))``."""
    for r, n in ((r_1, n_1), (r_2, n_2)):
        if not (abs(r) < 1 and n > 3):
            raise InputError(
                f"a correlation of {r!r} from {n!r} pairs: expected one within -1 and 1, from over 3"
            )
    z = (np.arctanh(r_1) - np.arctanh(r_2)) / np.sqrt(1 / (n_1 - 3) + 1 / (n_2 - 3))
    return float(z), float(2 * stats.norm.sf(abs(z)))


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """95 % bootstrap interval of the mean (percentiles, 2,000 draws)."""
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or len(sample) < 2:
        raise InputError(f"values of shape {sample.shape}: expected two or more numbers in a row")
    found = stats.bootstrap(
        (sample,), np.mean, n_resamples=2000, confidence_level=0.95, method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)
