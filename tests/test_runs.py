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
