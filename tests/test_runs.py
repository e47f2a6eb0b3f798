import numpy as np
import pytest

from dmsrd_lite import runs
from dmsrd_lite.envs import InputError


def test_record_round_trip_without_pickle(tmp_path):
    tensors = {"a": np.arange(6, dtype=np.float32).reshape(2, 3)}
    path = runs.save_record("r", {"seed": 0}, {"kl": np.array([1.0, np.nan]), "n": np.int64(3)}, tensors, tmp_path)
    record, loaded = runs.load_record("r", tmp_path)
    assert path.name == "r.json"
    assert record["results"] == {"kl": [1.0, None], "n": 3}
    assert record["versions"]["torch"] == "2.13.0"
    assert np.array_equal(loaded["a"], tensors["a"])


def test_unreadable_record_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match=r"r\.json: cannot be read"):
        runs.load_record("r", tmp_path)
    runs.save_record("r", {}, {}, {"a": np.zeros(2)}, tmp_path)
    (tmp_path / "r.safetensors").write_bytes(b"cut")
    with pytest.raises(InputError, match=r"expected a record and its \.safetensors file"):
        runs.load_record("r", tmp_path)


def test_claims_raise_only_when_strict(capsys):
    runs.claim(True, "one", strict=True)
    runs.claim(False, "two", strict=False)
    assert capsys.readouterr().out == "holds:         one\ndoes not hold: two\n"
    with pytest.raises(AssertionError, match="three"):
        runs.claim(False, "three", strict=True)


def test_a_failing_notebook_is_reported_and_kept(tmp_path, monkeypatch, capsys):
    import nbformat
    from nbformat.v4 import new_code_cell, new_notebook

    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    for name, source in (("00_good", "1 + 1"), ("01_bad", "raise ValueError('on purpose')")):
        parameters = new_code_cell('preset: str = "quick"  # size', metadata={"tags": ["parameters"]})
        nbformat.write(new_notebook(cells=[parameters, new_code_cell(source)], metadata=kernel), tmp_path / f"{name}.ipynb")
    monkeypatch.setattr(runs, "NOTEBOOKS", tmp_path)
    assert runs.workbook("quick", tmp_path / "out") is False
    printed = capsys.readouterr().out
    assert "00_good" in printed
    assert ": ValueError: on purpose" in printed
    assert (tmp_path / "out" / "01_bad.ipynb").is_file()
