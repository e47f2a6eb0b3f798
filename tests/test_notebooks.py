"""Every lesson runs headless with ``quick``, in both domains; a wrong parameter is one sentence."""

import nbformat
import pytest

from dmsrd_lite.beyond.conversion import convert
from dmsrd_lite.demonstrations import DATA_FOLDER, save_demonstrations
from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook.execution import execute, handed_over
from dmsrd_lite.workbook.lessons import NOTEBOOKS, lessons

LANDER = pytest.param("lunar_lander", marks=pytest.mark.verify)
LESSONS = [pytest.param(path, id=path.stem) for path in lessons()]


@pytest.mark.lesson
@pytest.mark.parametrize("path", LESSONS)
@pytest.mark.parametrize("domain", ["inverted_pendulum", LANDER])
def test_lesson_runs_quick(domain, path, tmp_path):
    output = tmp_path / path.name
    error, seconds = execute(path, output, {"preset": "quick", "domain": domain})
    assert error == ""
    print(f"{path.stem}: {seconds:.0f} s")
    executed = nbformat.read(output, 4)
    assert {"seconds", "environment_steps"} < handed_over(executed).keys()
    text = "".join(o.get("text", "") for c in executed.cells for o in c.get("outputs", []))
    claimed = "holds:" in text, "does not hold:" in text  # on the lander a small run may miss all of them
    assert claimed == (True, False) or (domain == "lunar_lander" and any(claimed))


@pytest.mark.lesson
@pytest.mark.verify
def test_lesson_runs_from_its_own_folder(tmp_path):
    path = NOTEBOOKS / "00_start_here.ipynb"
    error, _ = execute(path, tmp_path / "out.ipynb", {"preset": "quick"}, folder=NOTEBOOKS)
    assert error == ""


def run_first_cells(name, parameters):
    """Cell after cell in this process, as a kernel would run them."""
    cells = [c for c in nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4).cells if c.cell_type == "code"]
    namespace = {}
    for cell in cells[:8]:
        exec(compile(cell.source, name, "exec"), namespace)
        if "parameters" in cell.metadata.get("tags", []):
            namespace.update(parameters)


SHIPPED = str(DATA_FOLDER / "inverted_pendulum_demonstrations.npz")


@pytest.mark.lesson
@pytest.mark.verify
def test_a_lesson_with_short_demonstrations_of_ones_own(tmp_path):
    mine = save_demonstrations(tmp_path / "mine.npz", convert(SHIPPED, steps=12)[0].select(range(3)))
    parameters = {"preset": "quick", "demonstrations_path": str(mine)}
    error, _ = execute(NOTEBOOKS / "06_dmsrd.ipynb", tmp_path / "out.ipynb", parameters)
    assert error == ""


@pytest.mark.lesson
@pytest.mark.verify
@pytest.mark.parametrize("domain", ["inverted_pendulum", "lunar_lander"])
def test_the_benchmark_is_read_from_its_records(domain, tmp_path):
    """Nothing is trained: the tables and figures of all trials."""
    parameters = {"domain": domain, "preset": "full"}
    error, _ = execute(NOTEBOOKS / "07_benchmark.ipynb", tmp_path / "out.ipynb", parameters)
    assert error == ""
    found = handed_over(nbformat.read(tmp_path / "out.ipynb", 4))
    assert found["trials"] == 3
    assert len(found["summary"]["KL"]) == 14  # two starts of six methods, cloning, and the people themselves


@pytest.mark.parametrize(
    ("name", "parameters", "sentence"),
    [
        *((path.stem, {"domain": "cartpole"}, "unknown domain 'cartpole'") for path in lessons()),
        ("01_demonstrations", {"preset": "huge"}, "unknown preset 'huge'"),
        ("01_demonstrations", {"seed": -1}, "seed -1: expected a whole number"),
        ("01_demonstrations", {"demonstrations_path": "none.npz"}, "there is no such file"),
        ("02_airl", {"person": 40}, "person 40: expected a whole number from 0 to 9"),
        ("03_msrd", {"alpha": -1.0}, "alpha -1.0: expected a number from"),
        ("04_policy_mixture", {"weight": 2.0}, "weight 2.0: expected a number from 0 to 1"),
        ("05_between_class_discrimination", {"n_iterations": -1}, "n_iterations -1: expected a whole number"),
        ("06_dmsrd", {"kl_threshold": -1.0}, "kl_threshold -1.0: expected a number from"),
        ("06_dmsrd", {"form": "theirs"}, "form 'theirs' from start 'clone': expected one of ours, clone; "),
        ("06_dmsrd", {"demonstrations_path": "none.npz"}, "there is no such file"),
        (
            "06_dmsrd",
            {"order": "2,0,x", "demonstrations_path": SHIPPED},
            "order '2,0,x': expected numbers from 0",
        ),
        ("06_dmsrd", {"order": "0,99", "demonstrations_path": SHIPPED}, "order '0,99': expected numbers"),
        ("08_lifelong_100", {"users": 5}, "users 5: expected a whole number from 6 to 100"),
        ("08_lifelong_100", {"form": "theirs"}, "form 'theirs': expected one of ours, as printed"),
        (
            "08_lifelong_100",
            {"part": "all"},
            "part 'all': expected one of trial, ablations, orders, thousand",
        ),
        ("08_lifelong_100", {"users": 7, "record": True}, "record=True with users: expected users=0"),
        (
            "08_lifelong_100",
            {"part": "orders", "form": "as printed"},
            "part 'orders' with form 'as printed': expected ours",
        ),
        ("08_lifelong_100", {"part": "orders"}, "part 'orders' with quick: expected preset full"),
        ("07_benchmark", {"record": True}, "record=True without part: expected one"),
        ("08_lifelong_100", {"record": True}, "record=True with quick: expected preset full, a record is of"),
    ],
)
def test_a_bad_parameter_ends_the_lesson_at_its_start(name, parameters, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=sentence) as caught:
        run_first_cells(name, parameters)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
