"""Plans on a tiny notebook: what is refused, what is recorded, and what is left after a kill."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import nbformat
import psutil
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from dmsrd_lite import plans
from dmsrd_lite.__main__ import main
from dmsrd_lite.envs import InputError
from dmsrd_lite.runs import execute, handed_over

KERNEL = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
PARAMETERS = (
    'domain: str = "inverted_pendulum"  # task\npreset: str = "quick"  # size\nseed: int = 0  # randomness\nscale: float = 1.0  # size'
)
BODY = """
from dmsrd_lite import envs, networks, rollouts, runs
actor = networks.GaussianPolicies(envs.get_domain(domain), 1, seed).actor()
data = rollouts.rollout(envs.get_domain(domain), actor, 2, seed, horizon=30)
runs.hand_over(total=scale * data.returns, some_seconds=1.0, nested={"seconds": 2.0, "kept": [1, 2]})
"""


def write_notebook(path, *cells, parameters=PARAMETERS):
    first = new_code_cell(parameters, metadata={"tags": ["parameters"]})
    nbformat.write(new_notebook(cells=[first, *(new_code_cell(c) for c in cells)], metadata=KERNEL), path)
    return path


def write_plan(folder, text="[grid]\nseed = [0, 1]", cells=(BODY,), notebook="tiny.ipynb"):
    """A plan beside a notebook of its own, and the folder of its results."""
    if not (folder / "tiny.ipynb").exists():
        write_notebook(folder / "tiny.ipynb", *cells)
    (folder / "plan.toml").write_text(f'name = "tiny"\nnotebook = "{notebook}"\n{text}\n')
    return folder / "plan.toml", folder / "out"


def run(plan, output, *options):
    return main(["run", str(plan), "--output", str(output), *map(str, options)])


def records_of(output):
    return {path.stem: json.loads(path.read_text()) for path in sorted(output.glob("*.json"))}


def start(plan, output, *options):
    """The command line in a process and a process group of its own."""
    command = [sys.executable, "-m", "dmsrd_lite", "run", str(plan), "--output", str(output), *map(str, options)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)


def wait_for(condition, seconds=90.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


def dask_workers(pid):
    """The worker processes of a running plan: children that the nannies spawned and that have kernels or wait for one."""
    try:
        return [p for p in psutil.Process(pid).children() if "spawn_main" in " ".join(p.cmdline())]
    except psutil.NoSuchProcess:
        return []


def kernels(scratch):
    """Kernel processes whose environment carries our mark."""
    found = []
    for p in psutil.process_iter():
        try:
            if "ipykernel_launcher" in " ".join(p.cmdline()) and p.environ().get("PLAN_TEST") == str(scratch):
                found.append(p)
        except (psutil.AccessDenied, psutil.NoSuchProcess):
            pass
    return found


@contextmanager
def hand_started_cluster(n_workers):
    """A scheduler and workers as somebody starts them in a terminal; yields the address."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{s.getsockname()[1]}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    port = address.rpartition(":")[2]
    processes = [subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard", "--no-show"], **quiet)]
    worker = [*dask, "worker", address, "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"]
    processes += [subprocess.Popen(worker, **quiet) for _ in range(n_workers)]
    try:
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            process.wait(30)


def test_one_record_per_run_beside_its_notebook_and_a_second_call_does_nothing(tmp_path, capsys):
    plan, output = write_plan(tmp_path)
    assert run(plan, output) == 0
    assert "2 of 2 ok" in capsys.readouterr().out
    records = records_of(output)
    assert set(records) == {"tiny__seed-0", "tiny__seed-1"}
    one = records["tiny__seed-1"]
    assert one["parameters"] == {"domain": "inverted_pendulum", "preset": "quick", "seed": 1, "scale": 1.0}
    assert (one["seed"], one["environment_steps"], one["error"], one["plan"]) == (1, 60, "", "tiny")
    assert one["metrics"].keys() == {"total", "nested"}
    assert one["metrics"]["nested"] == {"kept": [1, 2]}
    assert one["versions"]["torch"] == "2.13.0"
    assert one["seconds"] > 0
    executed = nbformat.read(output / "tiny__seed-1.ipynb", 4)
    assert handed_over(executed)["total"] == one["metrics"]["total"]
    stamps = {p: p.stat().st_mtime_ns for p in output.iterdir()}
    assert run(plan, output) == 0
    assert "2 finished before" in capsys.readouterr().out
    assert {p: p.stat().st_mtime_ns for p in output.iterdir()} == stamps


def test_what_is_redone_and_why(tmp_path, capsys):
    plan, output = write_plan(tmp_path)
    assert run(plan, output) == 0
    capsys.readouterr()

    def to_do(*options):
        assert run(plan, output, "--dry-run", *options) == 0
        return {line.split()[2]: line.split("(")[1].rstrip(")") for line in capsys.readouterr().out.splitlines() if "to do" in line}

    assert to_do() == {}
    assert to_do("--force") == {"tiny__seed-0": "forced", "tiny__seed-1": "forced"}
    (output / "tiny__seed-0.ipynb").unlink()
    assert to_do() == {"tiny__seed-0": "its executed notebook is gone"}
    (output / "tiny__seed-1.json").write_text('{"run": "tiny__s')
    assert "cannot be read as the record of a run" in to_do()["tiny__seed-1"]
    assert "expected value" not in to_do()["tiny__seed-1"].splitlines()[0][:20]
    assert to_do("--only", "seed=1").keys() == {"tiny__seed-1"}
    write_plan(tmp_path, "[parameters]\nscale = 2.0\n[grid]\nseed = [0, 1, 2]")
    assert to_do() == {"tiny__seed-0": "another scale", "tiny__seed-1": to_do()["tiny__seed-1"], "tiny__seed-2": "new"}
    assert run(plan, output, "--only", "seed=9") == 2
    assert "--only seed=9: leaves no run of the plan tiny" in capsys.readouterr().err


def test_source_hash_knows_code_from_words(tmp_path, monkeypatch):
    def hashed(*cells):
        return plans.source_hash(new_notebook(cells=[new_markdown_cell("words"), *(new_code_cell(c) for c in cells)]))

    package = tmp_path / "package"
    package.mkdir()
    monkeypatch.setattr(plans, "PACKAGE", package)
    (package / "a.py").write_text('"""Doc."""\nfrom dmsrd_lite.b import x\n\n\ndef f():\n    """Doc."""\n    return x\n')
    (package / "b.py").write_text("x = 1  # one\n")
    (package / "c.py").write_text("y = 1\n")
    (package / "plots.py").write_text("z = 1\n")
    cell = "from dmsrd_lite import a, plots\na.f()"
    first = hashed(cell)
    assert hashed("from dmsrd_lite import a, plots  # a comment", "a.f( )") == first
    (package / "a.py").write_text('"""Other."""\nfrom dmsrd_lite.b import x\n\n\ndef f():\n    """Words."""\n    return x  # y\n')
    (package / "c.py").write_text("y = 2\n")
    (package / "plots.py").write_text("z = 2\n")
    assert hashed(cell) == first
    assert hashed(cell.replace("a.f()", "a.f() + 1")) != first
    (package / "b.py").write_text("x = 2\n")
    assert hashed(cell) != first
    assert hashed("%matplotlib inline\n1 + 1") == hashed("%matplotlib inline", "1 + 1  # two")


def test_a_failed_run_keeps_its_notebook_error_and_place_and_the_others_go_on(tmp_path, capsys):
    cells = ["assert seed != 0, 'on purpose'", "import os, signal, time\nif seed == 1:\n    os.kill(os.getpid(), signal.SIGKILL)",
             "if seed == 2:\n    time.sleep(1000)", BODY]  # fmt: skip
    plan, output = write_plan(tmp_path, "cell_minutes = 0.1\n[grid]\nseed = [0, 1, 2, 3]", cells)
    assert run(plan, output, "--workers", 2) == 1
    printed = capsys.readouterr().out
    assert "1 of 4 ok" in printed
    errors = [record["error"] for record in records_of(output).values()]
    assert "AssertionError: on purpose" in errors[0]
    assert "DeadKernel" in errors[1]
    assert "Timeout" in errors[2]
    assert errors[3] == ""
    assert len(list(output.glob("*.ipynb"))) == 4
    table = plans.read_table(output)
    assert len(table) == 4
    assert list(table["error"] == "") == [False, False, False, True]
    assert table["environment_steps"].iloc[3] == 60
    assert run(plan, output, "--dry-run") == 0
    assert capsys.readouterr().out.count("(failed before)") == 3
    (output / "tiny__seed-1.json").write_text("{}")
    assert "cannot be read as the record" in plans.read_table(output)["error"][1]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[grid]\nsed = [0]", "tiny has no parameter 'sed': expected some of domain, preset, seed, scale"),
        ('[grid]\nseed = ["a"]', "tiny: seed = 'a': expected a whole number, like its default 0"),
        ("[grid]\nseed = [true]", "seed = True: expected a whole number"),
        ("[parameters]\nseed = -1", "tiny: seed -1: expected a whole number"),
        ('[parameters]\npreset = "huge"', "unknown preset 'huge'"),
        ('[parameters]\ndomain = "cartpole"', "unknown domain 'cartpole'"),
        ("[grid]\nseed = 1", "grid: seed = 1: expected a list of at least one value"),
        ("[grid]\nseed = [1, 1]", "tiny__seed-1 stands in the plan twice"),
        ("[grid]\nseed = [1]\n[parameters]\nseed = 1", "seed stands in both parameters and grid"),
        ("workers = 3", "unknown key 'workers'"),
        ("minutes = 'long'", "minutes = 'long': expected a whole number or a number"),
        ("cell_minutes = -1", "cell_minutes = -1: expected a number above 0"),
        ("tags = [2024-01-01]", "expected a list of texts"),
        ("[parameters]\nscale = inf", "scale = inf: expected a finite number"),
        ("[parameters]\nseed = 2024-01-01", "expected a whole number, like its default 0"),
        ("[grid", "cannot be read as a plan"),
    ],
)
def test_a_faulty_plan_is_one_sentence_and_nothing_runs(text, sentence, tmp_path, capsys):
    plan, output = write_plan(tmp_path, text)
    assert run(plan, output) == 2
    printed = capsys.readouterr().err
    assert sentence in printed
    assert printed.count("\n") == 1
    assert not output.exists()


def test_all_faults_of_a_plan_come_together(tmp_path, capsys):
    plan, output = write_plan(tmp_path, '[parameters]\npreset = "huge"\nscale = "big"\n[grid]\nsed = [0]')
    assert run(plan, output) == 2
    printed = capsys.readouterr().err
    assert all(word in printed for word in ("'huge'", "'big'", "'sed'"))
    plan, output = write_plan(tmp_path, notebook="absent.ipynb")
    assert run(plan, output) == 2
    assert "notebook 'absent.ipynb': expected the name of a lesson, or a path from the plan's folder" in capsys.readouterr().err
    for notebook in ("", "**", str(tmp_path / "none.ipynb")):
        assert run(*write_plan(tmp_path, notebook=notebook)) == 2
        assert "expected the name of a lesson, or a path" in capsys.readouterr().err
    assert len(plans.load_plan(write_plan(tmp_path, notebook=str(tmp_path / "tiny.ipynb"))[0]).runs) == 2, "an absolute path will do"
    assert run(tmp_path / "none.toml", output) == 2
    assert "cannot be read as a plan" in capsys.readouterr().err


def test_an_unreachable_scheduler_is_one_sentence(tmp_path, capsys):
    plan, output = write_plan(tmp_path)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        assert run(plan, output, "--scheduler", address) == 2
        printed = capsys.readouterr().err
        assert f"{address}: no Dask scheduler answers" in printed
    assert not list(output.glob("*.json"))


def test_an_output_folder_that_cannot_be_written_is_one_sentence(tmp_path, capsys):
    plan, _ = write_plan(tmp_path)
    (tmp_path / "file").write_text("")
    assert run(plan, tmp_path / "file" / "out") == 2
    assert "cannot be written to" in capsys.readouterr().err


def test_a_full_output_folder_is_one_sentence_and_leaves_no_half_record(tmp_path):
    plan, output = write_plan(tmp_path)
    limited = "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\nfrom dmsrd_lite import plans\n" \
        "keep = plans._record\n" \
        "def full(*a):\n    resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY)); keep(*a)\n" \
        "plans._record = full\nfrom dmsrd_lite.__main__ import main\nsys.exit(main(sys.argv[1:]))"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", limited, "run", str(plan), "--output", str(output)], capture_output=True, text=True)
    assert done.returncode == 2
    assert "cannot be written (File too large); expected room for a file" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(output.glob("*tiny*"))


SLOW = """
import time
from IPython.display import publish_display_data
time.sleep(0.3)
publish_display_data({"application/vnd.dmsrd-lite.result+json": {"square": seed**2}})  # as hand_over, without loading torch
"""


def test_workers_killed_twice_and_all_twenty_runs_are_recorded(tmp_path, monkeypatch):
    monkeypatch.setenv("PLAN_TEST", str(tmp_path))
    plan, output = write_plan(tmp_path, f"[grid]\nseed = {list(range(20))}", [SLOW])
    driver = start(plan, output, "--workers", 2)
    for n_done in (2, 9):
        wait_for(lambda n=n_done: len(list(output.glob("*.json"))) >= n and kernels(tmp_path))
        os.kill(psutil.Process(kernels(tmp_path)[0].ppid()).pid, signal.SIGKILL)  # the worker whose kernel runs
    printed, _ = driver.communicate(timeout=180)
    assert driver.returncode == 0, printed
    assert "20 of 20 ok" in printed
    assert {r["parameters"]["seed"]: r["metrics"]["square"] for r in records_of(output).values()} == {i: i**2 for i in range(20)}
    wait_for(lambda: not kernels(tmp_path), 20)


def test_a_killed_driver_leaves_no_process_and_the_second_call_finishes_only_the_rest(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PLAN_TEST", str(tmp_path))
    plan, output = write_plan(tmp_path, f"[grid]\nseed = {list(range(8))}", [SLOW])
    driver = start(plan, output, "--workers", 2)
    wait_for(lambda: len(list(output.glob("*.json"))) >= 3 and kernels(tmp_path))
    workers = dask_workers(driver.pid)
    assert workers
    driver.kill()
    driver.communicate()
    wait_for(lambda: not any(w.is_running() and w.status() != psutil.STATUS_ZOMBIE for w in workers), 20)
    wait_for(lambda: not kernels(tmp_path), 20)
    stamps = {p: p.stat().st_mtime_ns for p in output.glob("*.json")}
    assert 3 <= len(stamps) < 8
    assert run(plan, output) == 0
    printed = capsys.readouterr().out
    assert f"8 runs, {len(stamps)} finished before" in printed
    assert "8 of 8 ok" in printed
    assert all(p.stat().st_mtime_ns == stamp for p, stamp in stamps.items())


def test_ctrl_c_stops_cleanly(tmp_path, monkeypatch):
    monkeypatch.setenv("PLAN_TEST", str(tmp_path))
    plan, output = write_plan(tmp_path, f"[grid]\nseed = {list(range(8))}", [SLOW])
    driver = start(plan, output, "--workers", 2)
    wait_for(lambda: len(list(output.glob("*.json"))) >= 2 and kernels(tmp_path))
    os.killpg(driver.pid, signal.SIGINT)  # as a terminal does: the driver and its workers
    printed, _ = driver.communicate(timeout=60)
    assert driver.returncode == 130
    assert "stopped: finished runs are recorded, the same command goes on with the others" in printed
    assert "Traceback" not in printed
    assert all(record["error"] == "" for record in records_of(output).values())
    assert 2 <= len(records_of(output)) < 8
    wait_for(lambda: not kernels(tmp_path), 20)


def test_three_routes_give_the_same_metrics_to_the_last_bit(tmp_path, capsys):
    plan, _ = write_plan(tmp_path)
    error, _ = execute(tmp_path / "tiny.ipynb", tmp_path / "direct.ipynb", {"seed": 1})
    assert error == ""
    direct = handed_over(nbformat.read(tmp_path / "direct.ipynb", 4))["total"]
    command = [
        os.path.join(os.path.dirname(sys.executable), "papermill"),
        str(tmp_path / "tiny.ipynb"),
        str(tmp_path / "cli.ipynb"),
        "-p",
        "seed",
        "1",
    ]
    subprocess.run(command, check=True, capture_output=True)
    found = {"cli": handed_over(nbformat.read(tmp_path / "cli.ipynb", 4))["total"], "direct": direct}
    assert run(plan, tmp_path / "one", "--workers", 1) == 0
    assert run(plan, tmp_path / "two", "--workers", 2) == 0
    with hand_started_cluster(2) as address:
        assert run(plan, tmp_path / "far", "--scheduler", address) == 0
    records = [records_of(tmp_path / name) for name in ("one", "two", "far")]
    found |= {i: r["tiny__seed-1"]["metrics"]["total"] for i, r in enumerate(records)}
    assert all(value == direct for value in found.values()), found
    assert records[0]["tiny__seed-0"]["metrics"] == records[2]["tiny__seed-0"]["metrics"] != records[0]["tiny__seed-1"]["metrics"]


def test_a_worker_with_another_package_refuses(tmp_path):
    write_notebook(tmp_path / "tiny.ipynb", BODY)
    answer = plans.run_text((tmp_path / "tiny.ipynb").read_text(), "tiny", {}, "0" * 16, 60, str(tmp_path))
    assert "than when the plan was read" in answer["error"]
    assert answer["text"] == ""


@pytest.mark.parametrize("path", sorted((plans.ROOT / "papermill_runs" / "plans").glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_plans_fit_their_notebooks(path):
    plan = plans.load_plan(path)
    assert plan.name == path.stem
    assert plan.runs
    assert plan.minutes > 0


def test_only_takes_values_as_they_are_written_in_the_plan(tmp_path):
    plan = plans.load_plan(write_plan(tmp_path, '[parameters]\ndomain = "lunar_lander"\n[grid]\nscale = [1, 2.5]\nseed = [0, 1]')[0])
    assert [r.parameters["scale"] for r in plan.runs] == [1.0, 1.0, 2.5, 2.5]
    for pairs, n in ((["scale=1"], 2), (["scale=2.5", "seed=1"], 1), (["domain=lunar_lander"], 4), (["notebook=tiny", "seed=0"], 2)):
        assert len(plans._selected(plan, pairs)) == n
    for pair in ("typo=None", "seed", "seed=x", "domain=None"):
        with pytest.raises(InputError, match=f"--only {pair}: leaves no run"):
            plans._selected(plan, [pair])


def test_a_default_that_cannot_be_recorded_is_named(tmp_path):
    for text in ("2 * 3", "(1, 2)", "float('nan')", "None"):
        write_notebook(tmp_path / "tiny.ipynb", BODY, parameters=f"size = {text}  # odd")
        with pytest.raises(InputError, match=r"tiny\.ipynb: parameter size = .*: expected a finite number, text"):
            plans.load_plan(write_plan(tmp_path, "")[0])


def test_two_drivers_at_once(tmp_path):
    plan = plans.load_plan(*write_plan(tmp_path))
    plan.folder.mkdir()
    with plans._locked(plan.folder), pytest.raises(InputError, match="another run of this plan is under way"):
        plans.run_plan(plan)


def test_a_grid_of_paths_gets_file_names(tmp_path):
    write_notebook(tmp_path / "tiny.ipynb", BODY, parameters='path: str = ""  # file')
    plan, output = write_plan(tmp_path, '[grid]\npath = ["a/b.npz", "a-b.npz"]')
    names = [r.name for r in plans.load_plan(plan, output).runs]
    assert len(set(names)) == 2
    assert all("/" not in n for n in names)
    with pytest.raises(InputError, match="path = 3: expected text"):
        plans.load_plan(write_plan(tmp_path, "[grid]\npath = [3]")[0])


def test_a_scheduler_that_dies_is_one_sentence(tmp_path):
    plan, output = write_plan(tmp_path, "[grid]\nseed = [0, 1, 2]", ["import time\ntime.sleep(3)"])
    with hand_started_cluster(1) as address:
        driver = start(plan, output, "--scheduler", address)
        wait_for(lambda: list(output.glob("*.json")))
        for process in psutil.Process().children():
            if "scheduler" in process.cmdline():
                process.kill()
        printed, _ = driver.communicate(timeout=90)
    assert driver.returncode == 2
    assert "the Dask scheduler is gone; the finished runs are recorded" in printed
    assert "Traceback" not in printed
    assert records_of(output)["tiny__seed-0"]["error"] == ""
