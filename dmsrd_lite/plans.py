"""Plans: one notebook, or several, with many parameters; every run recorded; a second call does what is left."""

import ast
import fcntl
import hashlib
import itertools
import json
import os
import re
import sys
import tempfile
import threading
import time
import tomllib
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from dmsrd_lite.demonstrations import check_folder, plain, write_atomically
from dmsrd_lite.envs import InputError, check_seed, get_domain
from dmsrd_lite.runs import NOTEBOOKS, ROOT, check_preset, execute, handed_over, in_one_line, machine, versions

PACKAGE = Path(__file__).resolve().parent
LEFT_OUT = ("plots", "runs", "plans", "__main__", "__init__")  # of the source hash: they decide no number
_CHECKS = {"preset": check_preset, "domain": get_domain, "seed": check_seed}
_NUMBER = (int, float)
_TAKEN = ("plans", "records", "gallery", "checkpoints")  # folders beside the plans' own
_KEYS = {"name": str, "notebook": (str, list), "minutes": _NUMBER, "tags": list, "cell_minutes": _NUMBER, "parameters": dict, "grid": dict}
_WORDS = {str: "text", int: "a whole number", float: "a number", list: "a list", dict: "a table", bool: "true or false"}


@dataclass(frozen=True)
class Run:
    """One notebook with all of its parameters; ``name`` is that of its files."""

    name: str
    notebook: str
    text: str  # of the notebook, as it was when the plan was read
    parameters: dict  # every parameter of the notebook, defaults included
    source: str  # ``source_hash``


@dataclass(frozen=True)
class Plan:
    name: str
    runs: tuple[Run, ...]
    minutes: float = 0.0  # expected for all runs one after the other; 0: not known
    tags: tuple[str, ...] = ()
    cell_seconds: float = 0.0  # a cell that takes longer has hung; 0: ``runs.CELL_LIMITS`` of the preset
    folder: Path = field(default=Path())  # of the records and executed notebooks


def source_hash(notebook) -> str:
    """What decides a run's numbers: sha256 over the syntax trees of a notebook's code and of the package modules that it imports.

    Modules are followed through their own imports. Comments, docstrings, markdown, and the modules ``LEFT_OUT`` do not count.
    """
    from IPython.core.inputtransformer2 import TransformerManager

    plain_cells = [re.sub(r"\A\s*%%\w.*\n", "", c.source) for c in notebook.cells if c.cell_type == "code"]  # %%time hides its cell
    cells = [TransformerManager().transform_cell(source) for source in plain_cells]
    trees, waiting = {"": ast.parse("\n".join(cells))}, [""]
    while waiting:
        for name in _imported(trees[waiting.pop()]) - {*trees, *LEFT_OUT}:
            if (path := PACKAGE / f"{name}.py").is_file():
                trees[name] = ast.parse(path.read_text())
                waiting.append(name)
    text = "\n".join(f"{name}: {ast.dump(_without_docstrings(tree))}" for name, tree in sorted(trees.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def package_hash(*modules: str) -> str:
    """``source_hash`` of package modules and of all that they import."""
    from nbformat.v4 import new_code_cell, new_notebook

    return source_hash(new_notebook(cells=[new_code_cell(f"from dmsrd_lite import {', '.join(modules)}")]))


def _imported(tree: ast.AST) -> set[str]:
    """The names below ``dmsrd_lite`` that a syntax tree imports."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{a.name}" for a in node.names)]
    return {name.split(".")[1] for name in names if name.startswith("dmsrd_lite.")}


def _without_docstrings(tree: ast.AST) -> ast.AST:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return tree


def load_plan(path, folder=None) -> Plan:
    """Read a plan (TOML) and compare every parameter with the notebook's own; ``InputError`` names all faults together.

    ``folder`` is that of the results, ``papermill_runs/NAME`` if none is given.
    """
    path = Path(path).resolve()
    try:
        raw = tomllib.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a plan ({error}); expected a TOML file") from None
    faults = [f"unknown key {k!r}: expected some of {', '.join(_KEYS)}" for k in raw if k not in _KEYS]
    faults += [f"{k} = {raw[k]!r}: expected {_type_names(t)}" for k, t in _KEYS.items() if k in raw and not _is_a(raw[k], t)]
    faults += [f"{k} is missing" for k in ("name", "notebook") if k not in raw]
    if isinstance(raw.get("name"), str) and (not re.fullmatch(r"\w[\w.-]*", raw["name"], re.ASCII) or raw["name"] in _TAKEN):
        faults.append(f"name = {raw['name']!r}: expected letters, digits, '_', '-' and '.', and none of {', '.join(_TAKEN)}")
    for k in ("minutes", "cell_minutes"):
        if _is_a(raw.get(k), _NUMBER) and not 0 < raw[k] < float("inf"):
            faults.append(f"{k} = {raw[k]!r}: expected a number above 0")
    if not all(isinstance(tag, str) for tag in raw.get("tags", ()) if isinstance(raw["tags"], list)):
        faults.append(f"tags = {raw['tags']!r}: expected a list of texts")
    fixed, grid = raw.get("parameters", {}), raw.get("grid", {})
    if not faults:
        faults += [f"grid: {k} = {v!r}: expected a list of at least one value" for k, v in grid.items() if not isinstance(v, list) or not v]
        faults += [f"{k} stands in both parameters and grid: expected it in one of them" for k in fixed if k in grid]
    runs = [] if faults else _expand(raw["notebook"], path.parent, fixed, grid, faults)
    if not runs and not faults:
        faults.append(f"notebook = {raw['notebook']!r}: expected at least one")
    if faults:
        raise InputError(f"{path}: " + "; ".join(faults))
    folder = Path(folder).resolve() if folder else ROOT / "papermill_runs" / raw["name"]
    minutes, seconds = float(raw.get("minutes", 0)), 60 * float(raw.get("cell_minutes", 0))
    return Plan(raw["name"], tuple(runs), minutes, tuple(raw.get("tags", ())), seconds, folder)


def _expand(notebooks, beside: Path, fixed: dict, grid: dict, faults: list[str]) -> list[Run]:
    """A run for every notebook and every combination of the grid; adds to ``faults``."""
    import nbformat

    runs = []
    for pattern in [notebooks] if isinstance(notebooks, str) else notebooks:
        try:
            given = beside / pattern  # an absolute path stays as it is
            found = sorted(NOTEBOOKS.glob(f"{pattern}.ipynb")) or ([given] if given.is_file() else sorted(beside.glob(pattern)))
        except (NotImplementedError, ValueError, TypeError):
            found = [given] if isinstance(pattern, str) and given.is_file() else []
        if not found:
            faults.append(f"notebook {pattern!r}: expected the name of a lesson, or a path from the plan's folder")
        for notebook in found:
            try:
                text = notebook.read_text()
                own, source = _own_parameters(notebook), source_hash(nbformat.reads(text, 4))
            except InputError as error:
                faults.append(str(error))
                continue
            except Exception as error:  # nbformat, papermill and ast each have errors of their own
                faults.append(f"{notebook.name}: cannot be read ({type(error).__name__}: {error}); expected a notebook")
                continue
            used = {**{k: [v] for k, v in fixed.items()}, **grid}
            new = [fault for k, values in used.items() for v in values if (fault := _fault(notebook.stem, own, k, v))]
            faults += [fault for fault in new if fault not in faults]
            for values in itertools.product(*grid.values()) if not new else ():
                chosen = dict(sorted(zip(grid, values, strict=True)))
                parameters = {k: float(v) if isinstance(own[k], float) else v for k, v in {**own, **fixed, **chosen}.items()}
                runs.append(Run(_run_name(notebook.stem, chosen), notebook.stem, text, parameters, source))
    names = [run.name for run in runs]
    faults += [f"{name} stands in the plan twice: expected every run once" for name in sorted({n for n in names if names.count(n) > 1})]
    return runs


def _own_parameters(notebook: Path) -> dict:
    """The parameters of a notebook and their defaults."""
    from papermill import inspect_notebook

    found = {}
    for name, p in inspect_notebook(str(notebook)).items():
        try:
            found[name] = ast.literal_eval(p["default"])
        except (ValueError, SyntaxError):
            found[name] = ...
        if not _is_plain(found[name]):
            raise InputError(f"{notebook.name}: parameter {name} = {p['default']}: expected {_PLAIN} as its default")
    return found


_PLAIN = "a finite number, text, true or false, or a list of them"


def _is_plain(value) -> bool:
    """Does JSON give it back as it is? (No dates, no tuples, no NaN.)"""
    try:
        return json.loads(json.dumps(value, allow_nan=False)) == value and not isinstance(value, tuple | type(None))
    except (TypeError, ValueError):
        return False


def _is_a(value, kind) -> bool:
    return isinstance(value, kind) and (not isinstance(value, bool) or kind is bool)


def _type_names(kind) -> str:
    return " or ".join(_WORDS[k] for k in (kind if isinstance(kind, tuple) else (kind,)))


def _fault(notebook: str, own: dict, name: str, value) -> str:
    """What is wrong with one parameter's value, or ""."""
    if name not in own:
        return f"{notebook} has no parameter {name!r}: expected some of {', '.join(own)}"
    kind = type(own[name])
    if not _is_a(value, (int, float) if kind is float else kind):
        return f"{notebook}: {name} = {value!r}: expected {_type_names(kind)}, like its default {own[name]!r}"
    if not _is_plain(value):
        return f"{notebook}: {name} = {value!r}: expected {_PLAIN}"
    try:
        _CHECKS.get(name, str)(value)
    except InputError as error:
        return f"{notebook}: {error}"
    return ""


def _run_name(stem: str, chosen: dict) -> str:
    """File name of a run; values that do not fit into one are cut and marked by a hash."""
    full = "__".join([stem, *(f"{k}-{v}" for k, v in chosen.items())])
    short = re.sub(r"[^\w.=-]", "-", full, flags=re.ASCII)[:120]
    return short if short == full else f"{short}-{hashlib.sha256(full.encode()).hexdigest()[:8]}"


def read_record(path) -> dict:
    """The record of one run; ``InputError`` when it is cut short or not a record."""
    try:
        record = json.loads(Path(path).read_text())
        fits = isinstance(record, dict) and {"run", "source", "metrics", "error"} <= set(record)
        if not fits or not isinstance(record.get("parameters"), dict) or not isinstance(record.get("seconds"), int | float | None):
            raise ValueError("not a record")
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as the record of a run ({error}); it is made anew when the plan runs") from None
    return record


def read_table(folder):
    """All records of a folder as a tidy table (``pandas.DataFrame``), one run a row; numbers of the metrics as ``metrics.NAME``.

    A record that cannot be read keeps its row, with the reason as ``error``.
    """
    import pandas as pd

    rows = []
    for path in sorted(Path(folder).glob("*.json")):
        try:
            rows.append(read_record(path))
        except InputError as error:
            rows.append({"run": path.stem, "error": str(error)})
    return pd.json_normalize(rows)


def why(run: Run, folder: Path) -> str:
    """Why a run is to be done: "" when it is finished, recorded, of this source and with these parameters."""
    path = folder / f"{run.name}.json"
    try:
        if not path.exists():
            return "new"
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a readable folder") from None
    try:
        record = read_record(path)
    except InputError as error:
        return str(error)
    changed = [k for k in {**run.parameters, **record["parameters"]} if run.parameters.get(k) != record["parameters"].get(k)]
    if record["error"]:
        return "failed before"
    if changed:
        return f"another {', '.join(changed)}"
    if record["source"] != run.source:
        return "another source"
    return "" if path.with_suffix(".ipynb").exists() else "its executed notebook is gone"


_one_at_a_time = threading.Lock()


def run_text(text: str, name: str, parameters: dict, source: str, cell_seconds: float, folder: str) -> dict:
    """Execute the text of a notebook where this is called; returns the executed text and the record's machine part."""
    import nbformat

    here = source_hash(nbformat.reads(text, 4))
    if here != source:
        return {"error": f"the package here is another ({here}) than when the plan was read ({source}); expected the same", "text": ""}
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # Dask sets it to save memory; a kernel that inherits it takes 1.7 times as long
    with tempfile.TemporaryDirectory(prefix="dmsrd_lite_") as scratch:
        given, executed = Path(scratch) / f"{name}.ipynb", Path(scratch) / "executed.ipynb"
        given.write_text(text)
        with _one_at_a_time:  # papermill changes the working directory
            error, seconds = execute(given, executed, parameters, Path(folder) if Path(folder).is_dir() else ROOT, cell_seconds)
        if not error and source_hash(nbformat.reads(text, 4)) != source:
            error = "the package changed while this ran; expected it to stay"
        text = executed.read_text() if executed.exists() else ""
    try:
        results = handed_over(nbformat.reads(text, 4)) if text else {}
    except Exception:  # cut short, as by a full disk
        results, text, error = {}, "", error or "the executed notebook cannot be read"
    return {
        "versions": versions(),
        "machine": machine(),
        "seconds": round(seconds, 2),
        "environment_steps": results.pop("environment_steps", None),
        "metrics": _untimed(results),
        "error": error,
        "text": text,
    }


def _untimed(results):
    """Results without seconds, which are never the same twice."""
    if isinstance(results, list):
        return [_untimed(v) for v in results]
    if not isinstance(results, dict):
        return results
    return {k: _untimed(v) for k, v in results.items() if k != "seconds" and not k.endswith("_seconds")}


_DEAF = "import signal; signal.signal(signal.SIGINT, lambda *_: None)"  # an interrupt is the caller's business, not a worker's


@contextmanager
def _cluster(workers: int, scheduler: str) -> Iterator:
    """A Dask client: of workers on this machine, processes with one thread each, or of a scheduler that runs somewhere."""
    import logging

    from distributed import Client, LocalCluster

    for name in [n for n in logging.root.manager.loggerDict if n.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is said by us, in a sentence
    if scheduler:
        try:
            client = Client(scheduler, timeout=10)
        except Exception as error:  # unknown protocols, missing certificates, answers of something else: each has its own
            raise InputError(
                f"{scheduler}: no Dask scheduler answers ({type(error).__name__}); expected one like tcp://host:8786"
            ) from None
        with client:
            yield client
        return
    with tempfile.TemporaryDirectory(prefix="dmsrd_lite_") as scratch:
        local = {
            "preload": [_DEAF],
            "dashboard_address": None,
            "memory_limit": 0,
            "local_directory": scratch,
            "silence_logs": logging.CRITICAL,
        }
        try:
            cluster = LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, **local)
        except Exception as error:
            raise InputError(f"{workers} workers cannot be started here ({type(error).__name__}); expected fewer, or more memory") from None
        with cluster, Client(cluster) as client:
            yield client


def default_workers() -> int:
    """Half of the cores: a lesson uses two of them itself."""
    return max(1, (os.cpu_count() or 2) // 2)


def run_plan(plan: Plan, *, workers: int = 0, scheduler: str = "", only=(), force: bool = False, dry_run: bool = False) -> bool:
    """Run what is left of a plan, record by record, and print what was done; True when no run of it failed."""
    chosen = _selected(plan, only)
    reasons = {run.name: ("forced" if force else "") or why(run, plan.folder) for run in chosen}
    todo = [run for run in chosen if reasons[run.name]]
    print(f"{plan.name}: {len(chosen)} runs, {len(chosen) - len(todo)} finished before with this source and these parameters")
    for run in todo:
        print(f"  to do: {run.name} ({reasons[run.name]})")
    if plan.minutes and todo:
        print(f"  expected: about {plan.minutes * len(todo) / len(plan.runs):.0f} minutes of one worker")
    if dry_run:
        return True
    check_folder(plan.folder / "any")
    with _locked(plan.folder):
        if todo:
            with _cluster(min(workers or default_workers(), len(todo)), scheduler) as client:
                for run, answer in _results(client, plan, todo):
                    _record(plan, run, answer)
        return _summary(plan, chosen)


@contextmanager
def _locked(folder: Path) -> Iterator:
    """One driver at a time; the lock ends with the process, however that ends."""
    with open(folder / ".lock", "a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{folder}: another run of this plan is under way; expected one at a time") from None
        yield


def _selected(plan: Plan, only) -> list[Run]:
    """The runs that have all of the ``name=value`` pairs; ``notebook`` counts as a name."""

    def fits(run: Run, name: str, value: str) -> bool:
        known = {**run.parameters, "notebook": run.notebook}.get(name)
        try:
            return value == known if isinstance(known, str) else known is not None and json.loads(value.lower()) == known
        except ValueError:
            return False

    chosen = list(plan.runs)
    for pair in only:
        name, sign, value = pair.partition("=")
        chosen = [run for run in chosen if sign and fits(run, name, value)]
        if not chosen:
            raise InputError(f"--only {pair}: leaves no run of the plan {plan.name}; expected name=value, a parameter's or notebook=NAME")
    return chosen


def _results(client, plan: Plan, todo: list[Run]) -> Iterator[tuple[Run, dict]]:
    """Each run and its answer as they come; no more runs are under way than the cluster has workers."""
    from distributed import CancelledError, wait
    from tqdm import tqdm

    waiting, running, failed, shown = deque(todo), {}, 0, ""
    with tqdm(total=len(todo), unit="run", smoothing=0, dynamic_ncols=True) as bar:
        while waiting or running:
            try:
                n_workers = len(client.nthreads())  # one run at a time on each worker
            except (OSError, TimeoutError):
                raise InputError(_GONE) from None
            while waiting and len(running) < n_workers:
                run = waiting.popleft()
                task = (run.text, run.name, run.parameters, run.source, plan.cell_seconds, str(Path.cwd()))
                running[client.submit(run_text, *task, key=f"{run.name}-{os.urandom(8).hex()}")] = run
            now = f"{failed} failed; now: {', '.join(run.name for run in running.values()) or 'no workers yet'}"
            bar.set_postfix_str(now, refresh=now != shown or sys.stderr.isatty())  # a log file gets a line for a change only
            shown, done = now, []
            try:
                if running:
                    done = wait(list(running), timeout=1, return_when="FIRST_COMPLETED").done
                else:
                    time.sleep(1)
            except TimeoutError:
                pass
            except CancelledError:
                raise InputError(_GONE) from None
            for future in done:
                answer = _answer(future)
                failed += bool(answer["error"])
                yield running.pop(future), answer
                bar.update()


_GONE = "the Dask scheduler is gone; the finished runs are recorded, the same command goes on with the others"


def _answer(future) -> dict:
    """What a run came to; a worker's failure to run it at all is an answer, too."""
    from distributed import CancelledError

    try:
        return future.result()
    except CancelledError:
        raise InputError(_GONE) from None
    except Exception as error:
        return {"error": in_one_line(error), "text": ""}


def _record(plan: Plan, run: Run, answer: dict) -> None:
    """Write a run's executed notebook and then its record, each whole or not at all."""
    text = answer.pop("text")
    (plan.folder / f"{run.name}.ipynb").unlink(missing_ok=True)
    if text:
        write_atomically(plan.folder / f"{run.name}.ipynb", lambda file: file.write(text.encode()))
    made_by = {"run": run.name, "plan": plan.name, "tags": plan.tags, "notebook": run.notebook}
    used = {"parameters": run.parameters, "seed": run.parameters.get("seed"), "source": run.source}
    record = {**made_by, **used, "seconds": None, "environment_steps": None, "metrics": {}, **answer}
    content = json.dumps(plain(record), indent=1) + "\n"
    write_atomically(plan.folder / f"{run.name}.json", lambda file: file.write(content.encode()))


def _summary(plan: Plan, chosen: list[Run]) -> bool:
    """Print one line per run; True when none failed."""
    records = [read_record(plan.folder / f"{run.name}.json") for run in chosen]
    width = max(len(run.name) for run in chosen)
    print(f"{'run':<{width}}  seconds  result")
    for record in records:
        seconds = f"{record['seconds']:7.1f}" if record.get("seconds") is not None else "      -"
        print(f"{record['run']:<{width}}  {seconds}  {'FAILED: ' + record['error'] if record['error'] else 'ok'}")
    n_failed = sum(bool(record["error"]) for record in records)
    print(f"{len(records) - n_failed} of {len(records)} ok; records and executed notebooks: {plan.folder}")
    return not n_failed
