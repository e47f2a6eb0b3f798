"""Notebooks executed headless, here or in a Dask worker, and what they handed over."""

import base64
import json
import math
import os
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmsrd_lite.demonstrations import write_atomically
from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook.records import MIME, ROOT, machine, source_hash, versions

CELL_LIMITS = {"quick": 600, "full": 3600}  # seconds; a cell that takes longer has hung


def handed_over(notebook: Any) -> dict:
    """What an executed notebook (nbformat node) handed over (``Lesson.hand_over``), all cells together."""
    found: dict = {}
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            found.update(output.get("data", {}).get(MIME, {}))
    return found


def in_one_line(error: Exception) -> str:
    """The kind of an error and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error).strip() or 'no message').splitlines()[0]}"


def execute(
    path: Path, output: Path, parameters: dict, folder: Path = ROOT, cell_seconds: float = 0.0
) -> tuple[str, float]:
    """Run one notebook with papermill; "" or the error in one line, and seconds. The executed copy is kept
    either way.

    A cell that takes longer than ``cell_seconds`` counts as failed (0: ``CELL_LIMITS`` of the preset).
    """
    import papermill
    from papermill.exceptions import PapermillExecutionError
    from traitlets.config import Config

    limit = math.ceil(cell_seconds or CELL_LIMITS.get(parameters.get("preset", ""), CELL_LIMITS["full"]))
    output.parent.mkdir(parents=True, exist_ok=True)
    start, error = time.perf_counter(), ""
    options: dict[str, Any] = {
        "kernel_name": "python3",
        "cwd": str(folder),
        "execution_timeout": limit,
        "progress_bar": False,
    }
    try:
        with tempfile.TemporaryDirectory(prefix="dmsrd_lite_") as sockets:
            if os.name == "posix":  # two kernels that start at once may draw the same TCP port: no ports
                options["config"] = Config(KernelManager={"transport": "ipc", "ip": f"{sockets}/kernel"})
            papermill.execute_notebook(str(path), str(output), parameters, **options)
    except PapermillExecutionError as failure:
        error = f"cell {failure.exec_count}: {failure.ename}: {(failure.evalue.splitlines() or [''])[0]}"
    except Exception as failure:  # a dead kernel or a time-out; whatever it is, the other notebooks go on
        error = in_one_line(failure)
    return error, time.perf_counter() - start


@dataclass(frozen=True)
class Run:
    """One notebook with all of its parameters, defaults included."""

    name: str  # of its files
    notebook: str
    parameters: dict
    source: str  # ``source_of`` the text
    text: str  # of the notebook, as it was when the plan was read


def source_of(text: str) -> str:
    """``records.source_hash`` with the code of a notebook."""
    import nbformat

    return source_hash([cell.source for cell in nbformat.reads(text, 4).cells if cell.cell_type == "code"])


_one_at_a_time = threading.Lock()  # papermill changes the folder of the process


def perform(run: Run, cell_seconds: float, folder: str) -> dict:
    """Execute a run where this is called; what its record says of that, and the executed ``text``."""
    import nbformat

    if (here := source_of(run.text)) != run.source:
        text = f"the package here is another ({here}) than when the plan was read ({run.source})"
        return {"error": f"{text}; expected the same"}
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # Dask sets it; a kernel that inherits it is slower
    with _one_at_a_time, tempfile.TemporaryDirectory(prefix="dmsrd_lite_") as scratch:
        given, executed = Path(scratch) / "given.ipynb", Path(scratch) / "executed.ipynb"
        given.write_text(run.text)
        at = Path(folder) if Path(folder).is_dir() else ROOT
        error, seconds = execute(given, executed, run.parameters, at, cell_seconds)
        done = executed.read_text() if executed.exists() else ""
    if not error and source_of(run.text) != run.source:
        error = "the package changed while this ran; expected it to stay"
    try:
        results = json.dumps(handed_over(nbformat.reads(done, 4)) if done else {})
    except Exception:  # cut short, as by a full disk
        results, done, error = "{}", "", error or "the executed notebook cannot be read"
    metrics = json.loads(results, object_hook=_untimed)
    steps = metrics.pop("environment_steps", None)
    answer = {"error": error, "seconds": round(seconds, 2), "environment_steps": steps, "metrics": metrics}
    return {**answer, "versions": versions(), "machine": machine(), "text": done}


def _untimed(results: dict) -> dict:
    """Without seconds, which are never the same twice."""
    return {k: v for k, v in results.items() if k.rpartition("_")[2] != "seconds"}


def export_gallery(executed: Path, output: Path = ROOT / "papermill_runs" / "gallery") -> list[Path]:
    """The figure of every cell tagged ``gallery-NAME`` in a folder of executed notebooks as ``NAME.png``."""
    import nbformat

    written = []
    for path in sorted(executed.glob("*.ipynb")):
        for cell in nbformat.read(path, 4).cells:
            tags = [tag for tag in cell.metadata.get("tags", []) if tag.startswith("gallery-")]
            images = [
                o["data"]["image/png"] for o in cell.get("outputs", []) if "image/png" in o.get("data", {})
            ]
            for tag, image in zip(tags, map(base64.b64decode, images), strict=False):
                picture = output / f"{tag.removeprefix('gallery-')}.png"
                written.append(write_atomically(picture, image))
    if not written:
        raise InputError(f"{executed.resolve()}: holds no executed notebook with a figure for the gallery")
    return written
