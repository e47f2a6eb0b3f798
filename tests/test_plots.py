import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

from dmsrd_lite import plots

RECORDS = [
    {"branch": "new strategy", "kl_mix": None, "kl_new": 0.5, "threshold": 1.0, "n_strategies": 1},
    {"branch": "mixture", "kl_mix": 0.8, "kl_new": None, "threshold": 1.1, "n_strategies": 1},
    {"branch": "new strategy", "kl_mix": 3.0, "kl_new": 0.4, "threshold": 0.9, "n_strategies": 2},
]


def test_weights_are_stacked_to_one():
    weights = np.array([[1.0, 0.0, 0.0], [0.2, 0.3, 0.5]])
    ax = plots.plot_weights(weights, plt.figure().subplots(), ["a", "b", "c"])
    tops = np.array([[bar.get_y() + bar.get_height() for bar in part] for part in ax.containers])
    assert tops[-1] == pytest.approx([1, 1])
    assert [bar.get_height() for bar in ax.containers[1]] == pytest.approx([0.0, 0.3])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["strategy a", "strategy b", "strategy c"]


def test_decisions_show_what_was_measured():
    ax = plots.plot_decisions(RECORDS, np.array([0.4, 0.5, 0.6]), plt.figure().subplots())
    lines = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in ax.lines}
    assert lines["best mixture"] == pytest.approx([np.nan, 0.8, 3.0], nan_ok=True)
    assert lines["new policy"] == pytest.approx([0.5, np.nan, 0.4], nan_ok=True)
    assert lines["threshold"] == pytest.approx([1.0, 1.1, 0.9])
    assert [t.get_text() for t in ax.get_xticklabels()] == ["0\n(1)", "1\n(1)", "2\n(2)"]


def test_a_stream_shows_what_explains_each():
    ax = plots.plot_stream(RECORDS, np.array([0.4, 0.5, 0.6]), plt.figure().subplots())
    points = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in ax.lines}
    taken = [r["branch"] for r in RECORDS]
    for branch in set(taken):
        at = [i for i, b in enumerate(taken) if b == branch]
        values = [RECORDS[i]["kl_new" if branch == "new strategy" else "kl_mix"] for i in at]
        assert points[f"{branch} ({len(at)})"] == (at, values)


def test_a_slider_draws_once_where_nobody_can_move_it(monkeypatch):
    calls = []

    def draw(value=3):
        calls.append(value)

    monkeypatch.setattr(sys, "argv", ["kernel", "--HistoryManager.hist_file=:memory:"])
    plots.slider(draw, value=(0, 9))
    assert calls == [3]


def test_a_slider_is_a_widget_in_a_live_notebook(monkeypatch):
    made = {}
    monkeypatch.setattr(sys, "argv", ["kernel"])
    monkeypatch.setattr("ipywidgets.interact", lambda function, **controls: made.update(controls))
    plots.slider(lambda value=3: None, value=(0, 9))
    assert made == {"value": (0, 9)}
