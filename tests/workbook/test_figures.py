"""Figures and videos show what they were given, in colours of a fixed meaning."""

import dataclasses
from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb

from dmsrd_lite.domains import InputError
from dmsrd_lite.workbook import figures, videos

RECORDS = [
    {"branch": "new strategy", "kl_mix": None, "kl_new": 0.5, "threshold": 1.0, "n_strategies": 1},
    {"branch": "mixture", "kl_mix": 0.8, "kl_new": None, "threshold": 1.1, "n_strategies": 1},
    {"branch": "new strategy", "kl_mix": 3.0, "kl_new": 0.4, "threshold": 0.9, "n_strategies": 2},
]
FLOOR = np.array([0.4, 0.5, 0.6])


@pytest.fixture
def ax():
    yield plt.figure().subplots()
    plt.close("all")


def texts(labels):
    return [label.get_text() for label in labels]


def test_colours_have_one_meaning_and_figures_are_white_in_any_theme():
    assert len(set(figures.STRATEGY_COLORS)) == len(set(figures.STRATEGY_MARKERS)) == 10
    assert not set(figures.INKS) & set(figures.STRATEGY_COLORS)
    assert figures.strategy_style(13) == figures.strategy_style(3) == {"color": "#CC79A7", "marker": "D"}
    with plt.rc_context():
        plt.style.use("dark_background")
        figures.use_style()
        assert to_hex(plt.rcParams["figure.facecolor"]) == to_hex(plt.rcParams["axes.facecolor"]) == "#ffffff"


def test_curves_are_means_with_a_band(ax):
    samples = np.random.default_rng(0).normal(size=(5, 4)) + np.arange(4)
    figures.plot_curves(np.arange(4), samples, "policies", ax, k=1)
    assert ax.lines[0].get_ydata() == pytest.approx(samples.mean(0))
    assert (ax.lines[0].get_label(), ax.lines[0].get_color()) == ("policies (n = 5)", figures.INKS[1])
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() < samples.mean(0).min() < samples.mean(0).max() < band.max()


def test_trajectories_in_the_colours_of_their_strategies(small_set, ax):
    shown, domain = small_set.observations[:, 0], small_set.domain
    figures.plot_phase(domain, shown, ax)
    assert [line.get_color() for line in ax.lines[::2]] == [figures.STRATEGY_COLORS[k] for k in (0, 1)]
    assert np.array_equal(ax.lines[2].get_xydata(), shown[1, ::5][:, list(domain.drawing.phase_axes)])


def test_a_reward_over_its_two_coordinates(domain, ax):
    states, along_a, along_b = figures.reward_grid(domain, 5)
    (a, b), window = domain.drawing.reward_axes, domain.drawing.reward_window
    assert (along_a[0], along_a[-1]) == window[0]
    assert (states[1, 3, a], states[1, 3, b]) == (along_a[3], along_b[1])
    assert not np.delete(states, [a, b], axis=-1).any()
    values = np.arange(25.0).reshape(5, 5)
    figures.plot_reward(domain, values, np.zeros((2, 40, 4)), ax, "title")
    assert np.array_equal(ax.collections[0].get_array(), values)
    assert len(ax.lines[0].get_xdata()) == 4, "every 20th state"
    with pytest.raises(InputError, match="inverted_pendulum: says nothing of how a state is drawn; expected"):
        figures.reward_grid(dataclasses.replace(domain, drawing=None))


def test_a_heatmap_holds_its_numbers(ax):
    table = np.array([[0.0, 1.25], [2.5, 3.0]])
    figures.plot_heatmap(table, ax, "nats", ".2f", xlabel="x", xticklabels=["a", "b"])
    assert (texts(ax.texts), texts(ax.get_xticklabels())) == (["0.00", "1.25", "2.50", "3.00"], ["a", "b"])


def test_the_truth_is_black(ax):
    values = {"cloning": np.array([1.0, 2.0]), "AIRL": np.array([3.0, 4.0]), "floor": np.array([0.5, 0.6])}
    figures.plot_per_demonstration(values, ax, "nats")
    assert [line.get_color() for line in ax.lines] == list(figures.INKS[:2])
    assert [to_hex(c) for c in ax.collections[0].get_colors()] == ["#000000"]


def test_weights_are_stacked_to_one(ax):
    figures.plot_weights(np.array([[1.0, 0.0, 0.0], [0.2, 0.3, 0.5]]), ax, ["a", "b", "c"])
    tops = [bar.get_y() + bar.get_height() for bar in ax.containers[-1]]
    assert tops == pytest.approx([1, 1])
    assert [bar.get_height() for bar in ax.containers[1]] == pytest.approx([0.0, 0.3])
    assert texts(ax.get_legend().get_texts()) == ["strategy a", "strategy b", "strategy c"]


def test_decisions_and_streams_show_what_was_measured(ax):
    figures.plot_decisions(RECORDS, FLOOR, ax, ["Ada", "Cleo", "Ben"])
    lines = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in ax.lines}
    assert lines["best mixture"] == pytest.approx([np.nan, 0.8, 3.0], nan_ok=True)
    assert lines["AIRL's new policy"] == pytest.approx([0.5, np.nan, 0.4], nan_ok=True)
    bars = {bars.get_label(): [y for (_, y), _ in bars.get_segments()] for bars in ax.collections}
    assert bars[r"threshold $\epsilon$"] == pytest.approx([1.0, 1.1, 0.9])
    assert texts(ax.get_xticklabels()) == ["Ada\n(1)", "Cleo\n(1)", "Ben\n(2)"]
    figures.plot_stream(RECORDS, FLOOR, ax)
    points = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in ax.lines}
    assert points["new strategy (2)"] == ([0, 2], [0.5, 0.4])
    assert points["mixture (1)"] == ([1], [0.8])


def test_shortfalls_stand_over_the_margin_that_decides(ax):
    asked = [{**r, "shortfall": s} for r, s in zip(RECORDS, (None, 0.01, 0.7), strict=True)]
    figures.plot_shortfalls(asked, 0.3, ax)
    lines = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in ax.lines}
    assert lines["new strategy (2)"] == pytest.approx([np.nan, 0.7], nan_ok=True), "the first was not asked"
    assert list(lines["mixture (1)"]) == [0.01]
    assert [0.3, 0.3] in [list(line) for line in lines.values()]


def test_a_film_and_its_video(domain, small_set):
    frames = videos.film(domain, np.repeat(small_set.observations[:, 0], 2, 0)[:, :21], columns=3, every=5)
    assert frames.shape == (5, 2 * 120, 3 * 240, 3), "four people, three in a row"
    assert (frames[:, 120:, 240:] == 255).all(), "white where nobody is"
    html = videos.show_video(frames, 10).data
    for part in ('src="data:video/mp4;base64,', 'poster="data:image/png;base64,', "max-width:100%"):
        assert part in html


SIGHT = {  # Machado, Oliveira and Fernandes (2009), full severity, on linear RGB
    "usual": np.eye(3),
    "protanopia":
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia":
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia":
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}  # fmt: skip


def cielab(color, sight):
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ np.clip(np.array(sight) @ linear, 0, 1) / [0.9505, 1, 1.089]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHT)
@pytest.mark.parametrize("colors", [figures.STRATEGY_COLORS, figures.INKS], ids=["people", "methods"])
def test_colours_differ_for_every_kind_of_sight(colors, sight):
    """A difference of 2.3 can just be seen; markers and lines tell apart as well."""
    seen = [cielab(color, SIGHT[sight]) for color in colors]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 10
