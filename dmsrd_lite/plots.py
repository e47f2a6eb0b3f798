"""Figures of the notebooks: ``plot_x(data, ax=None) -> ax``. Colours have a fixed meaning; nothing is written to disk."""

import base64
import os
import sys
import tempfile

import matplotlib.pyplot as plt
import numpy as np

from dmsrd_lite.envs import Domain

# Okabe-Ito, then four darker shades: strategy k has colour k and marker k in every notebook.
STRATEGY_COLORS = ("#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#0072B2", "#D55E00", "#F0E442", "#8C510A", "#7A7A7A", "#35236E")
STRATEGY_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
STYLE = {
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.dpi": 90,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "font.size": 10,
    "legend.frameon": False,
    "axes.titlesize": 10,
    "figure.constrained_layout.use": True,
}


def use_style() -> None:
    """White figures whatever the theme; called once at the top of a notebook."""
    plt.rcParams.update(STYLE)


def strategy_style(k: int) -> dict:
    """Colour and marker of strategy k, the same everywhere."""
    return {"color": STRATEGY_COLORS[k % 10], "marker": STRATEGY_MARKERS[k % 10]}


def bootstrap_band(samples: np.ndarray, seed: int = 0, n_draws: int = 500) -> np.ndarray:
    """95 % bootstrap interval of the mean over axis 0: samples (n, ...) -> (2, ...)."""
    rng = np.random.default_rng(seed)
    means = [samples[rng.integers(0, len(samples), len(samples))].mean(0) for _ in range(n_draws)]
    return np.quantile(means, [0.025, 0.975], axis=0)


def plot_curves(x: np.ndarray, samples: np.ndarray, label: str, color: str, ax=None, linestyle: str = "-"):
    """Mean of ``samples`` (n, len(x)) over x with its 95 % bootstrap band; n stands in the legend."""
    ax = ax or plt.gca()
    low, high = bootstrap_band(samples)
    ax.plot(x, samples.mean(0), color=color, linestyle=linestyle, label=f"{label} (n = {len(samples)})")
    ax.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
    return ax


def plot_phase(domain: Domain, observations: np.ndarray, labels=None, ax=None, axes: tuple[int, int] | None = None, step: int = 5):
    """Phase portrait: trajectory j (n, T, obs_dim) in the colour of strategy ``labels[j]`` (default j)."""
    ax = ax or plt.gca()
    a, b = axes or domain.phase_axes
    for j, states in enumerate(observations):
        style = strategy_style(j if labels is None else int(labels[j]))
        ax.plot(states[::step, a], states[::step, b], linewidth=0.7, color=style["color"], alpha=0.8)
        ax.plot(*states[-1, [a, b]], **style, markersize=6, markeredgecolor="black", linestyle="none")
    ax.set(xlabel=domain.observation_names[a], ylabel=domain.observation_names[b])
    return ax


def plot_heatmap(table: np.ndarray, ax=None, label: str = "", fmt: str = ".1f", xlabel: str = "", ylabel: str = ""):
    """A table (n, m) as a cividis heatmap with its numbers."""
    ax = ax or plt.gca()
    image = ax.imshow(table, cmap="cividis", aspect="auto")
    middle = (np.nanmin(table) + np.nanmax(table)) / 2
    for i, row in enumerate(table):
        for j, value in enumerate(row):
            if np.isfinite(value):
                ax.text(j, i, format(value, fmt), ha="center", va="center", fontsize=7, color="white" if value < middle else "black")
    ax.set(xlabel=xlabel, ylabel=ylabel, xticks=range(table.shape[1]), yticks=range(table.shape[0]))
    ax.spines[:].set_visible(False)
    plt.colorbar(image, ax=ax, label=label)
    return ax


def plot_per_demonstration(values: dict[str, np.ndarray], ax=None, ylabel: str = ""):
    """One row of markers per method over the demonstrations; black bars are the ground truth ``demonstrator`` or ``floor``."""
    ax = ax or plt.gca()
    truth = ("demonstrator", "floor")
    methods = [name for name in values if name not in truth]
    for name, numbers in values.items():
        x = np.arange(len(numbers))
        if name in truth:
            ax.hlines(numbers, x - 0.4, x + 0.4, color="black", label=name)
        else:
            shift = (methods.index(name) - (len(methods) - 1) / 2) * 0.2
            ax.plot(
                x + shift,
                numbers,
                "osD^"[methods.index(name) % 4],
                label=name,
                markersize=5,
                color=STRATEGY_COLORS[(4, 5, 2, 3)[methods.index(name) % 4]],
            )
    ax.set(xlabel="demonstration", ylabel=ylabel, xticks=x)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4, fontsize=8)
    return ax


def plot_weights(weights: np.ndarray, ax=None, labels=None):
    """Mixture weights (n, M) as stacked bars, one for each demonstration, in the colours of the strategies (default names: 0, 1, ...)."""
    ax = ax or plt.gca()
    bottom = np.zeros(len(weights))
    for j, part in enumerate(weights.T):
        ax.bar(
            np.arange(len(weights)),
            part,
            bottom=bottom,
            color=STRATEGY_COLORS[j % 10],
            edgecolor="white",
            label=f"strategy {labels[j] if labels else j}",
        )
        bottom += part
    ax.set(xlabel="demonstration", ylabel="mixture weight", xticks=range(len(weights)))
    ax.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8)
    return ax


def plot_decisions(records, floor: np.ndarray, ax=None):
    """KL of the best mixture and of the new policy for each demonstration (``lifelong`` records), and the strategies so far."""
    ax = ax or plt.gca()
    x = np.arange(len(records))
    for name, key, marker, color in (("best mixture", "kl_mix", "o", "#0072B2"), ("new policy", "kl_new", "X", "#D55E00")):
        ax.plot(x, [np.nan if r[key] is None else max(r[key], 0.01) for r in records], marker, color=color, label=name, linestyle="none")
    ax.hlines(np.maximum(floor, 0.01), x - 0.4, x + 0.4, color="black", label="floor")
    ax.plot(x, [r["threshold"] for r in records], color="#7A7A7A", label="threshold", drawstyle="steps-mid")
    ticks = [f"{i}\n({r['n_strategies']})" for i, r in enumerate(records)]
    ax.set(xlabel="demonstration, in order of arrival (strategies so far)", ylabel="KL (nats)", yscale="log", xticks=x, xticklabels=ticks)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4, fontsize=8)
    return ax


def plot_stream(records, floor: np.ndarray, ax=None):
    """KL at arrival of what explains each demonstration of a long stream (``lifelong`` records), by the branch taken."""
    ax = ax or plt.gca()
    styles = {"mixture": ("o", "#0072B2"), "mixture, better than a new strategy": ("D", "#009E73"), "new strategy": ("X", "#D55E00")}
    x, branches = np.arange(len(records)), np.array([r["branch"] for r in records])
    kl = np.array([r["kl_new"] if r["branch"] == "new strategy" else r["kl_mix"] for r in records])
    for branch, (marker, color) in styles.items():
        some = branches == branch
        ax.plot(x[some], kl[some], marker, color=color, label=f"{branch} ({some.sum()})", linestyle="none", markersize=4)
    ax.hlines(floor, x - 0.4, x + 0.4, color="black", label="floor")
    ax.plot(x, [r["threshold"] for r in records], color="#7A7A7A", label="threshold", linewidth=0.8)
    ax.set(ylabel="KL (nats)")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=5, fontsize=8)
    return ax


def plot_correlation(trajectory_rewards: np.ndarray, returns: np.ndarray, ax=None, every: int = 1):
    """Learned mean reward of test trajectories over their true return, one dot each."""
    ax = ax or plt.gca()
    ax.plot(returns[::every], trajectory_rewards[::every], ".", markersize=2, alpha=0.4, color="#0072B2")
    ax.set(xlabel="true return of the trajectory", ylabel="mean learned reward")
    return ax


def slider(function, **controls) -> None:
    """Sliders over a drawing function's arguments in a live notebook; in a headless run one call with its defaults.

    Nobody moves a slider there, and nbclient, which papermill runs on, now and then waits forever for a widget's output.
    """
    if any("hist_file=:memory:" in argument for argument in sys.argv):  # nbclient starts its kernels so
        function()
        return
    from ipywidgets import interact

    interact(function, **controls)


def film(domain: Domain, observations: np.ndarray, columns: int = 5, every: int = 2) -> np.ndarray:
    """Frames (n_frames, height, width, 3) of several trajectories (n, T, obs_dim) side by side, every ``every``-th state."""
    n = len(observations)
    rows = -(-n // columns)
    frames = []
    for states in np.moveaxis(observations, 1, 0)[::every]:
        tiles = [domain.draw_frame(s) for s in states]
        tiles += [np.full_like(tiles[0], 255)] * (rows * columns - n)
        frames.append(np.vstack([np.hstack(tiles[r * columns : (r + 1) * columns]) for r in range(rows)]))
    return np.array(frames)


def show_video(frames: np.ndarray, frames_per_second: float):
    """An MP4 inside the notebook (no file stays behind); returns an IPython display object."""
    import imageio_ffmpeg
    from IPython.display import HTML

    height, width = frames.shape[1] // 2 * 2, frames.shape[2] // 2 * 2
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "video.mp4")
        writer = imageio_ffmpeg.write_frames(path, (width, height), fps=frames_per_second, macro_block_size=2, quality=6)
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame[:height, :width]))
        writer.close()
        with open(path, "rb") as file:
            text = base64.b64encode(file.read()).decode()
    return HTML(f'<video controls loop muted width="{width}" src="data:video/mp4;base64,{text}"></video>')
