"""Figures: ``plot_x(data, ax=None) -> ax``. Colours have a fixed meaning; nothing is written to disk."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import seaborn
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, ScalarFormatter

from dmsrd_lite.domains import Domain
from dmsrd_lite.domains.domain import Drawing, InputError
from dmsrd_lite.evaluation.statistics import Ranks
from dmsrd_lite.method.dmsrd import BETTER_MIXTURE, MIXTURE, NEW_STRATEGY

# Okabe-Ito, then darker shades: strategy k has colour k and marker k in every notebook. Black is the truth.
STRATEGY_COLORS = tuple(
    "#E69F00 #56B4E9 #009E73 #CC79A7 #0072B2 #D55E00 #F0E442 #8C510A #7A7A7A #35236E".split()  # noqa: SIM905
)
STRATEGY_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
# All that is no strategy (methods, branches, a single curve): other colours, told apart by marker and line.
INKS = ("#4B4453", "#B0367A", "#5C7A29", "#A9A1B3", "#6C4AB6", "#2F2F2F")
INK = INKS[0]
BRANCHES = {  # of Algorithm 1: marker and colour
    MIXTURE: ("o", INKS[0]), BETTER_MIXTURE: ("D", INKS[2]), NEW_STRATEGY: ("X", INKS[1]),
}  # fmt: skip
INK_MARKERS, INK_LINES = ("o", "s", "D", "^", "v", "P"), ("-", "--", "-.", ":", "-", "--")
STYLE = dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "white")
TEN = ("font.size", "axes.titlesize", "axes.labelsize", "xtick.labelsize", "ytick.labelsize")
SIZES = {**dict.fromkeys(TEN, 10), "legend.fontsize": 9, "legend.title_fontsize": 9}
LAYOUT = {"figure.dpi": 90, "legend.frameon": False, "figure.constrained_layout.use": True}


class Text(str):
    """A text that a notebook shows without quotes."""

    def __repr__(self) -> str:
        return str(self)


def use_style() -> None:
    """seaborn's white grid, on white whatever the theme of JupyterLab; called by ``lessons.start``."""
    seaborn.set_theme(style="whitegrid", rc={**STYLE, **SIZES, **LAYOUT})


def drawing_of(domain: Domain) -> Drawing:
    """How a state is drawn; ``InputError`` where the domain does not say."""
    if domain.drawing is None:
        raise InputError(
            f"{domain.name}: says nothing of how a state is drawn; expected a domain with a drawing"
        )
    return domain.drawing


def strategy_style(k: int) -> dict[str, Any]:
    """Colour and marker of strategy k, the same everywhere."""
    return {"color": STRATEGY_COLORS[k % 10], "marker": STRATEGY_MARKERS[k % 10]}


def plot_curves(x: np.ndarray, samples: np.ndarray, label: str, ax: Axes | None = None, k: int = 0) -> Axes:
    """Mean of ``samples`` (n, len(x)) with its 95 % bootstrap band; n in the legend; k-th colour and line."""
    name = f"{label} (n = {len(samples)})"
    style = {"color": INKS[k % 6], "linestyle": INK_LINES[k % 6], "label": name}
    band = {"errorbar": ("ci", 95), "n_boot": 500, "seed": 0}
    return seaborn.lineplot(x=np.tile(x, len(samples)), y=samples.ravel(), ax=ax, **style, **band)


def plot_phase(domain: Domain, observations: np.ndarray, ax: Axes | None = None) -> Axes:
    """Phase portrait: trajectory j (n, T, obs_dim) in the colour of strategy j."""
    ax = ax or plt.gca()
    a, b = drawing_of(domain).phase_axes
    for j, states in enumerate(observations):
        style = strategy_style(j)
        ax.plot(states[::5, a], states[::5, b], linewidth=0.7, color=style["color"], alpha=0.8)
        ax.plot(*states[-1, [a, b]], **style, markersize=6, markeredgecolor="black", linestyle="none")
    ax.set(xlabel=domain.observation_names[a], ylabel=domain.observation_names[b])
    return ax


def plot_people(domain: Domain, observations: np.ndarray, kinds: Sequence[str], columns: int = 5) -> Figure:
    """A small phase portrait of each person (n, k, T, obs_dim), in the colour of their kind."""
    a, b = drawing_of(domain).phase_axes
    rows, names = -(-len(observations) // columns), sorted(set(kinds))
    figure, axes = plt.subplots(
        rows, columns, figsize=(9, 1.9 * rows + 0.4), sharex=True, sharey=True, squeeze=False
    )
    for ax in axes.flat[len(observations) :]:
        ax.set_axis_off()
    for j, (states, kind) in enumerate(zip(observations, kinds, strict=True)):
        color = STRATEGY_COLORS[names.index(kind) % 10]
        axes.flat[j].plot(states[..., a].T, states[..., b].T, linewidth=0.6, color=color)
        axes.flat[j].set_title(f"{j} {kind}" if len(observations) > 3 else kind, fontsize=9)
    figure.supxlabel(domain.observation_names[a], fontsize=10)
    figure.supylabel(domain.observation_names[b], fontsize=10)
    return figure


def reward_grid(domain: Domain, n: int = 61) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (n, n, obs_dim) over the ``reward_axes``, other coordinates at zero, and both axes (n,)."""
    (a, b), window = drawing_of(domain).reward_axes, drawing_of(domain).reward_window
    along_a, along_b = (np.linspace(low, high, n) for low, high in window)
    states = np.zeros((n, n, domain.obs_dim))
    states[..., a], states[..., b] = along_a[None, :], along_b[:, None]
    return states, along_a, along_b


def plot_reward(
    domain: Domain,
    values: np.ndarray,
    shown: np.ndarray | None = None,
    ax: Axes | None = None,
    title: str = "",
) -> Axes:
    """A reward (n, n) over ``reward_grid``, bright is rewarded; dots: every 20th state of ``shown``."""
    ax = ax or plt.gca()
    (a, b), window = drawing_of(domain).reward_axes, drawing_of(domain).reward_window
    _, along_a, along_b = reward_grid(domain, len(values))
    image = ax.pcolormesh(along_a, along_b, values, cmap="cividis", shading="auto")
    if shown is not None:
        dots = shown[..., ::20, :].reshape(-1, domain.obs_dim)
        ax.plot(dots[:, a], dots[:, b], ".", color="#FF4F00", markersize=2)
    ax.set(xlabel=domain.observation_names[a], ylabel=domain.observation_names[b], title=title,
           xlim=window[0], ylim=window[1])  # fmt: skip
    plt.colorbar(image, ax=ax, label="reward (learned, no unit)")
    return ax


def plot_heatmap(
    table: np.ndarray, ax: Axes | None = None, label: str = "", fmt: str = ".1f", **names: Any
) -> Axes:
    """A table (n, m) as a heatmap with its numbers; ``names``: xlabel, ylabel, xticklabels, yticklabels."""
    ticks = {name: names.pop(name) for name in ("xticklabels", "yticklabels") if name in names}
    small, bar = {"fontsize": 8}, {"label": label}
    ax = seaborn.heatmap(
        table, ax=ax, cmap="cividis", annot=True, fmt=fmt, annot_kws=small, cbar_kws=bar, **ticks
    )
    ax.set(**names)
    return ax


def plot_per_demonstration(values: dict[str, np.ndarray], ax: Axes | None = None, ylabel: str = "") -> Axes:
    """Markers for each method over demonstrations; black bars: the truth, ``demonstrator`` or ``floor``."""
    ax = ax or plt.gca()
    methods = [name for name in values if name not in ("demonstrator", "floor")]
    for name, numbers in values.items():
        x = np.arange(len(numbers))
        if name not in methods:
            ax.hlines(numbers, x - 0.4, x + 0.4, color="black", label=name)
            continue
        k = methods.index(name)
        shift = (k - (len(methods) - 1) / 2) * 0.2
        ax.plot(x + shift, numbers, INK_MARKERS[k % 6], color=INKS[k % 6], label=name, markersize=5)
    ax.set(xlabel="demonstration", ylabel=ylabel, xticks=x)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
    return ax


def plot_weights(weights: np.ndarray, ax: Axes | None = None, labels: Sequence[object] | None = None) -> Axes:
    """Mixture weights (n, M) as stacked bars in the colours of the strategies."""
    ax = ax or plt.gca()
    x, bottom = np.arange(len(weights)), np.zeros(len(weights))
    for j, part in enumerate(weights.T):
        name = f"strategy {labels[j] if labels else j}"
        ax.bar(x, part, bottom=bottom, color=STRATEGY_COLORS[j % 10], edgecolor="white", label=name)
        bottom += part
    ax.set(xlabel="demonstration", ylabel="mixture weight", xticks=x, ylim=(0, 1))
    ax.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return ax


def plot_decisions(
    records: Sequence[dict], floor: np.ndarray, ax: Axes | None = None, who: Sequence[str] = ()
) -> Axes:
    """KL of the best mixture and of the new policy for each demonstration (records of DMSRD), on the colour
    of the branch that was taken; under each column ``who`` it is and the strategies so far."""
    ax = ax or plt.gca()
    x = np.arange(len(records))
    labels = "decision: mixture", "mixture, AIRL was worse", "new strategy"
    for (branch, (_, color)), label in zip(BRANCHES.items(), labels, strict=True):
        taken = [i for i, r in enumerate(records) if r["branch"] == branch]
        for i in taken:
            name = label if i == taken[0] else None
            ax.axvspan(i - 0.5, i + 0.5, color=color, alpha=0.15, linewidth=0, zorder=0, label=name)
    for name, key, k in (("best mixture", "kl_mix", 0), ("AIRL's new policy", "kl_new", 1)):
        values = [np.nan if r[key] is None else max(r[key], 0.01) for r in records]
        ax.plot(x + 0.15 * (2 * k - 1), values, "oX"[k], color=INKS[k], label=name, linestyle="none")
    ax.hlines(np.maximum(floor, 0.01), x - 0.4, x + 0.4, color="black", label="floor: the person again")
    eps = [r["threshold"] for r in records]
    ax.hlines(eps, x - 0.5, x + 0.5, color="black", linestyle=":", label=r"threshold $\epsilon$")
    names = who or [str(i) for i in x]
    ticks = [f"{name}\n({r['n_strategies']})" for name, r in zip(names, records, strict=True)]
    ax.set(ylabel="KL (nats), lower is nearer", yscale="log", xticks=x, xticklabels=ticks)
    ax.set_xlabel("who arrived (strategies so far)")
    ax.set_xlim(-0.5, len(records) - 0.5)
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter(ScalarFormatter())
    ax.yaxis.set_minor_formatter(NullFormatter())
    columns = 4 if len(records) > 8 else 2  # a wide legend would squeeze a narrow figure
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, fontsize=8)
    return ax


def plot_stream(records: Sequence[dict], floor: np.ndarray, ax: Axes | None = None) -> Axes:
    """KL at arrival of what explains each demonstration of a stream (records), by the branch taken."""
    x = np.arange(len(records))
    kl = np.array([r["kl_new"] if r["branch"] == NEW_STRATEGY else r["kl_mix"] for r in records])
    ax = _by_branch(records, kl, ax)
    ax.hlines(floor, x - 0.4, x + 0.4, color="black", label="floor")
    ax.plot(x, [r["threshold"] for r in records], color=INKS[3], label=r"$\epsilon$", linewidth=0.8)
    ax.set(ylabel="KL (nats)")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=5)
    return ax


def plot_shortfalls(records: Sequence[dict], margin: float, ax: Axes | None = None) -> Axes:
    """Shortfall of each demonstration of a stream (``dmsrd.learn``) on arrival, by the branch taken, and the
    margin that decides; the first has none."""
    asked = np.array([r["shortfall"] for r in records], dtype=float)  # None becomes NaN
    ax = _by_branch(records, asked, ax)
    ax.axhline(margin, color=INKS[3], linewidth=1.2, linestyle="--")
    ax.set_yscale("symlog", linthresh=margin)
    ax.set_ylim(min(-margin / 2, 1.5 * np.nanmin(asked)), 2 * max(margin, np.nanmax(asked)))
    ax.yaxis.set_major_locator(FixedLocator([0, margin, *(t for t in (0.1, 1, 10) if t > 2 * margin)]))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set(ylabel="shortfall\n(nats)")
    return ax


def _by_branch(records: Sequence[dict], values: np.ndarray, ax: Axes | None) -> Axes:
    ax, branches = ax or plt.gca(), np.array([r["branch"] for r in records])
    for branch, (marker, color) in BRANCHES.items():
        x = np.flatnonzero(branches == branch)
        style: dict[str, Any] = {"color": color, "linestyle": "none", "markersize": 4}
        ax.plot(x, values[x], marker, label=f"{branch} ({len(x)})", **style)
    return ax


def plot_ranks(ranks: Ranks, names: Sequence[str], ax: Axes | None = None) -> Axes:
    """Mean ranks (1 is best) with half a critical difference to both sides: bars that do not overlap are
    told apart at 5 % (Demsar, 2006)."""
    ax = ax or plt.gca()
    order, half = np.argsort(-ranks.mean_ranks), ranks.critical_difference() / 2
    y = np.arange(len(order))
    ax.errorbar(ranks.mean_ranks[order], y, xerr=half, fmt="o", color=INK, capsize=3)
    ax.set(yticks=y, yticklabels=[names[i] for i in order], xlabel="mean rank", xlim=(0.5, len(y) + 0.5))
    ax.set_title(f"Q({len(y) - 1}) = {ranks.q:.1f}, p = {ranks.p:.2g}", loc="right")
    return ax


def plot_correlation(
    trajectory_rewards: np.ndarray, returns: np.ndarray, ax: Axes | None = None, every: int = 1
) -> Axes:
    """Learned mean reward of test trajectories over their true return, one dot each."""
    ax = ax or plt.gca()
    ax.plot(returns[::every], trajectory_rewards[::every], ".", markersize=2, alpha=0.4, color=INK)
    ax.set(xlabel="true return of the trajectory", ylabel="mean learned reward")
    ax.locator_params(axis="x", nbins=5)
    return ax
