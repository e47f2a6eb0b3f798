import json

import pytest

from dmsrd_lite.__main__ import main


@pytest.mark.verify
def test_bench_ends_with_one_json_line(capsys):
    assert main(["bench", "--json", "--iterations", "2", "--from-nothing", "6"]) == 0
    *table, last = capsys.readouterr().out.strip().splitlines()
    result = json.loads(last)
    assert result["ratio"] == round(result["training_steps_per_s"] / result["simulator_steps_per_s"], 3)
    assert result["simulator_steps_per_s"] == max(result["simulator_by_threads"].values())
    assert result["training_steps_per_s"] > 0, "how much is a matter of the machine, and not tested"
    assert result["settings"]["n_environments"] == 80
    assert any("discriminator" in line for line in table), "where the time goes must be printed"
    for found in result["from_nothing"].values():
        assert min(found["ratio"], found["steps_per_s"]) > 0
        assert found["seconds_to_balance"] is found["steps_to_balance"] is None, "six iterations are too few"
