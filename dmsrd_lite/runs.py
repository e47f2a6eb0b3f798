"""Executing the notebooks headless, handing results over, and records of long runs."""

import base64
import json
import math
import os
import platform
import re
import time
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from dmsrd_lite.demonstrations import plain, write_atomically
from dmsrd_lite.envs import InputError
from dmsrd_lite.rollouts import simulated

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
RECORDS = ROOT / "papermill_runs" / "records"
PRESETS = ("quick", "full")
CELL_LIMITS = {"quick": 600, "full": 3600}  # seconds; a cell that takes longer has hung
_MIME = "application/vnd.dmsrd-lite.result+json"


def check_preset(preset: str) -> str:
    """``preset`` itself, or ``InputError`` for one that is not in ``PRESETS``."""
    if preset not in PRESETS:
        raise InputError(f"unknown preset {preset!r}: expected one of {', '.join(PRESETS)}")
    return preset


def hand_over(**results) -> None:
    """Show results as a JSON output of the cell, so that the executed notebook itself carries them.

    Adds ``environment_steps``, all that were simulated in this notebook so far. Results named ``seconds`` or
    ``..._seconds`` are kept out of a run's metrics (``plans``), because they are never the same twice.
    """
    from IPython.display import publish_display_data

    results = plain({**results, "environment_steps": simulated["steps"]})
    publish_display_data({_MIME: results, "text/plain": json.dumps(results, indent=1)})


def handed_over(notebook) -> dict:
    """What an executed notebook (nbformat node) handed over, all cells together."""
    found = {}
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            found.update(output.get("data", {}).get(_MIME, {}))
    return found


def claim(holds: bool, text: str, strict: bool) -> None:
    """Print ``holds`` or ``does not hold`` before a claim; with ``strict`` (shipped data, default parameters) raise instead."""
    print(("holds:         " if holds else "does not hold: ") + text)
    if strict and not holds:
        raise AssertionError(f"a claim of this lesson does not hold: {text}")


def versions() -> dict[str, str]:
    """Versions of what decides the numbers."""
    packages = [p for p in ("torch", "mujoco", "gymnasium", "numpy", "scipy") if find_spec(p)]
    return {"python": platform.python_version(), **{p: version(p).split("+")[0] for p in packages}}


def machine() -> dict[str, str | int]:
    """What kind of machine this is."""
    return {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count() or 1}


def save_record(name: str, parameters: dict, results: dict, tensors: dict[str, np.ndarray], folder: Path = RECORDS) -> Path:
    """Write ``name.json`` (parameters, versions, machine, results) and ``name.safetensors`` (final networks), atomically."""
    from safetensors.numpy import save

    record = {
        "name": name,
        "parameters": parameters,
        "versions": versions(),
        "machine": machine(),
        "results": results,
    }
    text = json.dumps(plain(record), indent=1)
    text = re.sub(r"\[\n\s+([^\[\]{}]*?)\n\s+\]", lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text)  # a list a line
    binary = save({k: np.ascontiguousarray(v) for k, v in tensors.items()})
    write_atomically(Path(folder) / f"{name}.safetensors", lambda f: f.write(binary))
    return write_atomically(Path(folder) / f"{name}.json", lambda f: f.write((text + "\n").encode()))


def load_record(name: str, folder: Path = RECORDS) -> tuple[dict, dict[str, np.ndarray]]:
    """A record and its networks; ``InputError`` when it is missing or cannot be read."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = Path(folder) / f"{name}.json"
    try:
        return json.loads(path.read_text()), load_file(path.with_suffix(".safetensors"))
    except (OSError, ValueError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read ({type(error).__name__}); expected a record and its .safetensors file") from None


def lessons() -> list[Path]:
    """The notebooks in the order in which they are read."""
    return sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))


def in_one_line(error: Exception) -> str:
    """The kind of an error and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error).strip() or 'no message').splitlines()[0]}"


def execute(path: Path, output: Path, parameters: dict, folder: Path = ROOT, cell_seconds: float = 0.0) -> tuple[str, float]:
    """Run one notebook with papermill; returns ("" or the error in one line, seconds). The executed copy is kept either way.

    A cell that takes longer than ``cell_seconds`` counts as failed (0: ``CELL_LIMITS`` of the preset).
    """
    import papermill
    from papermill.exceptions import PapermillExecutionError

    output.parent.mkdir(parents=True, exist_ok=True)
    start, error = time.perf_counter(), ""
    try:
        papermill.execute_notebook(
            str(path),
            str(output),
            parameters,
            progress_bar=False,
            kernel_name="python3",
            cwd=str(folder),
            execution_timeout=math.ceil(cell_seconds or CELL_LIMITS.get(parameters.get("preset"), CELL_LIMITS["full"])),
        )
    except PapermillExecutionError as failure:
        error = f"cell {failure.exec_count}: {failure.ename}: {(failure.evalue.splitlines() or [''])[0]}"
    except Exception as failure:  # a dead kernel or a time-out; whatever it is, the other notebooks go on
        error = in_one_line(failure)
    return error, time.perf_counter() - start


def export_gallery(executed: Path, output: Path = ROOT / "papermill_runs" / "gallery") -> list[Path]:
    """Write the figure of every cell tagged ``gallery-NAME`` in a folder of executed notebooks to ``NAME.png``."""
    import nbformat

    written = []
    for path in sorted(Path(executed).glob("*.ipynb")):
        for cell in nbformat.read(path, 4).cells:
            names = [tag.removeprefix("gallery-") for tag in cell.metadata.get("tags", []) if tag.startswith("gallery-")]
            images = [o["data"]["image/png"] for o in cell.get("outputs", []) if "image/png" in o.get("data", {})]
            for name, image in zip(names, images, strict=False):
                content = base64.b64decode(image)
                written.append(write_atomically(output / f"{name}.png", lambda file, content=content: file.write(content)))
    if not written:
        raise InputError(f"{Path(executed).resolve()}: holds no executed notebook with a figure for the gallery")
    return written
