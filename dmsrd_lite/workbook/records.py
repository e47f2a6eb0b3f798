"""Records of long runs, with what made them: settings and versions; for plans a hash of the source."""

import ast
import dataclasses
import hashlib
import json
import os
import platform
import re
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from dmsrd_lite.demonstrations import plain, write_atomically
from dmsrd_lite.domains import InputError

PACKAGE = Path(__file__).resolve().parent.parent
ROOT = PACKAGE.parent
NOTEBOOKS = ROOT / "notebooks"
RECORDS = ROOT / "papermill_runs" / "records"
MIME = "application/vnd.dmsrd-lite.result+json"  # of what a notebook hands over
DECIDING = (
    "domains",
    "learning",
    "demonstrations.py",
    "method",
    "beyond",
    "evaluation",
    "demonstrators",
    "workbook/presets.py",
)


def versions() -> dict[str, str]:
    """Versions of what decides the numbers."""
    packages = [p for p in ("torch", "mujoco", "gymnasium", "numpy", "scipy") if find_spec(p)]
    return {"python": platform.python_version(), **{p: version(p).split("+")[0] for p in packages}}


def machine() -> dict[str, str | int]:
    """What kind of machine this is."""
    return {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count() or 1}


def source_hash(cells: Sequence[str] = (), package: Path = PACKAGE) -> str:
    """What decides a run's numbers: sha256 over the code of the package's ``DECIDING`` parts and of a
    notebook's cells.

    Over syntax trees: comments, docstrings, markdown and the rest of the workbook (figures, plans) do not
    count.
    """
    paths = [path for part in DECIDING for path in sorted((package / part).rglob("*.py")) or [package / part]]
    parts = [f"{path.relative_to(package)}: {_code(path.read_text())}" for path in paths]
    return hashlib.sha256("\n".join([*parts, *map(_code, cells)]).encode()).hexdigest()[:16]


def _code(text: str) -> str:
    try:
        tree = ast.parse(text)
    except SyntaxError:  # a cell with magics
        return text
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and ast.get_docstring(node) is not None
        ):
            node.body = node.body[1:]
    return ast.dump(tree)


def settings_of(settings: Any) -> Any:
    """Settings as they stand in a record: names and plain values."""
    return plain(dataclasses.asdict(settings))


def same_settings(told: Any, settings: Any) -> bool:
    """Was a record that says ``told`` made with these settings? What it does not know yet, because the field
    is younger, counts as its default; what is None in ``settings`` is not asked."""
    if settings is None:
        return True
    if isinstance(settings, list | tuple):
        alike = isinstance(told, list) and len(told) == len(settings)
        return alike and all(map(same_settings, told, settings))
    if not dataclasses.is_dataclass(settings):
        return bool(told == plain(settings))
    known = {field.name: field for field in dataclasses.fields(settings)}
    return (
        isinstance(told, dict)
        and told.keys() <= known.keys()
        and all(
            same_settings(told[name], getattr(settings, name))
            if name in told
            else getattr(settings, name) == field.default
            for name, field in known.items()
        )
    )


def recorded(name: str, settings: Any = None) -> dict:
    """The results of a record; nothing, and one line that says so, where it is not there yet. A line, too,
    where it was made with other ``settings``."""
    if not (RECORDS / f"{name}.json").exists():
        print(f"no record {name} yet; a run with preset=full, record=True writes it")
        return {}
    record, _ = load_record(name)
    if settings is not None and not same_settings(record["settings"], settings):
        print(f"record {name} was made with other settings than this lesson's: a run now may differ")
    return record["results"]


def save_record(
    name: str,
    parameters: dict,
    settings: Any,
    results: dict,
    tensors: dict[str, np.ndarray],
    folder: Path = RECORDS,
) -> Path:
    """Write ``name.json`` (parameters, settings, ``source_hash``, versions, machine, results) and
    ``name.safetensors``."""
    from safetensors.numpy import save

    made_with = {"settings": settings_of(settings), "source": source_hash()}
    made_with |= {"versions": versions(), "machine": machine()}
    record = {"name": name, "parameters": parameters, **made_with, "results": results}
    text = json.dumps(plain(record), indent=1)
    one_line = r"\[\n\s+([^\[\]{}]*?)\n\s+\]"  # a list a line
    text = re.sub(one_line, lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text)
    binary = save({k: np.ascontiguousarray(v) for k, v in tensors.items()})
    write_atomically(folder / f"{name}.safetensors", binary)
    return write_atomically(folder / f"{name}.json", (text + "\n").encode())


def load_record(name: str, folder: Path = RECORDS) -> tuple[dict, dict[str, np.ndarray]]:
    """A record and its networks; ``InputError`` when it is missing or cannot be read."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = folder / f"{name}.json"
    try:
        return json.loads(path.read_text()), load_file(path.with_suffix(".safetensors"))
    except (OSError, ValueError, SafetensorError) as error:
        expected = "expected a record and its .safetensors file"
        raise InputError(f"{path}: cannot be read ({type(error).__name__}); {expected}") from None
