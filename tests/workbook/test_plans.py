"""Plans on a tiny notebook: what is refused, what is recorded, and what is left after a kill."""

import json
import os
import re
import resource
import signal
import socket
import sys
import textwrap
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT, Popen, check_output

import nbformat
import psutil
import pytest
from filelock import FileLock
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from dmsrd_lite.__main__ import main
from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook import plans
from dmsrd_lite.workbook.execution import handed_over, perform
from dmsrd_lite.workbook.records import MIME, ROOT

TWO_SEEDS = "[grid]\nseed = [0, 1]"
ONE_THREAD = ("--nthreads", "1", "--memory-limit", "0")  # of a Dask worker
OUT = Path("out")
PARAMETERS = 'domain: str = "inverted_pendulum"\npreset: str = "quick"\nseed: int = 0\nscale = 1.0\nodd = 2*3'
SQUARE = f"""
import os, signal, time
from IPython.display import publish_display_data
print(seed, file=open("begun", "a"), flush=True)
time.sleep(0.3)
results = {{"square": seed**2, "environment_steps": 60, "more": {{"a_seconds": 2, "seconds": 1, "kept": 1}}}}
publish_display_data({{{MIME!r}: results}})  # as a lesson hands over, without loading torch
"""


def write_plan(text=TWO_SEEDS, *cells, notebook="tiny.ipynb", parameters=PARAMETERS):
    """A plan, and beside it a notebook of its own; returns the plan."""
    first = new_code_cell(parameters, metadata={"tags": ["parameters"]})
    cells = [new_markdown_cell("Words."), first, *(new_code_cell(c) for c in (SQUARE, *cells))]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    nbformat.write(new_notebook(cells=cells, metadata={"kernelspec": kernel}), "tiny.ipynb")
    named = "" if "name" in text else f'name = "tiny"\nnotebook = "{notebook}"\n'
    Path("plan.toml").write_text(named + text)
    return Path("plan.toml")


def load(*text, **changes):
    return plans.load_plan(write_plan(*text, **changes), OUT)


def run(*options, output=OUT):
    return main(["run", "plan.toml", "--output", str(output), *options])


def start(*options):
    """The same in a process and a process group of its own."""
    command = [sys.executable, "-m", "dmsrd_lite", "run", "plan.toml", "--output", "out", *options]
    return Popen(command, stdout=PIPE, stderr=STDOUT, text=True, start_new_session=True)


def records(output=OUT):
    found = [json.loads(path.read_text()) for path in sorted(output.glob("*.json"))]
    return {r["parameters"]["seed"]: r for r in found}


def stamps():
    return {path.name: path.stat().st_mtime_ns for path in OUT.glob("tiny*")}


def kills_its_worker(*seeds, times=1):
    """A cell that kills the worker which started its kernel, so many times."""
    condition = f"seed in {seeds} and open('begun').read().split().count(str(seed)) <= {times}"
    return f"if {condition}:\n    os.kill(int(os.environ['JPY_PARENT_PID']), 9); time.sleep(60)"


def wait_for(condition):
    end = time.monotonic() + 90
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """A folder of its own; workers and kernels carry a mark, and none outlives its test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PLAN_TEST", str(tmp_path))

    mark = re.compile(f"(?=.*(spawn_main|ipykernel))(?=.*PLAN_TEST': '{tmp_path}')")
    yield
    wait_for(lambda: not any(mark.match(str(p.info)) for p in psutil.process_iter(["cmdline", "environ"])))


@contextmanager
def hand_started_cluster(n_workers):
    """A scheduler and workers as somebody starts them in a terminal; yields the scheduler and its address."""
    port = str(socket.create_server(("127.0.0.1", 0)).getsockname()[1])
    address = f"tcp://127.0.0.1:{port}"
    with (
        dask("scheduler", "--host", "127.0.0.1", "--port", port, "--no-show") as scheduler,
        ExitStack() as workers,
    ):
        for _ in range(n_workers):
            workers.enter_context(dask("worker", address, *ONE_THREAD))
        yield scheduler, address


@contextmanager
def dask(*words):
    process = Popen([sys.executable, "-m", "dask", *words, "--no-dashboard"], stdout=DEVNULL, stderr=DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(30)


def test_a_small_plan_with_a_failing_run_and_a_killed_worker(capsys):
    write_plan(TWO_SEEDS, kills_its_worker(1), "assert seed != 0, 'on purpose'")
    assert run("--workers", "1") == 1
    assert "1 of 2 ok" in capsys.readouterr().out
    assert Path("begun").read_text().split() == ["0", "1", "1"], "what was finished does not run again"
    failed, one = records().values()
    assert "AssertionError: on purpose" in failed["error"]
    assert one["parameters"] == {"domain": "inverted_pendulum", "preset": "quick", "seed": 1, "scale": 1.0}
    assert (one["error"], one["plan"], one["environment_steps"]) == ("", "tiny", 60)
    assert one["metrics"] == {"square": 1, "more": {"kept": 1}}
    assert one["versions"]["torch"] == "2.13.0"
    assert len(before := stamps()) == 4, "a record and a notebook for each run"
    assert run("--only", "seed=1") == 0
    assert "1 finished before" in capsys.readouterr().out
    assert stamps() == before
    (OUT / "cut.json").write_text('{"name": "tiny__s')
    table = plans.read_table(OUT)
    assert list(table["error"] == "") == [False, False, True]
    assert table["metrics.square"].iloc[2] == 1


def test_what_is_redone_and_why(capsys):
    def to_do(*options):
        assert run("--dry-run", *options) == 0
        return dict(re.findall(r"to do: tiny__(\S+) \((.*)\)", capsys.readouterr().out))

    for planned in (plan := load()).runs:
        plans._record(plan, planned, {"text": "executed", "error": ""})
    assert to_do() == {}
    assert to_do("--force", "--only", "seed=1") == {"seed-1": "forced"}
    write_plan(parameters=PARAMETERS + "  # a comment")
    assert to_do() == {}
    write_plan("[parameters]\nscale = 2.0\n[grid]\nseed = [0, 1, 2]")
    assert to_do() == {"seed-0": "another scale", "seed-1": "another scale", "seed-2": "new"}
    write_plan(TWO_SEEDS, "1 + 1")
    assert to_do() == {"seed-0": "another source", "seed-1": "another source"}
    write_plan()
    plans._record(plan, plan.runs[0], {"text": "executed", "error": "cell 1: AssertionError"})
    (OUT / "tiny__seed-1.ipynb").unlink()
    assert to_do() == {"seed-0": "failed before", "seed-1": "its executed notebook is gone"}
    (OUT / "tiny__seed-1.json").write_text("{}")
    assert to_do()["seed-1"] == "its record cannot be read"


FAULTS = {
    "[grid]\nsed = [0]": "tiny has no parameter 'sed': expected some of domain, preset, seed, scale",
    "[parameters]\nodd = 1": "tiny has no parameter 'odd'",
    "[parameters]\nseed = -1": "tiny: seed -1: expected a whole number",
    "[grid]\nseed = [0, 1, true]": "tiny: seed = True: expected a whole number, as 0 is",
    "[parameters]\nscale = inf": "scale = inf: expected a finite number",
    "[grid]\nseed = 1": "grid = {'seed': 1}: expected a table of lists of at least one value",
    "[grid]\nseed = [1, 1]": "tiny__seed-1 stands in the plan twice",
    "[grid]\nseed = [1]\n[parameters]\nseed = 1": "seed stands in both parameters and grid",
    "workers = 3": "unknown key 'workers'",
    "cell_minutes = -1": "cell_minutes = -1: expected a number of at least 0",
    "[parameters]\npreset = 'huge'\ndomain = 'moon'\n[grid]\nsed = [0]": "'huge'.*'moon'.*'sed'",
    'name = "records"': "name = 'records': expected .*; notebook = '': expected",
    "[grid": "cannot be read as a plan",
}


@pytest.mark.parametrize("text", FAULTS)
def test_a_faulty_plan_is_one_sentence_and_nothing_runs(text, capsys):
    write_plan(text)
    assert run() == 2
    (printed,) = capsys.readouterr().err.splitlines()
    assert re.search(FAULTS[text], printed)
    assert not OUT.exists()


def test_notebooks_are_found_by_lesson_path_and_pattern(tmp_path):
    for notebook in (tmp_path / "tiny.ipynb", "t*.ipynb", "./tiny.ipynb"):
        assert len(load(notebook=notebook).runs) == 2
    assert len(load("", notebook="0[0-2]_*").runs) == 3
    Path("broken.ipynb").write_text("{")
    for notebook in ("absent.ipynb", "broken.ipynb", tmp_path):
        with pytest.raises(InputError, match=rf"{notebook}: expected a lesson or a notebook's path \("):
            load(notebook=notebook)


def test_the_grid_its_file_names_and_only():
    plan = load('[parameters]\ndomain = "lunar_lander"\n[grid]\nscale = [1, 2.5]\nseed = [0, 1]')
    assert [r.name for r in plan.runs][1:3] == ["tiny__scale-1.0__seed-1", "tiny__scale-2.5__seed-0"]
    for pair, n in {"scale=1": 2, "scale=1.0": 2, "domain=lunar_lander": 4, "notebook=tiny": 4}.items():
        assert sum(plans._has(r, pair) for r in plan.runs) == n
    with pytest.raises(InputError, match="--only seed=1 typo=None: leaves no run of the plan tiny"):
        plans.run_plan(plan, only=["seed=1", "typo=None"])
    plan = load(f'[grid]\npath = ["a/b.npz", "a-b.npz", "{"long" * 100}"]', parameters='path: str = ""')
    assert len({r.name for r in plan.runs if re.fullmatch(r"[\w.-]{,200}", r.name)}) == 3


def test_what_stands_in_the_way_is_one_sentence(capsys):
    assert run(output=write_plan() / "out") == 2
    assert "cannot be written to" in capsys.readouterr().err
    assert run("--scheduler", "nonsense://x") == 2
    assert "nonsense://x: no Dask scheduler answers" in capsys.readouterr().err
    with FileLock(OUT / ".lock"):
        assert run() == 2
    assert "another run of this plan goes on; expected one at a time" in capsys.readouterr().err
    answer = perform(replace(load().runs[0], source="0" * 16), 60, ".")
    assert "than when the plan was read (0000000000000000); expected the same" in answer["error"]
    assert not stamps()


def test_a_full_disk_is_one_sentence_and_leaves_what_was_there():
    plan, limit = load(), resource.getrlimit(resource.RLIMIT_FSIZE)
    plans._record(plan, plan.runs[0], {"text": "old", "error": ""})
    before = stamps()
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, limit[1]))
        with pytest.raises(InputError, match=r"cannot be written \(File too large\)"):
            plans._record(plan, plan.runs[0], {"text": "a longer text", "error": ""})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert stamps() == before


def test_shipped_plans_fit_their_notebooks():
    for path in (ROOT / "papermill_runs" / "plans").glob("*.toml"):
        plan = plans.load_plan(path)
        assert (plan.name, plan.runs != (), plan.minutes > 0) == (path.stem, True, True)


def test_the_plan_that_is_explained_can_be_read(tmp_path):
    text = (ROOT / "papermill_runs" / "README.md").read_text()
    example = re.search(r"(?:^    .*\n|^\n)*^    name = (?:.*\n)(?:^    .*\n|^\n)*", text, re.M)[0]
    (tmp_path / "plan.toml").write_text(textwrap.dedent(example))
    assert len(plans.load_plan(tmp_path / "plan.toml").runs) == 6


@pytest.mark.verify
def test_twenty_runs_two_killed_workers_and_one_run_that_kills_every_worker(capsys):
    write_plan(f"[grid]\nseed = {[*range(20)]}", kills_its_worker(5, 12), kills_its_worker(19, times=9))
    assert run("--workers", "2") == 1
    assert "19 of 20 ok" in capsys.readouterr().out
    begun = sorted(map(int, Path("begun").read_text().split()))
    assert begun == sorted([*range(20), 5, 12, 19, 19, 19]), "what was finished does not run again"
    assert records()[19]["error"].startswith("KilledWorker")
    assert [records()[i]["metrics"]["square"] for i in range(19)] == [i**2 for i in range(19)]


@pytest.mark.verify
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["killed", "Ctrl-C"])
def test_a_stopped_driver_leaves_no_process_and_the_second_call_does_only_the_rest(how, capsys):
    write_plan(f"[grid]\nseed = {list(range(8))}")
    driver, ctrl_c = start("--workers", "2"), how == signal.SIGINT
    wait_for(lambda: len(records()) >= 3)
    (os.killpg if ctrl_c else os.kill)(driver.pid, how)  # a terminal tells the whole group
    printed, _ = driver.communicate(timeout=60)
    assert driver.returncode == (130 if ctrl_c else -9), printed
    assert ("stopped: finished runs are recorded, the same command" in printed) == ctrl_c
    assert (
        "dmsrd_lite/workbook" not in printed
    )  # no traceback of ours; kernels say in words of their own that they end
    n_finished, before = len(records()), stamps()
    assert 3 <= n_finished < 8
    assert run() == 0
    assert re.search(f"8 runs, {n_finished} finished before(?s:.*)8 of 8 ok", capsys.readouterr().out)
    assert all(stamps()[name] == stamp for name, stamp in before.items() if name.endswith(".json"))


@pytest.mark.verify
def test_three_routes_give_the_same_metrics_to_the_last_bit(tmp_path):
    cell = """
from dmsrd_lite.learning import networks, rollouts
from dmsrd_lite.workbook import lessons
lesson = lessons.start("00_start_here", domain, preset, seed)
actor = networks.GaussianPolicies(lesson.domain, 1, seed).actor()
data = rollouts.rollout(lesson.domain, actor, 2, seed, horizon=30)
lesson.hand_over(environment_steps=60, total=scale * data.returns)"""
    write_plan(TWO_SEEDS, cell)
    papermill = Path(sys.executable).with_name("papermill")
    check_output([papermill, "tiny.ipynb", "cli.ipynb", "-p", "seed", "1"], stderr=STDOUT)
    found = [handed_over(nbformat.read("cli.ipynb", 4))["total"]]
    with hand_started_cluster(2) as (_, address):
        for option, value in (("--workers", "1"), ("--workers", "2"), ("--scheduler", address)):
            assert run(option, value, output=tmp_path / value[:3]) == 0
            zero, one = (r["metrics"]["total"] for r in records(tmp_path / value[:3]).values())
            assert zero != one
            found.append(one)
    assert all(total == found[0] for total in found), found


@pytest.mark.verify
def test_workers_may_come_after_the_plan():
    both = "while len(open('begun').read().split()) < 2:\n    time.sleep(0.1)"
    write_plan(TWO_SEEDS, both)
    with hand_started_cluster(0) as (_, address):
        driver = start("--scheduler", address)
        time.sleep(3)
        with dask("worker", address, *ONE_THREAD), dask("worker", address, *ONE_THREAD):
            printed, _ = driver.communicate(timeout=90)
    assert driver.returncode == 0, printed


@pytest.mark.verify
def test_a_scheduler_that_dies_or_is_not_there_is_one_sentence(capsys):
    write_plan("[grid]\nseed = [0, 1, 2]", "time.sleep(3)")
    with hand_started_cluster(1) as (scheduler, address):
        driver = start("--scheduler", address)
        wait_for(records)
        scheduler.kill()
        printed, _ = driver.communicate(timeout=90)
    assert (driver.returncode, "Traceback" in printed) == (2, False), printed
    assert "the Dask scheduler is gone; run the same command again for what is left" in printed
    assert records()[0]["error"] == ""
    assert run("--scheduler", address) == 2
    assert f"{address}: no Dask scheduler answers" in capsys.readouterr().err
