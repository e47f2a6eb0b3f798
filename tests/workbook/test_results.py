"""RESULTS.md, the CSV and the table of parameters are what the command makes of the records."""

import pandas as pd
import pytest

from dmsrd_lite.domains import DOMAINS, InputError
from dmsrd_lite.evaluation.comparison import METHODS
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
    for name in DOMAINS:
        ten_users = table[(table["lesson"] == "06_dmsrd") & (table["domain"] == name)]
        counts = ten_users[ten_users["metric"] == "environment_return"].groupby("method")["seed"].nunique()
        assert (counts[list(METHODS)] == 3).all()


def test_the_page_shows_one_row_for_each_method_and_the_readme_one_for_each_parameter(written):
    page, readme = written["RESULTS.md"].read_text(), written["README.md"].read_text()
    assert page.count("\n| DMSRD |") == 2
    assert page.count("\n| DMSRD, as in the paper |") == 1
    table = readme.split(results.BEGIN)[1].split(results.END)[0]
    for path in lessons():
        assert f"| [{path.stem}](../notebooks/{path.name}) | `seed` | int | `0` |" in table
    assert "|  |" not in table, "a parameter without its comment, or papermill cannot read it"


def test_pictures_and_links_of_the_page_exist(written):
    links = [part.split(")")[0] for part in written["RESULTS.md"].read_text().split("](")[1:]]
    assert {"papermill_runs/gallery/decisions.png", "notebooks/06_dmsrd.ipynb"} <= set(links)
    assert all((ROOT / link).exists() for link in links)


def test_records_that_are_missing_are_an_error_in_one_sentence():
    table = pd.DataFrame(results.numbers(), columns=results.COLUMNS)
    with pytest.raises(InputError, match="nothing about 'strategies'; expected the repository's records"):
        results.page(table[table["metric"] != "strategies"])
