"""The command line: one sentence and exit code 2 for what cannot be used, nothing written."""

import subprocess
import sys

import pytest

from dmsrd_lite import demonstrations
from dmsrd_lite.__main__ import main


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("generate cartpole", "unknown domain 'cartpole'"),
        ("generate inverted_pendulum --seed 1.5", "seed '1.5': expected a whole number"),
        ("generate inverted_pendulum --output FILE/x", "cannot be written to"),
        ("run none.toml", "there is no such file; expected a plan"),
        ("bench --seed x", "seed 'x': expected a whole number"),
        ("bench --iterations 1", "iterations '1': expected a whole number of at least 2"),
        ("convert none.npz mine.npz --each 0", "each '0': expected a whole number of at least 1"),
        ("convert none.npz mine.npz --steps x", "steps 'x': expected a whole number of at least 0"),
        ("run none.toml --workers -1", "workers '-1': expected a whole number of at least 0"),
        ("gallery .", "holds no executed notebook with a figure for the gallery"),
        ("validate none.npz", "there is no such file"),
    ],
)
def test_refuses_in_one_sentence(arguments, sentence, tmp_path, capsys, monkeypatch):
    (tmp_path / "FILE").write_text("")
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert sentence in line
    assert [p.name for p in tmp_path.iterdir()] == ["FILE"]


def test_the_exit_code_is_that_of_the_process(tmp_path):
    command = [sys.executable, "-m", "dmsrd_lite", "validate", "none.npz"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_an_interrupt_is_one_word(monkeypatch, capsys):
    def interrupted(path):
        raise KeyboardInterrupt

    assert main(["validate", str(demonstrations.DATA_FOLDER / "inverted_pendulum_second_take.npz")]) == 0
    monkeypatch.setattr(demonstrations, "validate_file", interrupted)
    assert main(["validate", "x"]) == 130
    assert capsys.readouterr() == ("no faults\n", "stopped\n")
