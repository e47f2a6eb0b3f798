"""No hidden channels: importing changes nothing, and the number of threads changes no bit."""

import ast
import re
import subprocess
import sys

import pytest

from dmsrd_lite.workbook.records import PACKAGE, ROOT

MODULES = sorted(PACKAGE.rglob("*.py"))
SCRIPT = """
import importlib, pkgutil, sys
import numpy as np
import torch
torch.set_num_threads(2)
arguments = list(sys.argv)
import dmsrd_lite
for module in pkgutil.walk_packages(dmsrd_lite.__path__, "dmsrd_lite."):
    importlib.import_module(module.name)
assert (torch.get_num_threads(), sys.argv) == (2, arguments)

from dmsrd_lite.domains import INVERTED_PENDULUM
from dmsrd_lite.method.airl import AIRL, AIRLSettings, clone_demonstrations
from helpers import untrained_set
shown, found = untrained_set(INVERTED_PENDULUM), []
for n in (1, 2):
    torch.set_num_threads(n)
    cloned = clone_demonstrations(shown, 0, n_steps=50)
    learner = AIRL(shown, AIRLSettings(n_iterations=2, episodes=2, cloning_steps=50, replay_samples=100), 0)
    list(learner.train())
    evaluated = learner.averaged_rewards.evaluate(shown.observations)
    assert torch.get_num_threads() == n
    found.append([*cloned.state_dict().values(), *learner.networks().values(), evaluated])
assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True)), "threads change the bits"
"""


def test_imports_and_training_leave_the_threads_alone_and_threads_change_no_bit():
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT / "tests")
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_module_counts_reads_arguments_or_sets_threads(path):
    tree = ast.parse(path.read_text())
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "one_thread"]
    allowed = {id(node) for function in functions for node in ast.walk(function)}
    for node in ast.walk(tree):
        assert not isinstance(node, ast.Global), f"line {node.lineno}: a module keeps a count"
        if isinstance(node, ast.Attribute) and id(node) not in allowed:
            assert node.attr != "argv", f"line {node.lineno}: arguments are the command line's"
            assert node.attr != "set_num_threads", f"line {node.lineno}: use networks.one_thread"


@pytest.mark.parametrize("path", sorted(PACKAGE.glob("*/__init__.py")), ids=lambda p: p.parent.name)
def test_every_folder_says_what_it_imports_and_which_lessons_use_it(path):
    text = ast.get_docstring(ast.parse(path.read_text()))
    assert re.search(r"\bImports (nothing|everything|`)", text)
    assert re.search(r"[Ll]esson", text)


def test_the_repository_names_no_machine():
    patterns = ("*.md", "*.toml", "*.lock", "*.cff", "*/*.md", "papermill_runs/plans/*")
    for path in (*MODULES, *(found for pattern in patterns for found in ROOT.glob(pattern))):
        assert not re.search(r"(?<![\w.~])/(home|root|opt|tmp|work)/\w", path.read_text()), path
