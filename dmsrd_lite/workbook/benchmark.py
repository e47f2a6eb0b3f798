"""Lesson 07's records: who was scored how at which budget, in one table, and what it says of a claim."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.evaluation.comparison import METHODS
from dmsrd_lite.evaluation.statistics import Ranks, compare_correlations, mean_interval, rank_methods
from dmsrd_lite.evaluation.worth import able
from dmsrd_lite.method.dmsrd import BETTER_MIXTURE, MIXTURE
from dmsrd_lite.workbook.presets import BENCHMARK, BenchmarkLesson
from dmsrd_lite.workbook.records import RECORDS, load_record, same_settings

# Per demonstration: what it is called in a table, and whether more is better.
Entry = tuple[str, str, int]  # method, start, budget
METRICS = {
    "environment_return": ("return", True),
    "log_likelihood_per_step": ("log-likelihood", True),
    "divergence": ("KL", False),
}
PUBLISHED = {"published_return": "return", "published_log_likelihood": "log-likelihood", "divergence": "KL"}
CORRELATIONS = {"pearson": "Pearson", "spearman": "Spearman", "spearman_of_good": "Spearman of the good"}
_pearson = itemgetter("pearson")
SHARED = ("AIRL Batch", "MSRD", "DMSRD without BCD", "DMSRD as printed", "DMSRD")  # one reward for all
OURS, RIVALS = ("DMSRD as printed", "DMSRD"), ("AIRL Single", "MSRD")
TRIALS = (0, 1, 2)
DEMONSTRATORS = "the demonstrators"  # their row in a table
VERDICTS = ("holds", "a tie", "does not hold")

# The paper's Table 1: environment return, log-likelihood, KL (as its authors scored them).
PAPER = {
    "inverted_pendulum": {
        "AIRL Single": (-172.7, -11546.0, 4.08),
        "MSRD": (-166.4, -40870.5, 7.67),
        "DMSRD as printed": (-38.5, -6525.0, 4.01),
    },
    "lunar_lander": {
        "AIRL Single": (-11546.0, -15137.8, 71.4),
        "MSRD": (-9895.3, -11124.2, 70.9),
        "DMSRD as printed": (-2405.5, -6723.7, 79.9),
    },
}
# Its tests of these three: Friedman's Q(2) and p, then Nemenyi's p of DMSRD against AIRL Single and MSRD.
PAPER_TESTS = {
    "inverted_pendulum": [
        (29.4, "< .01", "< .01", "< .01"), (16.8, "< .01", "no", "< .01"), (22.2, "< .01", "no", "< .01"),
    ],
    "lunar_lander": [
        (7.8, "< .05", "< .05", "no"), (22.2, "< .01", "< .01", "< .01"), (2.4, ".30", "", ""),
    ],
}  # fmt: skip
PAPER_PEARSON = {"inverted_pendulum": 0.953, "lunar_lander": 0.614}  # of its DMSRD
PAPER_KNOWN = {"inverted_pendulum": (0.57, 1.0), "lunar_lander": (0.83, 1.0)}  # recognised: MSRD, DMSRD


def record_name(domain: str, part: str, trial: int) -> str:
    """Of the record of a part of one trial."""
    return f"07_benchmark_{domain}_{part}_seed{trial}"


@dataclass(frozen=True)
class Benchmark:
    """All that was scored: rows (trial, method, start, budget) -> scores; lists are per demonstration, in
    the trial's order of arrival."""

    domain: Domain
    rows: dict[tuple[int, str, str, int], dict[str, Any]]
    known: dict[int, dict[str, Any]]  # of each trial, in order: arrival, floor, the demonstrators' own scores

    def budgets(self, method: str, start: str) -> list[int]:
        """Those at which every trial scored it."""
        of_any = {budget for _, *who, budget in self.rows if who == [method, start]}
        return sorted(b for b in of_any if all((k, method, start, b) in self.rows for k in self.known))

    def per_trial(self, method: str, start: str, budget: int) -> list[dict[str, Any]]:
        """The scores of every trial; ``InputError`` where the records do not hold this."""
        rows = [(trial, method, start, budget) for trial in self.known]
        if missing := [str(row[0]) for row in rows if row not in self.rows]:
            text = f"{method} from {start} was not scored at {budget:,} steps per demonstration"
            text += f" in trial {', '.join(missing)}"
            held = ", ".join(f"{b:,}" for b in self.budgets(method, start)) or "nothing of it"
            raise InputError(f"{text}; expected one of the budgets that the records hold: {held}")
        return [self.rows[row] for row in rows]

    def values(self, method: str, start: str, budget: int, metric: str) -> np.ndarray:
        """One number for each demonstration of each trial: (trials * n,)."""
        return np.concatenate([row[metric] for row in self.per_trial(method, start, budget)]).astype(float)

    def own(self, name: str) -> np.ndarray:
        """The same of the people themselves: what ``known`` holds of them."""
        return np.concatenate([one[name] for one in self.known.values()])

    @property
    def people(self) -> list[int]:
        """Who each of ``values`` is of."""
        return [person for one in self.known.values() for person in one["arrival"]]

    def difference(self, one: Entry, other: Entry, metric: str) -> tuple[float, float, float]:
        """Mean of one method's minus another's and its 95 % interval (``over_people``)."""
        return over_people(self.values(*one, metric) - self.values(*other, metric), self.people)

    def over_trials(self, entry: Entry, value: Callable[[dict[str, Any]], float]) -> list[float]:
        """A number for each trial."""
        return [float(value(row)) for row in self.per_trial(*entry)]


def by_person(values: ArrayLike, people: ArrayLike) -> np.ndarray:
    """Means over what one person has in several trials, which is not independent: (people,)."""
    return pd.Series(values, dtype=float).groupby(np.asarray(people)).mean().to_numpy()


def over_people(values: ArrayLike, people: ArrayLike) -> tuple[float, float, float]:
    """Mean and 95 % bootstrap interval over people (``by_person``)."""
    each = by_person(values, people)
    return float(each.mean()), *mean_interval(each)


def in_words(values: np.ndarray, people: Sequence[int]) -> str:
    """Mean and 95 % bootstrap interval (``over_people``)."""
    mean, low, high = over_people(values, people)
    digits = 1 if abs(mean) >= 10 else 2
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def collect(domain: Domain, trials: Iterator[tuple[int, dict[str, Any]]]) -> Benchmark:
    """Trial numbers and results of records as one benchmark."""
    rows: dict[tuple[int, str, str, int], dict[str, Any]] = {}
    known: dict[int, dict[str, Any]] = {}
    for trial, results in trials:
        before = known.setdefault(trial, results["known"])
        if before["arrival"] != results["known"]["arrival"]:
            text = "parts that saw other orders of arrival"
            raise InputError(f"trial {trial} has {text}; expected records of one run of the plan")
        for name, by_budget in results["scores"].items():
            method, start = name.split(", ")
            rows |= {(trial, method, start, int(budget)): row for budget, row in by_budget.items()}
    return Benchmark(domain, rows, dict(sorted(known.items())))


def load(domain: Domain, settings: BenchmarkLesson, folder: Path = RECORDS) -> Benchmark:
    """The committed records of all trials; ``InputError`` when one is missing, holds less than its part, or
    was made with other settings or versions than the rest."""
    again, versions = "expected records of one plan: run it again", dict[str, str]()

    def results() -> Iterator[tuple[int, dict[str, Any]]]:
        for trial, part in product(TRIALS, BENCHMARK):
            name = record_name(domain.name, part, trial)
            if not (folder / f"{name}.json").exists():
                plan = f"papermill_runs/plans/benchmark_{domain.name}.toml"
                raise InputError(f"record {name} is missing; expected all trials: run {plan}")
            record, _ = load_record(name, folder)
            said = {key: record["parameters"].get(key) for key in ("domain", "part", "seed")}
            if list(said.values()) != [domain.name, part, trial]:
                raise InputError(f"record {name} says that it is of {said}; expected what its name says")
            if not same_settings(record["settings"], settings):
                raise InputError(f"record {name} was made with other settings than this lesson's; {again}")
            for package, number in record["versions"].items():
                if versions.setdefault(package, number) != number:
                    text = f"was made with {package} {number}, another with {versions[package]}"
                    raise InputError(f"record {name} {text}; {again}")
            for method, start in BENCHMARK[part]:
                rows = record["results"]["scores"].get(f"{method}, {start}", {})
                for budget in settings.scored_at(method, start, part):
                    if str(budget) not in rows:
                        text = f"does not hold {method} from {start} at {budget:,} steps"
                        raise InputError(f"record {name} {text}; {again}")
                if method in SHARED and start == "nothing" and "worth" not in rows[str(settings.main)]:
                    text = f"does not say what the task reward of {method}, {start} teaches"
                    raise InputError(f"record {name} {text}; {again}")
            yield trial, record["results"]

    return collect(domain, results())


def made_by(domain: Domain, folder: Path = RECORDS) -> str:
    """In one sentence: how many states of the code made the records of a domain (their hash of it)."""
    names = [record_name(domain.name, part, trial) for trial, part in product(TRIALS, BENCHMARK)]
    told = [load_record(name, folder)[0].get("source") for name in names]
    states, silent = {one for one in told if one}, told.count(None)
    text = f"{len(told)} records; states of the code that made them: {len(states)}"
    return f"{text}, and {silent} records tell none"


def entries(found: Benchmark, settings: BenchmarkLesson) -> list[Entry]:
    """Who is compared in the tables: every method from each start, at the main budget of that start.

    All rows there are if none has it, as where the control alone was trained.
    """
    pairs = [(method, start, budget) for start, budget in settings.budget_of.items() for method in METHODS]
    at_main = [(m, s, budget) for m, s, budget in pairs if budget in found.budgets(m, s)]
    return at_main or [(method, start, budget) for _, method, start, budget in found.rows]


def verdict(difference: tuple[float, float, float], larger_is_better: bool) -> str:
    """Of a difference to a rival with its interval (mean, low, high)."""
    _, low, high = difference if larger_is_better else tuple(-x for x in (difference[0], *difference[:0:-1]))
    return "holds" if low > 0 else "does not hold" if high < 0 else "a tie"


def first_budget(holds: Callable[[int], str], budgets: Sequence[int]) -> str:
    """A claim over the budget, in words: at which of them it holds."""
    found = {budget: holds(budget) for budget in budgets}
    if len(set(found.values())) == 1:
        return found[budgets[0]]
    where = {text: [f"{b / 1e6:g} M" for b in found if found[b] == text] for text in VERDICTS}
    return "; ".join(f"{text} at {', '.join(at)}" for text, at in where.items() if at)


def _table(entries: Sequence[Entry], line: Callable[[Entry], dict], **others: dict) -> pd.DataFrame:
    """A row for each method and start of which ``line`` says something, then ``others``."""
    rows = {f"{entry[0]}, {entry[1]}": line(entry) for entry in entries} | others
    return pd.DataFrame({name: row for name, row in rows.items() if row}).T.fillna("")


def summary(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """Table 1: for each method, start and budget the means over demonstrations and trials with their 95 %
    intervals, and what the demonstrators reach themselves."""

    def line(entry: Entry) -> dict[str, str]:
        rows = found.per_trial(*entry)
        n = len(rows[0]["divergence"])
        return {
            **{title: in_words(found.values(*entry, m), found.people) for m, (title, _) in METRICS.items()},
            "do the task": f"{np.mean([able(found.domain, row).mean() for row in rows]):.0%}",
            "million steps each": f"{np.mean([row['spent'] for row in rows]) / 1e6:.2f}",
            "search": f"{np.mean([row['search_steps'] for row in rows]) / n / 1e6:.2f}",
        }

    own = {"return": "own_return", "log-likelihood": "own_log_likelihood", "KL": "floor"}
    themselves = {title: in_words(found.own(name), found.people) for title, name in own.items()}
    return _table(entries, line, **{DEMONSTRATORS: themselves})


def as_published(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """The same by the authors' scoring, beside the paper's numbers, and which of them ours beat."""

    def line(entry: Entry) -> dict[str, Any]:
        ours = {t: found.values(*entry, m).mean().round(1) for m, t in PUBLISHED.items()}
        cells = PAPER[found.domain.name].get("DMSRD as printed" if entry[0] == "DMSRD" else entry[0])
        if not cells:
            return ours
        theirs = dict(zip(PUBLISHED.values(), cells, strict=True))
        better = [t for t in theirs if (ours[t] < theirs[t] if t == "KL" else ours[t] > theirs[t])]
        beside = {f"paper: {t}": x for t, x in theirs.items()}
        return {**ours, **beside, "better": ", ".join(better) or "none"}

    own = {t: "floor" if t == "KL" else m for m, t in PUBLISHED.items()}
    themselves = {title: found.own(name).mean().round(1) for title, name in own.items()}
    return _table(entries, line, **{DEMONSTRATORS: themselves})


def ranking(found: Benchmark, entries: Sequence[Entry], metric: str) -> str:
    """Methods and their means, the best first: the least KL, the most of everything else."""
    mean = {entry[0]: found.values(*entry, metric).mean() for entry in entries}
    sign = 1 if metric == "divergence" else -1
    return ", ".join(f"{method} {mean[method]:.2f}" for method in sorted(mean, key=lambda m: sign * mean[m]))


def rescued(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """Whom line 11 of Algorithm 1 explained by a mixture, because AIRL did worse: the two KL, the KL in the
    end, and AIRL Single's at the same budget."""
    lines = []
    for method, start, budget in entries:
        single = budget in found.budgets("AIRL Single", start)
        for trial, row in zip(found.known, found.per_trial(method, start, budget), strict=True):
            for i, r in enumerate(row["decisions"]):
                if r["branch"] == BETTER_MIXTURE:
                    who = (f"{method}, {start}", budget / 1e6, trial, found.known[trial]["arrival"][i])
                    alone = found.rows[trial, "AIRL Single", start, budget] if single else None
                    other = alone["divergence"][i] if alone else np.nan
                    lines.append([*who, r["kl_mix"], r["kl_new"], row["divergence"][i], other])
    header = ["run", "M steps", "trial", "person", "mixture", "dropped AIRL", "in the end", "AIRL Single"]
    return pd.DataFrame(lines, columns=header).round({name: 1 for name in header[4:]})


def ranks(found: Benchmark, entries: Sequence[Entry], metric: str, of_people: bool = True) -> Ranks:
    """The methods ranked within each person, whose trials are averaged first; or, as the paper seems to do,
    within each person of each trial."""
    table = [found.values(*entry, metric) for entry in entries]
    rows = [by_person(values, found.people) for values in table] if of_people else table
    return rank_methods(np.array(rows).T, METRICS[metric][1])


def friedman(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """The paper's tests of AIRL Single, MSRD and DMSRD as printed, for each start and score, with its own."""
    lines = {}
    for start in dict.fromkeys(start for _, start, _ in entries):
        three = [e for e in entries if e[1] == start and e[0] in (*RIVALS, OURS[0])]
        if len(three) < 3:
            continue
        at = {e[0]: i for i, e in enumerate(three)}
        tests = PAPER_TESTS[found.domain.name]
        for (metric, (title, _)), (q, p, *pairs) in zip(METRICS.items(), tests, strict=True):
            result, of_people = ranks(found, three, metric, False), ranks(found, three, metric)
            told = {"Q(2)": round(result.q, 1), "paper's Q": q, "p": round(result.p, 3), "paper's p": p}
            told["p, people"] = round(of_people.p, 3)
            for rival, theirs in zip(RIVALS, pairs, strict=True):
                told[f"p against {rival}"] = round(result.pairwise_p[at[rival], at[OURS[0]]], 3)
                told[f"paper's against {rival}"] = theirs
            mean_ranks = {f"rank of {m}": round(result.mean_ranks[k], 2) for m, k in at.items()}
            lines[f"{title}, {start}"] = told | mean_ranks
    return pd.DataFrame(lines).T


def correlations(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """What each task reward knows of the true return; one number for each trial."""

    def line(entry: Entry) -> dict[str, str]:
        if "pearson" not in found.per_trial(*entry)[0]:
            return {}
        numbers = {t: found.over_trials(entry, itemgetter(k)) for k, t in CORRELATIONS.items()}
        return {t: ", ".join(f"{x:.3f}" for x in values) for t, values in numbers.items()}

    return _table(entries, line)


def fisher(found: Benchmark, entries: Sequence[Entry], n: int) -> pd.DataFrame:
    """Fisher's z of DMSRD's correlation against its rivals', trial by trial; ``n`` trajectories."""
    lines = {}
    for one in (e for e in entries if e[0] in OURS):
        for other in (e for e in entries if e[1] == one[1] and e[0] in SHARED[:3]):
            pairs = zip(*(found.over_trials(e, _pearson) for e in (one, other)), strict=True)
            z = [compare_correlations(a, b, n, n)[0] for a, b in pairs]
            lines[f"{one[0]} - {other[0]}, {one[1]}"] = dict(zip(found.known, z, strict=True))
    return pd.DataFrame(lines).T.round(1)


def teaching(found: Benchmark, entries: Sequence[Entry], controls: dict[int, Any]) -> pd.DataFrame:
    """How many fresh policies do the task after training on each frozen reward, and the mean return of all;
    ``controls``: by trial the same of a reward that was fitted to true returns, or None."""

    def told(of_trials: Sequence[dict | None]) -> dict[str, str]:
        tried = {t: one for t, one in zip(found.known, of_trials, strict=True) if one}
        if not tried:
            return {}
        counts = {t: (able(found.domain, one).sum(), len(one["failure_share"])) for t, one in tried.items()}
        returns = np.concatenate([one["environment_return"] for one in tried.values()])
        of_each = {f"trial {trial}": f"{count} of {n}" for trial, (count, n) in counts.items()}
        return {**of_each, "return": f"{returns.mean():.1f}"}

    def line(entry: Entry) -> dict[str, str]:
        return told([row.get("worth") for row in found.per_trial(*entry)])

    return _table(entries, line, control=told([controls.get(trial) for trial in found.known]))


def recognition(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """How many strategy rewards rank their own person first, by the takes they are asked on; all trials."""

    def line(entry: Entry) -> dict[str, str]:
        takes = found.per_trial(*entry)[0].get("recognized_fresh", ())
        return {take: _counted(found, entry, take) for take in takes}

    return _table(entries, line)


def _counted(found: Benchmark, entry: Entry, take: str) -> str:
    """How many of how many strategy rewards know their person on these takes, all trials together."""
    rows = found.per_trial(*entry)
    return f"{sum(row['recognized_fresh'][take] for row in rows)} of {sum(len(row['pure']) for row in rows)}"


def cost(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """What was created, which branches were taken, what it took (a number for each trial, or means), and the
    part of the plan that holds it."""
    part_of = {pair: part for part, pairs in reversed(BENCHMARK.items()) for pair in pairs}

    def line(entry: Entry) -> dict[str, str]:
        rows = found.per_trial(*entry)
        counts = {
            "strategies": [len(row["pure"]) for row in rows],
            "mixtures": [sum(r["branch"] == MIXTURE for r in row["decisions"]) for row in rows],
            "by line 11": [sum(r["branch"] == BETTER_MIXTURE for r in row["decisions"]) for row in rows],
        }
        mean = {k: np.mean([row[k] for row in rows]) for k in ("steps", "search_steps", "seconds")}
        return {
            **{k: ", ".join(map(str, v)) if rows[0]["decisions"] else "" for k, v in counts.items()},
            "million steps": f"{mean['steps'] / 1e6:.2f}",
            "million search steps": f"{mean['search_steps'] / 1e6:.2f}",
            "minutes": f"{mean['seconds'] / 60:.2f}",
            "record": part_of[entry[:2]],
        }

    return _table(entries, line)


def newcomers(found: Benchmark, entries: Sequence[Entry]) -> pd.DataFrame:
    """What a person costs at arrival: explained by a mixture, or AIRL trained; and who does the task in the
    end."""
    header = ["run", "explained", "search", "AIRL", "round", "seconds", "pure", "does the task"]
    lines = []
    for method, start, budget in entries:
        for row in found.per_trial(method, start, budget):
            can = able(found.domain, row)
            for i, r in enumerate(row["decisions"]):
                how, k = "AIRL trained" if r["steps"]["airl"] else "a mixture", r["steps"]
                spent = (x / 1e3 for x in (k["search"], k["airl"], k["msrd"] + k["between_class"]))
                who = f"{method}, {start}", how
                lines.append([*who, *spent, r["seconds"], float(i in row["pure"]), can[i]])
    if not lines:
        return pd.DataFrame(columns=header[2:])
    groups = pd.DataFrame(lines, columns=header).groupby(["run", "explained"])
    return pd.concat([groups.size().rename("people"), groups.mean(numeric_only=True)], axis=1).round(2)


def _of_newcomers(
    found: Benchmark, entry: Entry, alone: Entry
) -> Iterator[tuple[str, str, tuple[float, float, float], bool]]:
    """Claims 6 and 8, person by person against AIRL Single: number, claim, difference, and is more better;
    steps are all those at the arrival (search, AIRL and the round that follows), in millions."""
    does, mixed, everybody, n_able = [], [], [], 0
    for trial, row, other in zip(found.known, found.per_trial(*entry), found.per_trial(*alone), strict=True):
        can, others = (able(found.domain, one).astype(float) for one in (row, other))
        for i, (who, r) in enumerate(zip(found.known[trial]["arrival"], row["decisions"], strict=True)):
            steps = (sum(r["steps"].values()) - other["spent"]) / 1e6
            everybody.append((steps, who))
            if i not in row["pure"]:
                does.append((can[i] - others[i], who))
                n_able += int(can[i])
            mixed += [(steps, who)] if r["steps"]["airl"] == 0 else []
    for number, claim, gaps, larger in (
        ("6", f"mixtures do the task ({n_able} of {len(does)})", does, True),
        ("8", "who needs no AIRL costs fewer million steps", mixed, False),
        ("8", "a new user costs fewer million steps", everybody, False),
    ):
        values, people = zip(*gaps, strict=True) if gaps else ((), ())
        if len(set(people)) > 2:  # fewer are no evidence
            yield number, claim, over_people(values, people), larger


def best_rival(found: Benchmark, start: str, budget: int, metric: str) -> Entry:
    """AIRL Single or MSRD, whichever is better by the mean, as in the paper."""
    sign = 1 if METRICS[metric][1] else -1
    rivals: list[Entry] = [(rival, start, budget) for rival in RIVALS]
    return max(rivals, key=lambda e: sign * found.values(e[0], e[1], e[2], metric).mean())


def _with_interval(gap: tuple[float, float, float]) -> str:
    return f"{gap[0]:+.2f} [{gap[1]:+.2f}, {gap[2]:+.2f}]"


def _of_scores(found: Benchmark, entry: Entry, there: dict[str, Entry]) -> Iterator[tuple[str, ...]]:
    """Claims 1 and 2 and the KL, against the better rival; from a clone against cloning, too."""
    method, start, budget = entry
    shared = [b for b in found.budgets(method, start) if b in found.budgets(RIVALS[0], start)]
    for number, (metric, (title, larger)) in zip("12-", METRICS.items(), strict=True):

        def gap_to_best(b: int, metric: str = metric) -> tuple[float, float, float]:
            return found.difference((method, start, b), best_rival(found, start, b, metric), metric)

        def told(b: int, gap: Callable = gap_to_best, larger: bool = larger) -> str:
            return verdict(gap(b), larger)

        if set(RIVALS) <= set(there):
            gap, rival = gap_to_best(budget), best_rival(found, start, budget, metric)
            numbers = _with_interval(gap)
            if number == "1":  # of a likelihood a share means nothing: its zero depends on units
                numbers += f" ({gap[0] / abs(found.values(*rival, metric).mean()):+.0%})"
            over = first_budget(told, shared)
            yield number, f"better {title}", rival[0], numbers, verdict(gap, larger), over
        if "cloning" in there:
            gap = found.difference(entry, there["cloning"], metric)
            yield "-", f"better {title}", "cloning", _with_interval(gap), verdict(gap, larger), ""


def _by_trials(
    found: Benchmark, one: Entry, other: Entry, value: Callable[[dict[str, Any]], float]
) -> tuple[list[float], str]:
    """Differences of a number, trial by trial, and the verdict: more is better, in all trials or a tie."""
    pairs = zip(*(found.over_trials(e, value) for e in (one, other)), strict=True)
    gaps = [a - b for a, b in pairs]
    return gaps, verdict((0.0, min(gaps), max(gaps)), True)


def _recognized(most: int, row: dict[str, Any]) -> float:
    """Share of the strategy rewards that know their person on ``most`` fresh takes."""
    return row["recognized_fresh"][str(most)] / len(row["pure"])


def _of_rewards(
    found: Benchmark, entry: Entry, there: dict[str, Entry], most: int
) -> Iterator[tuple[str, ...]]:
    """Claims 3, 4 and 5, trial by trial; what BCD does only of ours, which has a twin without it."""
    correlation, known, twin = _pearson, partial(_recognized, most), "DMSRD without BCD"
    share = "a larger share of its strategies recognised"
    claims: list[tuple[str, str, str, Callable]] = [
        ("3", "stronger correlation", "AIRL Batch", correlation),
        ("3", "stronger correlation", "MSRD", correlation),
        ("4", share, "AIRL Single", known),
        ("4", share, "MSRD", known),
    ]
    if entry[0] == "DMSRD":
        claims.append(("4", share, twin, known))
        claims.append(("5", "BCD: stronger correlation", twin, correlation))
    for number, says, rival, value in claims:
        if rival in there:
            gaps, told = _by_trials(found, entry, there[rival], value)
            numbers = ", ".join(f"{gap:+.{2 if number == '4' else 3}f}" for gap in gaps)
            if number == "4":
                numbers += " ({} against {})".format(
                    *(_counted(found, e, str(most)) for e in (entry, there[rival]))
                )
            yield number, says, rival, numbers, told, ""


def equal_steps(found: Benchmark, settings: BenchmarkLesson) -> pd.DataFrame:
    """The control of what DMSRD's rounds cost: AIRL Single with the steps for each person that DMSRD's AIRL
    has, beside DMSRD and AIRL Single with the usual budget; DMSRD's minus the control's, and the verdict."""
    table = {}
    for start, budget in settings.budget_of.items():
        control, ours = ("AIRL Single", start, settings.share(start)), ("DMSRD", start, budget)
        rows = {"AIRL Single, fewer steps": control, "DMSRD": ours, "AIRL Single": (*control[:2], budget)}
        if all(entry[2] in found.budgets(*entry[:2]) for entry in rows.values()):
            for metric, (title, larger) in METRICS.items():
                means = {name: f"{found.values(*e, metric).mean():.2f}" for name, e in rows.items()}
                gap = found.difference(ours, control, metric)
                told = {"difference": _with_interval(gap), "better": verdict(gap, larger)}
                table[f"{title}, {start} ({control[2] / 1e6:.2f} M)"] = means | told
    return pd.DataFrame(table).T


def lost(found: Benchmark, entries: Sequence[Entry], settings: BenchmarkLesson) -> pd.DataFrame:
    """Every score that DMSRD loses to somebody from the same start, and what the records say of the reason.

    Of a person's score against AIRL Single: are the steps that the rounds take enough (``equal_steps``)?
    Against others: does AIRL Single lose it, too, so that neither strategies nor mixtures are to blame? If
    not: is it lost by those who became a strategy of their own? Of the task reward: does the twin without BCD
    lose it? "Enough" and "not lost" are what the interval allows, no proof.
    """
    twin = "DMSRD without BCD"

    def of_strategies(one: Entry, other: Entry, metric: str) -> bool:
        rows = found.per_trial(*one)
        own = np.concatenate([np.isin(np.arange(len(row[metric])), row["pure"]) for row in rows])
        if own.sum() < 2:
            return True
        gaps = (found.values(*one, metric) - found.values(*other, metric))[own]
        return verdict(over_people(gaps, np.array(found.people)[own]), METRICS[metric][1]) == VERDICTS[2]

    def loses(one: Entry, other: Entry, metric: str) -> bool:
        if metric == "pearson":
            return _by_trials(found, one, other, _pearson)[1] == VERDICTS[2]
        return verdict(found.difference(one, other, metric), METRICS[metric][1]) == VERDICTS[2]

    def why(one: Entry, there: dict[str, Entry], rival: str, metric: str) -> str:
        other, control = there[rival], ("AIRL Single", one[1], settings.share(one[1]))
        if metric == "pearson":
            if one[0] == "DMSRD" and twin in there:
                also = loses(there[twin], other, metric)
                return "not BCD: without it, too" if also else "BCD: without it this is not lost"
        elif rival == "AIRL Single":
            asked = one[0] == "DMSRD" and control[2] in found.budgets(*control[:2])
            if asked and not loses(one, control, metric):
                return "the missing steps are enough"
        elif "AIRL Single" in there and loses(there["AIRL Single"], other, metric):
            return "AIRL Single loses it, too"
        if metric in METRICS and not of_strategies(one, other, metric):
            return "strategies do not lose it, mixtures do"
        return "not known"

    titles, lines = {m: title for m, (title, _) in METRICS.items()} | {"pearson": "Pearson of R_Task"}, []
    for one in (e for e in entries if e[0] in OURS):
        there = {e[0]: e for e in entries if e[1] == one[1]}
        for rival in (name for name in there if name not in (*OURS, twin)):
            for metric, title in titles.items():
                if (metric in METRICS or rival in SHARED) and loses(one, there[rival], metric):
                    lines.append((f"{one[0]}, {one[1]}", rival, title, why(one, there, rival, metric)))
    return pd.DataFrame(lines, columns=["method", "loses to", "in", "because"]).set_index("method")


def standing(found: Benchmark, entries: Sequence[Entry], most: int) -> pd.DataFrame:
    """Is DMSRD better, tied or worse, score by score, against each rival from the same start? By the interval
    over people, of rewards by all trials."""
    table: dict[str, dict[str, str]] = {}
    words = {"holds": "better", "does not hold": "worse", "a tie": "a tie"}
    of_rewards: dict[str, Callable] = {
        "Pearson of R_Task": _pearson,
        "recognised": partial(_recognized, most),
    }
    for entry in (e for e in entries if e[0] in OURS):
        for rival in (e for e in entries if e[1] == entry[1] and e[0] in (*RIVALS, "AIRL Batch")):
            told = {t: verdict(found.difference(entry, rival, m), up) for m, (t, up) in METRICS.items()}
            for title, value in of_rewards.items():
                if rival[0] in SHARED if value is _pearson else rival[0] != "AIRL Batch":  # who has which
                    _, told[title] = _by_trials(found, entry, rival, value)
            table[f"{entry[0]} against {rival[0]}, {entry[1]}"] = {k: words[v] for k, v in told.items()}
    return pd.DataFrame(table).T.fillna("")


def verdicts(found: Benchmark, entries: Sequence[Entry], most: int) -> pd.DataFrame:
    """The paper's claims that can be tested here, from the records; ``most`` fresh takes for claim 4."""
    lines: list[tuple[str, ...]] = []
    for entry in (e for e in entries if e[0] in OURS):
        there = {e[0]: e for e in entries if e[1] == entry[1]}
        told = [*_of_scores(found, entry, there), *_of_rewards(found, entry, there, most)]
        if "AIRL Single" in there:
            for number, says, gap, larger in _of_newcomers(found, entry, there["AIRL Single"]):
                told.append((number, says, "AIRL Single", _with_interval(gap), verdict(gap, larger), ""))
        lines += [(number, f"{entry[0]}, {entry[1]}", *rest) for number, *rest in told]
    header = ["claim", "method", "says", "against", "difference", "verdict", "over the budget"]
    return pd.DataFrame(lines, columns=header).set_index("claim")


def in_short(table: pd.DataFrame) -> str:
    """What ``verdicts`` says, in a few lines for each method and start."""
    text = []
    for method, rows in table.groupby("method", sort=False):
        text.append(f"{method}")
        for told, some in rows.groupby("verdict", sort=False):
            text.append(
                f"    {told} ({len(some)}): "
                + "; ".join(f"{a} ({b})" for a, b in some[["says", "against"]].values)
            )
    return "\n".join(text)
