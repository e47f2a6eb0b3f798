"""JupyterLab on a copy of the lessons: what a reader changes there changes no file of the repository."""

import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

from dmsrd_lite.demonstrations import check_folder
from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook.lessons import NOTEBOOKS
from dmsrd_lite.workbook.records import ROOT

MINE = ROOT / "my_notebooks"
PANELS = ("assignment-list", "course-list", "create-assignment", "formgrader", "menu", "validate-assignment")
CONFIG = {  # nbgrader's panels want a course and show errors without one; Markdown is to be read
    "page_config.json": {"disabledExtensions": {f"@jupyter/nbgrader:{panel}": True for panel in PANELS}},
    "default_setting_overrides.json": {
        "@jupyterlab/docmanager-extension:plugin": {"defaultViewers": {"markdown": "Markdown Preview"}},
        "@jupyter-widgets/jupyterlab-manager:plugin": {"saveState": True},  # sliders come back
        "@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": False},
    },
}


def open_lab(as_root: bool = False) -> int:
    """Copy the lessons to ``my_notebooks`` if need be, and become JupyterLab on them: it gets signals."""
    if hasattr(os, "geteuid") and os.geteuid() == 0 and not as_root:
        text = (
            "JupyterLab does not start as root: expected another user, or 'python -m dmsrd_lite lab --root'"
        )
        raise InputError(f"{text} ('make lab ROOT=--root') if you know that nobody else reaches this machine")
    print(copy_lessons(), flush=True)
    environment = configure()
    page = f"--LabApp.default_url=/lab/tree/{MINE.name}/START.md"
    command = [sys.executable, "-m", "jupyterlab", f"--ServerApp.root_dir={ROOT}", page]
    command += ["--allow-root"] if as_root else []
    os.execve(sys.executable, command, environment)


def configure() -> dict[str, str]:
    """Write ``CONFIG``; the environment in which a JupyterLab takes it, and no other one does: a course of
    nbgrader needs its panels."""
    folder = Path(sys.prefix) / "etc/dmsrd_lite"
    for name, content in CONFIG.items():
        check_folder(folder / "labconfig" / name).write_text(json.dumps(content))
    known = os.environ.get("JUPYTER_CONFIG_PATH", "")
    return {**os.environ, "JUPYTER_CONFIG_PATH": os.pathsep.join([str(folder), *filter(None, [known])])}


def copy_lessons(folder: Path = MINE) -> str:
    """Copy the lessons once, never over what is there; says in a sentence where they are."""
    if folder.exists():
        return f"{folder}: your copy of the lessons, as you left it (move it away to get a fresh one)"
    ignored = shutil.ignore_patterns(".ipynb_checkpoints", "ruff.toml", "solutions")
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".copy-") as beside:  # whole, or not at all
        shutil.copytree(NOTEBOOKS, Path(beside) / "notebooks", ignore=ignored).rename(folder)
    return f"{folder}: your own copy of the lessons, ignored by git; notebooks/ stays as it is"
