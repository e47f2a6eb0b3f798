"""Plans: notebooks with many parameters; every run is recorded, and a second call does what is left."""

import ast
import json
import logging
import os
import re
import signal
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from glob import glob
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any

from dmsrd_lite.demonstrations import check_folder, plain, write_atomically
from dmsrd_lite.domains import InputError, get_domain
from dmsrd_lite.domains.domain import check_whole
from dmsrd_lite.workbook.execution import Run, in_one_line, perform, source_of
from dmsrd_lite.workbook.presets import check_preset
from dmsrd_lite.workbook.records import NOTEBOOKS, ROOT

_TAKEN = ("plans", "records", "gallery", "checkpoints")  # folders beside the plans' own
_TIME = (0, lambda v: type(v) in (int, float) and 0 <= v < float("inf"), "a number of at least 0")
_KEYS: dict[str, tuple[Any, Callable[[Any], Any], str]] = {  # of a plan: default, check, what is expected
    "name": ("", lambda v: isinstance(v, str) and re.fullmatch(r"\w[\w.-]*", v, re.A) and v not in _TAKEN,
             f"letters, digits, '_', '-' and '.', and none of {', '.join(_TAKEN)}"),
    "notebook": ("", lambda v: v and isinstance(v, str | list) and all(isinstance(x, str) for x in v),
                 "a text or a list of texts"),
    "minutes": _TIME, "cell_minutes": _TIME,
    "parameters": ({}, lambda v: isinstance(v, dict), "a table"),
    "grid": ({}, lambda v: isinstance(v, dict) and all(isinstance(x, list) and x for x in v.values()),
             "a table of lists of at least one value"),
}  # fmt: skip
_KINDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text", list: "a list"}
_CHECKS: dict[str, Callable[[Any], object]] = {
    "preset": check_preset, "domain": get_domain, "seed": lambda v: check_whole(v, "seed"),
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    name: str
    runs: tuple[Run, ...]
    minutes: float  # expected for all runs one after the other; 0: not known
    cell_seconds: float  # a cell that takes longer has hung; 0: ``execution.CELL_LIMITS`` of the preset
    folder: Path  # of the records and executed notebooks


def load_plan(path: str | Path, folder: str | Path | None = None) -> Plan:
    """Read a plan for results in ``folder`` or ``papermill_runs/NAME``; ``InputError`` names all faults."""
    path = Path(path).resolve()
    if not path.exists():
        raise InputError(f"{path}: there is no such file; expected a plan")
    try:
        raw = tomllib.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a plan ({error}); expected a TOML file") from None
    faults = [f"unknown key {k!r}: expected some of {', '.join(_KEYS)}" for k in raw if k not in _KEYS]
    for key, (default, fits, expected) in _KEYS.items():
        if not fits(raw.setdefault(key, default)):
            faults.append(f"{key} = {raw[key]!r}: expected {expected}")
    runs = () if faults else tuple(_runs(raw, path.parent, faults))
    twice = [name for name, n in Counter(run.name for run in runs).items() if n > 1]
    faults += [f"{name} stands in the plan twice: expected every run once" for name in twice]
    if faults:
        raise InputError(f"{path}: {'; '.join(dict.fromkeys(faults))}")
    folder = Path(folder).resolve() if folder else ROOT / "papermill_runs" / raw["name"]
    return Plan(raw["name"], runs, raw["minutes"], 60 * raw["cell_minutes"], folder)


def _runs(raw: dict, beside: Path, faults: list[str]) -> Iterator[Run]:
    """A run for every notebook and every combination of the grid; adds to ``faults``."""
    fixed, grid = raw["parameters"], raw["grid"]
    faults += [f"{k} stands in both parameters and grid: expected it in one" for k in fixed if k in grid]
    values_of = {**{k: [v] for k, v in fixed.items()}, **grid}
    for pattern in [raw["notebook"]] if isinstance(raw["notebook"], str) else raw["notebook"]:
        found = [NOTEBOOKS / name for name in sorted(glob(f"{pattern}.ipynb", root_dir=NOTEBOOKS))]
        found = found or [beside / name for name in sorted(glob(pattern, root_dir=beside))]
        for path in found or [beside / pattern]:
            try:
                own, source, text = _read(path)
            except Exception as error:  # nbformat and papermill each have errors of their own
                faults.append(
                    f"notebook {path}: expected a lesson or a notebook's path ({in_one_line(error)})"
                )
                continue
            wrong = [_fault(path.stem, own, k, v) for k, values in values_of.items() for v in values]
            faults += filter(None, wrong)
            for values in product(*values_of.values()) if not any(wrong) else ():
                given = {k: type(own[k])(v) for k, v in zip(values_of, values, strict=True)}
                name = "__".join([path.stem, *(f"{k}-{given[k]}" for k in sorted(grid))])
                yield Run(_file_name(name), path.stem, {**own, **given}, source, text)


def _read(path: Path) -> tuple[dict, str, str]:
    """A notebook's parameters, those that JSON can hold, with their defaults; its source's hash; its text."""
    from papermill import inspect_notebook

    text, own = path.read_text(), {}
    for name, parameter in inspect_notebook(path).items():
        with suppress(ValueError, SyntaxError):
            own[name] = ast.literal_eval(parameter["default"])
    return {name: value for name, value in own.items() if _is_like(value, value)}, source_of(text), text


def _is_like(value: Any, default: Any) -> bool:
    """Is it of the default's kind (a whole number is a number, too), and does JSON give it back as it is?"""
    kind = type(default)
    with suppress(TypeError, ValueError, OverflowError):
        same = kind in _KINDS and type(value) in (kind, int if kind is float else kind)
        return same and json.loads(json.dumps(kind(value), allow_nan=False)) == value
    return False


def _fault(notebook: str, own: dict, name: str, value: Any) -> str:
    """What is wrong with one parameter's value, or ""."""
    if name not in own:
        return f"{notebook} has no parameter {name!r}: expected some of {', '.join(own)}"
    if not _is_like(value, own[name]):
        return f"{notebook}: {name} = {value!r}: expected {_KINDS[type(own[name])]}, as {own[name]!r} is"
    try:
        _CHECKS.get(name, str)(value)
    except InputError as error:
        return f"{notebook}: {error}"
    return ""


def _file_name(name: str) -> str:
    """The name itself; one that no file can have is cut and marked by a hash."""
    short = re.sub(r"[^\w.=-]", "-", name, flags=re.ASCII)[:120]
    return short if short == name else f"{short}-{sha256(name.encode()).hexdigest()[:8]}"


def read_record(path: Path) -> dict:
    """The record of one run; of one that cannot be read its name, and the reason as ``error``."""
    try:
        record = json.loads(path.read_text())
        return record | {key: record[key] for key in ("name", "parameters", "source", "error")}
    except (OSError, ValueError, TypeError, KeyError) as error:
        text = f"the record cannot be read ({in_one_line(error)})"
        return {"name": path.stem, "parameters": {}, "source": "", "error": text}


def read_table(folder: str | Path) -> Any:
    """All records of a folder as a ``pandas.DataFrame``, one run a row; metrics as ``metrics.NAME``."""
    import pandas as pd

    if not (paths := sorted(Path(folder).glob("*.json"))):
        raise InputError(f"{folder}: no records in it; expected the folder of a plan that ran")
    return pd.json_normalize([read_record(path) for path in paths])


def why(run: Run, folder: Path) -> str:
    """Why a run is to be done: "" when it is finished, recorded, of this source and with these parameters."""
    path = folder / f"{run.name}.json"
    record = read_record(path)
    changed = [k for k, v in run.parameters.items() if record["parameters"].get(k) != v]
    reasons = {
        "new": not os.path.exists(path),
        "its record cannot be read": not record["source"],
        "failed before": record["error"],
        f"another {', '.join(changed)}": changed,
        "another source": record["source"] != run.source,
        "its executed notebook is gone": not os.path.exists(path.with_suffix(".ipynb")),
    }
    return next((reason for reason, holds in reasons.items() if holds), "")


def _client(n_workers: int, scheduler: str) -> Any:
    """A Dask client: of processes with one thread each on this machine, or of a scheduler somewhere."""
    from distributed import Client

    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    deaf = "from signal import *; signal(SIGINT, lambda *_: None); pthread_sigmask(SIG_UNBLOCK, [SIGINT])"
    here = {"n_workers": n_workers, "threads_per_worker": 1, "memory_limit": 0, "preload": [deaf],
            "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}  # fmt: skip
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for the driver alone: a worker
    try:  # starts with it blocked, and is deaf when its preload lets it through again (for the kernel's sake)
        return Client(scheduler, timeout=10) if scheduler else Client(**here)
    except Exception as error:  # unknown protocols, answers of something else: each has its own
        text = f"no Dask scheduler answers ({type(error).__name__}); expected one like tcp://host:8786"
        raise InputError(f"{scheduler or 'this machine'}: {text}") from None
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def run_plan(plan: Plan, *, workers: int = 0, scheduler: str = "", only: Sequence[str] = (),
             force: bool = False, dry_run: bool = False) -> bool:  # fmt: skip
    """Run what is left of a plan, record by record, and say what was done; True when no run of it failed."""
    chosen = [run for run in plan.runs if all(_has(run, pair) for pair in only)]
    if not chosen:
        text = f"leaves no run of the plan {plan.name}; expected NAME=VALUE of a parameter, or notebook=NAME"
        raise InputError(f"--only {' '.join(only)}: {text}")
    reasons = {run.name: "forced" if force else why(run, plan.folder) for run in chosen}
    todo = [run for run in chosen if reasons[run.name]]
    print(f"{plan.name}: {len(chosen)} runs, {len(chosen) - len(todo)} finished before")
    for run in todo:
        print(f"  to do: {run.name} ({reasons[run.name]})")
    if plan.minutes and todo:
        print(f"  expected: about {plan.minutes * len(todo) / len(plan.runs):.0f} minutes of one worker")
    if dry_run:
        return True
    if todo:
        _perform(plan, todo, workers, scheduler)
    records = [read_record(plan.folder / f"{run.name}.json") for run in chosen]
    for r in records:
        print(f"{r.get('seconds', 0):7.1f} s  {r['name']}  {'FAILED: ' + r['error'] if r['error'] else 'ok'}")
    n_ok = sum(not r["error"] for r in records)
    print(f"{n_ok} of {len(records)} ok; records and executed notebooks: {plan.folder}")
    return n_ok == len(records)


def _has(run: Run, pair: str) -> bool:
    """Is a run's parameter, or its ``notebook``, as NAME=VALUE says?"""
    known = {**run.parameters, "notebook": run.notebook}.items()
    return pair.lower() in {f"{k}={x}".lower() for k, v in known for x in (str(v), str(v).removesuffix(".0"))}


def _perform(plan: Plan, todo: list[Run], workers: int, scheduler: str) -> None:
    """Give Dask a run for each of its threads, and record each answer as it comes.

    Dask begins a run anew when its worker dies, and counts that death against every run that waits there: so
    none does, or a neighbour's killed workers would be the end of an innocent one.
    """
    from distributed import CancelledError, wait
    from distributed.comm import CommClosedError
    from filelock import FileLock, Timeout
    from tqdm import tqdm

    check_folder(plan.folder / "any")
    lock = FileLock(plan.folder / ".lock", timeout=0)  # it ends with the process, however that ends
    n_workers = min(workers or max(1, (os.cpu_count() or 2) // 2), len(todo))  # a lesson uses two cores
    try:
        with (
            lock,
            _client(n_workers, scheduler) as client,
            tqdm(total=len(todo), unit="run", smoothing=0) as bar,
        ):
            left, running = todo[::-1], dict[Any, Run]()
            while left or running:
                while left and len(running) < max(1, sum(client.ncores().values())):
                    future = client.submit(perform, left[-1], plan.cell_seconds, os.getcwd(), pure=False)
                    running[future] = left.pop()
                with suppress(TimeoutError):  # then look whether workers have come
                    wait(list(running), timeout=5, return_when="FIRST_COMPLETED")
                for future in [one for one in running if one.done()]:
                    error = future.exception()
                    answer = {"error": in_one_line(error)} if error else future.result()
                    _record(plan, running.pop(future), answer)
                    future.release()  # or Dask would run it again when the worker that holds the answer dies
                    bar.update()
    except Timeout:
        raise InputError(f"{plan.folder}: another run of this plan goes on; expected one at a time") from None
    except (CancelledError, CommClosedError):
        raise InputError("the Dask scheduler is gone; run the same command again for what is left") from None


def _record(plan: Plan, run: Run, answer: dict) -> None:
    """Write a run's executed notebook and then its record, each whole or not at all."""
    path, record = plan.folder / f"{run.name}.json", {**asdict(run), "text": "", "plan": plan.name, **answer}
    if text := record.pop("text"):
        write_atomically(path.with_suffix(".ipynb"), text.encode())
    else:
        path.with_suffix(".ipynb").unlink(missing_ok=True)
    write_atomically(path, (json.dumps(plain(record), indent=1) + "\n").encode())
