"""RESULTS.md, the CSV and the table of parameters are what the command makes of the records."""

import numpy as np
import pandas as pd
import pytest

from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.workbook import results
from dmsrd_lite.workbook.lessons import lessons
from dmsrd_lite.workbook.records import RECORDS, ROOT


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return {path.name: path for path in results.write_results(tmp_path_factory.mktemp("results"))}


@pytest.mark.parametrize("path", [ROOT / "RESULTS.md", RECORDS / "results.csv", results.README])
def test_the_committed_files_are_what_the_command_writes(written, path):
    assert written[path.name].read_bytes() == path.read_bytes(), "run: python -m dmsrd_lite results"


def test_the_csv_holds_every_record_and_method(written):
    table = pd.read_csv(written["results.csv"])
    assert list(table) == list(results.COLUMNS)
    assert table.notna().all(axis=None)
    assert set(table["record"]) == {path.stem for path in RECORDS.glob("*.json")}
    assert set(table["lesson"]) <= {path.stem for path in lessons()}


def test_the_readme_shows_a_row_for_each_parameter(written):
    readme = written["README.md"].read_text()
    table = readme.split(results.BEGIN)[1].split(results.END)[0]
    for path in lessons():
        assert f"| [{path.stem}](../notebooks/{path.name}) | `seed` | int | `0` |" in table
    assert "|  |" not in table, "a parameter without its comment, or papermill cannot read it"


def test_pictures_and_links_of_the_page_exist(written):
    links = [part.split(")")[0] for part in written["RESULTS.md"].read_text().split("](")[1:]]
    assert {"papermill_runs/records", "notebooks/01_demonstrations.ipynb"} <= set(links)
    assert all((ROOT / link).exists() for link in links)


def test_the_page_shows_a_row_for_each_method_and_means_over_seeds():
    rows = [
        ["02_x", "02_airl", "inverted_pendulum", seed, "AIRL", "environment_return", value]
        for seed, value in ((0, -3.0), (1, -4.0))
    ]
    page = results.page(pd.DataFrame(rows, columns=results.COLUMNS))
    assert "### 02_airl, Inverted Pendulum\n" in page
    assert "\n| AIRL | 2 | -3.5 |" in page
    assert "No record yet" not in page
    assert "No record yet" in results.page(pd.DataFrame([], columns=results.COLUMNS))


def test_what_follows_from_a_row_by_hand():
    scores = {"environment_return": [-5.0, -700.0], "failure_share": [0.0, 0.5], "divergence": [2.0, 4.0],
              "log_likelihood_per_step": [0.1, 0.3], "curve": [[1]]}  # fmt: skip
    row = {"floor": [0.5, 1.5], "own_log_likelihood": [0.2, 0.2], "table": {"AIRL": scores}}
    row |= {"correlations": {"AIRL": {"pearson": 0.9}}}
    found = results._numbers({"results": row, "settings": {}}, DOMAINS["inverted_pendulum"])
    found = {(method, metric): np.mean(value) for method, metric, value in found}
    assert found["AIRL", "able"] == 0.5
    assert found["AIRL", "divergence_above_floor"] == pytest.approx(2.0)
    assert found["AIRL", "log_likelihood_above_own"] == pytest.approx(0.0)
    assert found["reward: AIRL", "pearson"] == 0.9
    assert ("AIRL", "curve") not in found


def test_what_would_help_recognition_is_a_share():
    row = {"recognition": {"clone, run 0": {"as recorded": 6, "clones": 8, "of": 8}}}
    record = {"results": row, "settings": {"n_fresh": [3, 30]}}
    assert [*results._numbers(record, DOMAINS["inverted_pendulum"])] == [
        ("ours, clone, run 0: as recorded", "recognized_on_30", 0.75),
        ("ours, clone, run 0: clones", "recognized_on_30", 1.0),
    ]


def test_searches_and_recognition_by_hand():
    row = {"known": 2, "search": "random", "budget": 96, "above_floor": 0.5, "error": 0.1, "steps": 100.0}
    early, free = (
        {**row, "budget": 12, "error": 0.9},
        {**row, "search": "actions", "budget": 0, "error": 0.02},
    )
    other = {**row, "above_floor": 1.5}
    found = results._numbers({"results": {"rows": [early, row, other, free]}, "settings": {}}, None)
    found = {(method, metric): np.mean(value) for method, metric, value in found}
    assert found["random, 2 known", "divergence_above_floor"] == 1.0
    assert found["random, 2 known", "weight_error"] == pytest.approx(0.1)
    assert found["actions, 2 known", "weight_error"] == 0.02
    known = {"recognized": {"shown": 2, "30 fresh": 1}, "task": 0.8}
    known["means"] = {"shown": [[0.0]] * 4, "30 fresh": [[0.0]] * 4}
    record = {"results": {"n_fresh": [30], "table": {"MSRD": known}}, "settings": {}}
    found = {(method, metric): value for method, metric, value in results._numbers(record, None)}
    shares = {"recognized_on_shown": 0.5, "recognized_on_30": 0.25, "pearson": 0.8}
    assert found == {("MSRD", metric): value for metric, value in shares.items()}


def test_a_run_of_dmsrd_has_shares_of_its_own_strategies():
    scores = {"environment_return": [-5.0], "failure_share": [0.0], "decisions": [{}], "branches": ["x"]}
    scores |= {"pure": [0, 1], "recognized_fresh": {"shown": 2, "3": 1}}
    domain = DOMAINS["inverted_pendulum"]
    found = {(a, b): c for a, b, c in results._scores("ours", scores, domain, None, None)}
    assert found["ours", "recognized_on_shown"] == 1.0
    assert found["ours", "recognized_on_3"] == 0.5
    assert not {metric for _, metric in found} & {"decisions", "branches", "pure", "recognized_fresh"}
