import json

import pytest

from dmsrd_lite.__main__ import main


@pytest.mark.verify
def test_bench_ends_with_one_json_line(capsys):
    assert main(["bench", "--json", "--iterations", "2"]) == 0
    *table, last = capsys.readouterr().out.strip().splitlines()
    result = json.loads(last)
    assert result["ratio"] == round(result["training_steps_per_s"] / result["simulator_steps_per_s"], 3)
    assert result["simulator_steps_per_s"] == max(result["simulator_by_threads"].values())
    assert 0 < result["ratio"] < 1
    assert result["settings"]["n_environments"] == 80
    assert any("discriminator" in line for line in table), "where the time goes must be printed"
