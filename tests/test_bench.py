import json
import subprocess
import sys


def test_bench_ends_with_one_json_line():
    done = subprocess.run(
        [sys.executable, "-m", "dmsrd_lite", "bench", "--json", "--iterations", "2"], capture_output=True, text=True, check=True
    )
    *table, last = done.stdout.strip().splitlines()
    result = json.loads(last)
    assert result["ratio"] == round(result["training_steps_per_s"] / result["simulator_steps_per_s"], 3)
    assert result["simulator_steps_per_s"] == max(result["simulator_by_threads"].values())
    assert 0 < result["ratio"] < 1
    assert result["settings"]["n_environments"] == 80
    assert any("discriminator" in line for line in table), "where the time goes must be printed"
