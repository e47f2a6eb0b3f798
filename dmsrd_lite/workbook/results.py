"""What the records say: one tidy CSV, ``RESULTS.md`` made of it, and the table of the lessons' parameters."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dmsrd_lite.demonstrations import write_atomically
from dmsrd_lite.domains import DOMAINS, Domain, InputError
from dmsrd_lite.evaluation.worth import able
from dmsrd_lite.workbook import benchmark
from dmsrd_lite.workbook.lessons import lessons
from dmsrd_lite.workbook.presets import choose
from dmsrd_lite.workbook.records import RECORDS, ROOT, load_record

README = ROOT / "papermill_runs" / "README.md"
BEGIN, END = "<!-- parameters: made by python -m dmsrd_lite results -->", "<!-- end of parameters -->"
SHOWN = {
    "able": "do the task (share)",
    "environment_return": "return",
    "divergence_above_floor": "KL above the floor (nats)",
    "log_likelihood_above_own": "log-likelihood above the demonstrator's own (nats per step)",
    "sigma": "sigma",
    "published_return": "return as published",
    "published_log_likelihood": "log-likelihood as published",
    "pearson": "Pearson",
    "spearman": "Spearman",
    "spearman_of_good": "Spearman among those that do not fail",
    "steps": "steps in all",
    "strategies": "strategies",
    "recognized_on_shown": "recognised on what was shown (share)",
    **{f"recognized_on_{k}": f"on {k} fresh takes" for k in (3, 10, 30)},
    "weight_error": "error of the weights",
}
NO_METRICS = (
    "curve", "curves", "decisions", "branches", "pure", "weights", "paid", "paid_shown",
    "order", "kept", "kl_of_kept", "looks", "threshold", "searched_again",
)  # fmt: skip
COLUMNS = ("record", "lesson", "domain", "seed", "method", "metric", "value")


def write_results(folder: Path | None = None) -> list[Path]:
    """Write ``RESULTS.md``, ``results.csv`` and the README of the runs: in place, or in ``folder``."""
    table = pd.DataFrame(numbers(), columns=COLUMNS)
    text = table.round(6).to_csv(index=False, lineterminator="\n")
    made = {ROOT / "RESULTS.md": page(table), RECORDS / "results.csv": text, README: parameters()}
    places = {folder / path.name if folder else path: text for path, text in made.items()}
    return [write_atomically(path, text.encode()) for path, text in places.items()]


def numbers() -> Iterator[tuple]:
    """Every number of every record (``COLUMNS``); the mean where there is one for each demonstration."""
    stems = {path.stem[:2]: path.stem for path in lessons()}
    for path in sorted(RECORDS.glob("*.json")):
        (record, _), stem = load_record(path.stem), path.stem
        name, seed = record["parameters"]["domain"], record["parameters"]["seed"]
        for method, metric, value in _numbers(record, DOMAINS[name]):
            if value is not None:
                yield stem, stems[stem[:2]], name, seed, method, metric, float(np.mean(value))


def _numbers(record: dict, domain: Domain) -> Iterator[tuple[str, str, Any]]:
    """Method, metric, and value or values, of a record's results."""
    r, few = record["results"], record["settings"].get("few")
    if "rows" in r:
        yield from _searches(r["rows"])
        return
    if "n_fresh" in r:
        yield from _recognition(r["table"])
        return
    if "scores" in r:  # lesson 07
        known = [np.array(r["known"][name]) for name in ("floor", "own_log_likelihood")]
        for method, by_budget in r["scores"].items():
            for budget, scores in by_budget.items():
                yield from _scores(f"{method}, {int(budget) / 1e6:g} M steps", scores, domain, *known)
        return
    if "recognition" in r:  # lesson 06
        most = record["settings"]["n_fresh"][-1]
        for run, by_source in r["recognition"].items():
            for source, count in by_source.items():
                if source != "of":
                    yield f"ours, {run}: {source}", f"recognized_on_{most}", count / by_source["of"]
        return
    if "lived" in r:  # lesson 08, a thousand users: one row each
        yield "ours, a thousand users", "strategies", len(r["pure"])
        yield "ours, a thousand users", "pearson", r["looks"][-1]["pearson"]
        return
    if "drift" in r:  # lesson 09
        for row in r["drift"]:
            yield f"reward: {row['reward']}", "pearson", row["Pearson"]
            yield f"fresh policies on: {row['reward']}", "able", row["of ten"] / 10
        first, second = record["settings"]["pair"]
        for metric in ("KL(wants || acts)", "KL(acts || wants)", "return, wants", "return, acts"):
            values = r["wanting"][metric]
            for share, value in zip(np.linspace(0, 1, len(values)), values, strict=True):
                yield f"{1 - share:g} of {first}, {share:g} of {second}", metric, value
        return
    floor, own = np.array(r["floor"]), np.array(r["own_log_likelihood"])
    for k, scores in enumerate(r.get("orders", ())):
        yield from _scores(f"ours, order {k}", scores, domain, floor[scores["order"]], own[scores["order"]])
    if "orders" in r:
        return
    yield "demonstrator", "divergence", floor
    yield "demonstrator", "log_likelihood_per_step", own
    for method, scores in r.get("table", {}).items():
        yield from _scores(method, scores, domain, floor, own)
    for name, scores in r.get("ablations", {}).items():
        start = "" if name.endswith("nothing") else ", clone"
        yield from _scores(f"ours{start}: {name}", scores, domain, floor, own)
    for name, scores in r.get("variants", {}).items():
        yield from _scores(f"variant: {name}", scores, domain, floor[few], own[few])
    for name, scores in {**r.get("worth", {}), **r.get("ingredients", {})}.items():
        yield from _scores(f"fresh policies on: {name}", scores, domain, None, None)
    for name, found in r.get("correlations", {}).items():
        yield from ((f"reward: {name}", kind, value) for kind, value in found.items())


def _scores(
    method: str, scores: dict, domain: Domain, floor: np.ndarray | None, own: np.ndarray | None
) -> Iterator[tuple[str, str, Any]]:
    """The metrics of one row, and what follows from them."""
    for metric, value in scores.items():
        if metric == "recognized_fresh":
            yield from (
                (method, f"recognized_on_{take}", n / len(scores["pure"])) for take, n in value.items()
            )
        elif metric == "worth":  # lesson 07
            yield from _scores(f"fresh policies on: {method}", value, domain, None, None)
        elif metric not in NO_METRICS:
            yield method, metric, value
    yield method, "able", able(domain, scores)
    if scores.get("pure") is not None and "branches" in scores:  # Algorithm 1
        yield method, "strategies", len(scores["pure"])
    if floor is not None and own is not None:
        yield method, "divergence_above_floor", np.subtract(scores["divergence"], floor)
        yield method, "log_likelihood_above_own", np.subtract(scores["log_likelihood_per_step"], own)


def _searches(rows: list[dict]) -> Iterator[tuple[str, str, Any]]:
    """Lesson 04: where each search ended, by the number of known people."""
    table = pd.DataFrame(rows)
    last = table[(table["budget"] == table["budget"].max()) | (table["budget"] == 0)]
    for (known, search), found in last.groupby(["known", "search"], sort=False):
        method = f"{search}, {known} known"
        yield method, "divergence_above_floor", found["above_floor"]
        yield method, "weight_error", found["error"]
        yield method, "steps", found["steps"]


def _recognition(table: dict[str, dict]) -> Iterator[tuple[str, str, Any]]:
    """Lesson 05: the share of strategy rewards that know their person, and R_Task's correlation."""
    for method, row in table.items():
        for take, n in row["recognized"].items():
            yield method, f"recognized_on_{take.removesuffix(' fresh')}", n / len(row["means"][take])
        yield method, "pearson", row["task"]


def page(table: pd.DataFrame) -> str:
    """``results.md`` with the table of the records in its place: for each lesson and domain one row for each
    method, means over seeds."""
    parts = []
    for (lesson, domain), found in table.groupby(["lesson", "domain"], sort=False):
        rows = found.pivot_table("value", "method", "metric", sort=False)
        shown = [name for name in SHOWN if name in rows]
        seeds = found.groupby("method")["seed"].nunique()
        parts.append(f"### {lesson}, {DOMAINS[domain].title}\n")
        parts.append(f"| method | seeds | {' | '.join(SHOWN[name] for name in shown)} |")
        parts.append("|---" * (len(shown) + 2) + "|")
        for method, row in rows[rows[shown].notna().any(axis=1)].iterrows():
            cells = ["-" if np.isnan(row[name]) else f"{row[name]:.3g}" for name in shown]
            line = [str(method).replace("|", chr(92) + "|"), str(seeds[method]), *cells]
            parts.append(f"| {' | '.join(line)} |")
        parts.append("")
        if lesson == "07_benchmark":
            parts += [*_benchmark(DOMAINS[domain])]
    text = "\n".join(parts).strip() or "*No record yet.*"
    return Path(__file__).with_suffix(".md").read_text("utf-8").replace("{records}", text)


def _benchmark(domain: Domain) -> Iterator[str]:
    """The tables of lesson 07, by its own functions, when all its trials are there."""
    settings = choose("07_benchmark", domain.name, "full")
    try:
        found = benchmark.load(domain, settings)
    except InputError as error:
        yield f"No table with intervals and no verdict yet: {error}.\n"
        return
    entries, most = benchmark.entries(found, settings), settings.n_fresh[-1]
    for title, table in (
        ("Means over people and trials with 95 % bootstrap intervals", benchmark.summary(found, entries)),
        ("DMSRD against each rival", benchmark.standing(found, entries, most)),
        ("The paper's claims", benchmark.verdicts(found, entries, most)),
    ):
        yield f"*{title}.*\n"
        rows = table.reset_index().rename(columns={"index": ""})
        yield f"| {' | '.join(map(str, rows))} |"
        yield "|---" * rows.shape[1] + "|"
        yield from (f"| {' | '.join(map(str, row))} |" for row in rows.to_numpy())
        yield ""


def parameters() -> str:
    """``papermill_runs/README.md`` with the table of every lesson's parameters between its marker lines."""
    from papermill import inspect_notebook

    rows = ["| lesson | parameter | type | default | what it is |", "|---|---|---|---|---|"]
    for path in lessons():
        for name, p in inspect_notebook(str(path)).items():
            cells = f"`{name}`", p["inferred_type_name"], f"`{p['default']}`", p["help"]
            rows.append(f"| [{path.stem}](../notebooks/{path.name}) | {' | '.join(cells)} |")
    before, rest = README.read_text("utf-8").split(BEGIN)
    return "\n\n".join([before + BEGIN, "\n".join(rows), END + rest.split(END)[1]])
