"""A copy of the lessons to read in, made once; JupyterLab on it."""

import json
import os
import sys
from pathlib import Path

import pytest

from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook import lab
from dmsrd_lite.workbook.lessons import lessons


def test_the_lessons_are_copied_once_and_never_overwritten(tmp_path):
    mine = tmp_path / "mine"
    assert lab.copy_lessons(mine).startswith(f"{mine}: your own copy")
    assert {p.name for p in mine.glob("[0-9]*")} == {p.name for p in lessons()}
    assert (mine / "START.md").is_file()
    (mine / "00_start_here.ipynb").write_text("my notes")
    (mine / "02_airl.ipynb").unlink()
    assert "as you left it" in lab.copy_lessons(mine)
    assert (mine / "00_start_here.ipynb").read_text() == "my notes"
    assert not (mine / "02_airl.ipynb").exists()


@pytest.mark.parametrize(("user", "as_root"), [(1000, False), (0, True), (0, False)])
def test_it_opens_on_the_start_page_and_root_is_told_what_to_do(user, as_root, tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(os, "execve", lambda _, command, environment: commands.append((command, environment)))
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(lab, "copy_lessons", lambda: "copied")
    monkeypatch.setattr(os, "geteuid", lambda: user, raising=False)
    if user == 0 and not as_root:
        with pytest.raises(InputError, match=r"does not start as root: expected another user, or .* --root'"):
            lab.open_lab()
        assert not commands
        return
    lab.open_lab(as_root)
    ((command, environment),) = commands
    assert command[:3] == [sys.executable, "-m", "jupyterlab"]
    assert any(part.endswith("/lab/tree/my_notebooks/START.md") for part in command)
    assert ("--allow-root" in command) == as_root
    folder, *_ = environment["JUPYTER_CONFIG_PATH"].split(os.pathsep)
    assert not (tmp_path / "etc/jupyter").exists(), "a course of nbgrader needs its panels"
    page = json.loads((Path(folder) / "labconfig/page_config.json").read_text())
    assert page["disabledExtensions"]["@jupyter/nbgrader:course-list"] is True
