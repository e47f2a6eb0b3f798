"""Every lesson runs headless with ``quick``, from the repository's root and from the notebooks' folder."""

import nbformat
import pytest

from dmsrd_lite.runs import NOTEBOOKS, ROOT, execute, handed_over, lessons


@pytest.mark.parametrize("path", lessons(), ids=lambda p: p.stem)
def test_lesson_runs_quick(path, tmp_path):
    output = tmp_path / path.name
    error, seconds = execute(path, output, {"preset": "quick"})
    assert error == ""
    print(f"{path.stem}: {seconds:.0f} s")
    executed = nbformat.read(output, 4)
    assert handed_over(executed)["seconds"] > 0
    text = "".join(o.get("text", "") for c in executed.cells for o in c.get("outputs", []))
    assert "holds:" in text
    assert "does not hold" not in text


@pytest.mark.parametrize("path", lessons(), ids=lambda p: p.stem)
def test_lesson_runs_quick_on_the_lander(path, tmp_path):
    error, _ = execute(path, tmp_path / path.name, {"preset": "quick", "domain": "lunar_lander"})
    assert error == ""
    assert handed_over(nbformat.read(tmp_path / path.name, 4))["seconds"] > 0


def test_lesson_runs_from_its_own_folder(tmp_path):
    error, _ = execute(NOTEBOOKS / "00_start_here.ipynb", tmp_path / "out.ipynb", {"preset": "quick"}, folder=NOTEBOOKS)
    assert error == ""


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"domain": "cartpole"}, "unknown domain 'cartpole'"),
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"seed": -1}, "seed -1: expected a whole number"),
    ],
)
def test_bad_parameters_fail_in_one_sentence_and_keep_the_notebook(parameters, sentence, tmp_path):
    output = tmp_path / "out.ipynb"
    error, _ = execute(NOTEBOOKS / "01_demonstrations.ipynb", output, parameters)
    assert sentence in error
    assert "InputError" in error
    assert output.is_file()


def test_readme_map_names_every_lesson():
    text = (ROOT / "README.md").read_text()
    for path in lessons():
        assert f"notebooks/{path.name}" in text
