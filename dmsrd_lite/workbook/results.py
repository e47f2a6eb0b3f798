"""What the records say: one tidy CSV, ``RESULTS.md`` made of it, and the table of the lessons' parameters."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dmsrd_lite.demonstrations import write_atomically
from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.workbook.lessons import lessons
from dmsrd_lite.workbook.records import RECORDS, ROOT, load_record

README = ROOT / "papermill_runs" / "README.md"
BEGIN, END = "<!-- parameters: made by python -m dmsrd_lite results -->", "<!-- end of parameters -->"
SHOWN = {
    "divergence_above_floor": "KL above the floor (nats)",
    "log_likelihood_above_own": "log-likelihood above the demonstrator's own (nats per step)",
    "environment_return": "return",
    "failure_share": "failures",
    "task_correlation": "correlation of the task reward",
    "recognized": "recognised",
}
SINGLE = ("fresh_solved", "fresh_spared", "every_step", "weight_error", "peak_gb", "environment_steps")
COLUMNS = ("record", "lesson", "domain", "seed", "method", "metric", "value")


def write_results(folder: Path | None = None) -> list[Path]:
    """Write ``RESULTS.md``, ``results.csv`` and the README of the runs: in place, or in ``folder``."""
    table = pd.DataFrame(numbers(), columns=COLUMNS)
    text = table.round(6).to_csv(index=False, lineterminator="\n")
    made = {ROOT / "RESULTS.md": page(table), RECORDS / "results.csv": text, README: parameters()}
    return [_write(folder / path.name if folder else path, text) for path, text in made.items()]


def _write(path: Path, text: str) -> Path:
    return write_atomically(path, lambda file: file.write(text.encode()))


def numbers() -> Iterator[tuple]:
    """Every number of every record (``COLUMNS``); the mean where there is one for each demonstration."""
    stems = {path.stem[:2]: path.stem for path in lessons()}
    for path in sorted(RECORDS.glob("*.json")):
        (record, _), stem = load_record(path.stem), path.stem
        domain, seed = record["parameters"]["domain"], record["parameters"]["seed"]
        for method, metric, value in _numbers(record["results"], DOMAINS[domain].horizon):
            if value is not None:
                yield stem, stems[stem[:2]], domain, seed, method, metric, float(np.mean(value))


def _numbers(r: dict, horizon: int) -> Iterator[tuple[str, str, Any]]:
    """Method, metric, and value or values, of a record's results."""
    strategies = pure if isinstance(pure := r.get("pure", {}), dict) else {"DMSRD": pure}
    yield "demonstrator", "divergence", r["floor"]
    yield "demonstrator", "log_likelihood_per_step", r["own_log_likelihood"]
    for method, scores in _scores(r).items():
        yield from ((method, metric, value) for metric, value in scores.items())
        yield method, "divergence_above_floor", np.subtract(scores["divergence"], r["floor"])
        likelihood = np.array(scores["log_likelihood_per_step"])
        yield method, "log_likelihood_above_own", likelihood - r["own_log_likelihood"]
        yield method, "log_likelihood_of_trajectory", likelihood * horizon
        if m := len(strategies.get(method, ())):
            yield method, "strategies", m
            yield method, "steps_per_strategy", scores["steps"] / m
            yield method, "search_steps_per_strategy", scores["search_steps"] / m
    learner = "DMSRD" if "table" in r else "AIRL Batch"
    for metric in SINGLE:
        yield learner, metric, r.get(metric)
    if r.get("ceiling"):
        yield "fitted to true returns", "task_correlation", r["ceiling"]
        yield "DMSRD", "share_of_ceiling", r["table"]["DMSRD"]["task_correlation"] / r["ceiling"]
    if "later" in r:
        yield "DMSRD", "strategies_for_later_mixtures", sum(x["steps"]["airl"] > 0 for x in r["later"])
    if "stream_seconds" in r:
        seconds = np.array([x["seconds"] for x in r["records"]])
        usual = np.where(np.isin(np.arange(len(seconds)), r["pure"]), np.nan, seconds)
        yield "DMSRD", "minutes", None if r["resumed"] else r["stream_seconds"] / 60
        yield "DMSRD", "last_ten_over_second_ten", seconds[-10:].mean() / seconds[10:20].mean()
        yield "DMSRD", "usual_last_ten_over_second_ten", np.nanmean(usual[-10:]) / np.nanmean(usual[10:20])
        thresholds = [x["threshold"] for x in r["records"]]
        yield "DMSRD", "users_above_threshold", sum(np.greater(r["table"]["divergence"], thresholds))


def _scores(r: dict) -> dict[str, dict[str, Any]]:
    """Metrics by method, of any record; lists hold a value for each demonstration."""
    if "table" in r:
        return r["table"] if "DMSRD" in r["table"] else {"DMSRD": r["table"]}
    names = {"divergence": "kl", "log_likelihood_per_step": "log_likelihood", "failure_share": "failures",
             "environment_return": "returns"}  # fmt: skip
    scores: dict[str, dict] = {m: {name: r[key][m] for name, key in names.items()} for m in r["kl"]}
    known = {"task_correlation": "AIRL Batch", "task_correlation_without_coverage": "without coverage"}
    scores["AIRL Batch"] |= {metric: r["correlation"][key] for metric, key in known.items()}
    return scores


def page(table: pd.DataFrame) -> str:
    """``results.md`` with the table of the records in its place: one row for each record and method."""
    rows = []
    for (record, method), found in table.groupby(["record", "method"], sort=False):
        known = found.drop_duplicates("metric").set_index("metric")["value"]
        cells = [f"{known[m]:.3g}" if m in known else "-" for m in SHOWN]
        rows.append(f"| {record} | {method} | {' | '.join(cells)} |")
    head = [f"| record | method | {' | '.join(SHOWN.values())} |", "|---" * (len(SHOWN) + 2) + "|"]
    text = "\n".join([*head, *rows]) if rows else "*No record yet.*"
    return Path(__file__).with_suffix(".md").read_text("utf-8").replace("{records}", text)


def parameters() -> str:
    """``papermill_runs/README.md`` with the table of every lesson's parameters between its marker lines."""
    from papermill import inspect_notebook

    rows = ["| lesson | parameter | type | default | what it is |", "|---|---|---|---|---|"]
    for path in lessons():
        for name, p in inspect_notebook(str(path)).items():
            cells = f"`{name}`", p["inferred_type_name"], f"`{p['default']}`", p["help"]
            rows.append(f"| [{path.stem}](../notebooks/{path.name}) | {' | '.join(cells)} |")
    text = README.read_text("utf-8")
    if BEGIN not in text:
        text = f"{text.rstrip()}\n\n## Parameters of every lesson\n\n{BEGIN}\n{END}\n"
    before, rest = text.split(BEGIN)
    return "\n\n".join([before + BEGIN, "\n".join(rows), END + rest.split(END)[1]])
