"""Demonstrations of your own as a demonstration set, from three kinds of files. Nothing is unpickled.

Plain arrays (``.npz``), the folder of a Minari dataset, and the folder of trajectories that ``imitation`` (or
``datasets``) saved.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet, read_arrays
from dmsrd_lite.domains import DOMAINS, Domain, InputError
from dmsrd_lite.domains.domain import check_whole


@dataclass(frozen=True)
class Episode:
    observations: np.ndarray  # (T + 1, obs_dim); (T, obs_dim) when the last successor is unknown
    actions: np.ndarray | None  # (T, action_dim), executed
    rewards: np.ndarray | None = None  # (T,)
    reset_seed: int | None = None  # a rollout can start as it did
    over: bool = False  # it ended because the task was over, not because the time was

    @property
    def lengths(self) -> tuple[int, int]:
        """The numbers of states and of actions."""
        return len(self.observations), 0 if self.actions is None else len(self.actions)


def convert(
    source: str | Path, domain: Domain | None = None, each: int = 1, steps: int = 0
) -> tuple[DemonstrationSet, list[str]]:
    """A demonstration set from other people's files, and what a reader should know about it, a sentence each.

    ``domain``: by default the one with as many observations and actions. ``each``: so many episodes in a row
    are one person's (a file with four axes says so itself). ``steps``: only the first so many steps of every
    episode; 0: all. ``InputError`` for what cannot be used: episodes of different lengths, that ended early,
    without actions, of another domain.
    """
    path, each, steps = Path(source).resolve(), check_whole(each, "each", 1), check_whole(steps, "steps")
    episodes, together = _episodes(path)
    if together and each not in (1, together):
        text = f"has four axes, {together} episodes for each person"
        raise InputError(f"{path}: {text}; expected --each {together}, or none")
    each = together or each
    if len(episodes) % each:
        raise InputError(
            f"{path}: holds {len(episodes)} episodes; expected a multiple of {each}, each person's"
        )
    domain = domain or _domain_of(path, episodes[0])
    for i, episode in enumerate(episodes):
        if fault := _fault(episode, domain, steps, episodes[0].lengths):
            raise InputError(f"{path}: episode {i}: {fault}")
    kept: dict[str, Any] = {
        name: _stack([getattr(e, name) for e in episodes], each, steps)
        for name in ("actions", "rewards")
        if all(getattr(e, name) is not None for e in episodes)
    }
    if all(e.reset_seed is not None for e in episodes):
        kept["reset_seeds"] = np.array([e.reset_seed for e in episodes]).reshape(-1, each)
    states = [e.observations for e in episodes]
    kept["observations"] = _stack(states, each, steps + 1 if steps else 0)
    found = DemonstrationSet(domain, **kept, metadata={"source": path.name})
    if faults := found.faults():
        raise InputError(f"{path}: {faults[0]}")
    return found, [*_notes(found, min(some.dtype.itemsize for some in states))]


def _notes(found: DemonstrationSet, n_bytes: int) -> Iterator[str]:
    """What a reader should know; above all what says that these numbers mean something else than here."""
    domain, states = found.domain, found.observations
    outside = (np.clip(states, domain.observation_low, domain.observation_high) != states).any(-1).mean()
    if outside:
        bounds = f"{domain.observation_low} to {domain.observation_high}"
        yield f"{outside:.1%} of the states lie outside {bounds}, and are clipped: other units or columns?"
    rewards = np.zeros(found.actions.shape[:3]) if found.rewards is None else found.rewards
    new = states[:, :, states.shape[2] - found.horizon :]
    failed = domain.failed(new, rewards[:, :, : new.shape[2]]).any(-1)
    if failed.any():
        yield f"{failed.sum()} of {failed.size} episodes fail ({domain.failure_text}): that is learned, too"
    if found.reset_seeds is None:
        if domain.comparison.matched_starts:
            text = f"a KL on {domain.name} is then that of the starts, too, and eps is looser"
            yield f"there are no reset_seeds: rollouts start elsewhere; {text}"
    elif (gap := _replay_gap(found, found.reset_seeds)) > 1e-3:
        text = f"states {gap:.2g} of their scale away from the file's: other seeds, time step or columns?"
        yield f"its actions, replayed from its reset_seeds, lead to {text}"
    if n_bytes < 8:
        yield "observations are of single precision or less: states nearer than that look the same"
    if found.rewards is None:
        yield "there are no rewards: returns are unknown, and nothing that learns needs them"
    else:
        yield f"rewards are kept as they are; the task here pays {domain.reward_text}"
    if found.actions.shape[1] == 1:
        yield "one trajectory per person: no floor, eps is a guess (lesson 06); --each K joins K of them"


def _replay_gap(found: DemonstrationSet, reset_seeds: np.ndarray, n_steps: int = 20) -> float:
    """How far the simulator comes away from the first states of the file, in units of their scale."""
    (n, k), domain = found.actions.shape[:2], found.domain
    batch = domain.simulator.make_batch(n * k, 1)
    states, gap = batch.reset(reset_seeds.ravel()), 0.0
    for t in range(min(n_steps, found.horizon)):
        apart = states - found.observations[:, :, t].reshape(n * k, -1)
        gap = max(gap, float(np.abs(apart / domain.observation_scale).max()))
        states = batch.step(found.actions[:, :, t].reshape(n * k, -1))[0]
    return gap


def _stack(parts: Sequence[np.ndarray], each: int, n: int) -> np.ndarray:
    """Equally long parts (T, ...) -> (persons, each, n or T, ...) in double precision."""
    whole = np.stack([part[: n or None] for part in parts]).astype(np.float64)
    return whole.reshape(-1, each, *whole.shape[1:])


def _domain_of(path: Path, episode: Episode) -> Domain:
    for name, part in (("observations", episode.observations), ("actions", episode.actions)):
        if part is not None and part.ndim != 2:
            shape = f"has {name} of shape {part.shape} in an episode"
            raise InputError(f"{path}: {shape}; expected (steps, dimension), of continuous {name}")
    acted = 0 if episode.actions is None else episode.actions.shape[-1]
    found = [d for d in DOMAINS.values() if d.obs_dim == episode.observations.shape[-1]]
    fits = [d for d in found if episode.actions is None or d.action_dim == acted]
    if len(fits) != 1:
        shapes = "; ".join(f"{d.obs_dim} and {d.action_dim} ({d.name})" for d in DOMAINS.values())
        seen = f"{episode.observations.shape[-1]} observations and {acted} actions a step"
        raise InputError(f"{path}: has {seen}; expected {shapes}")
    return fits[0]


def _fault(episode: Episode, domain: Domain, steps: int, first: tuple[int, int]) -> str:
    """What is wrong with an episode; nothing if it can be used."""
    states, actions, rewards = episode.observations, episode.actions, episode.rewards
    if actions is None or not len(actions):
        return "has no actions; expected the executed action of every step"
    t = len(actions)
    if states.ndim != 2 or len(states) not in (t, t + 1) or states.shape[1] != domain.obs_dim:
        wanted = f"({t} or {t + 1}, {domain.obs_dim}) of {domain.name}"
        return f"has observations of shape {states.shape}; expected {wanted}"
    if actions.shape != (t, domain.action_dim):
        wanted = f"({t}, {domain.action_dim}) of {domain.name}"
        return f"has actions of shape {actions.shape}; expected {wanted}"
    if rewards is not None and rewards.shape != (t,):
        return f"has rewards of shape {rewards.shape}; expected ({t},)"
    for name, part in (("observations", states), ("actions", actions), ("rewards", rewards)):
        if part is not None and (fault := _no_number(part[: steps + 1] if steps else part, name)):
            return fault
    if steps:
        short = t < steps or len(states) <= steps
        found = f"has {t} steps and {len(states)} states"
        return f"{found}; expected at least {steps} and {steps + 1}, or a smaller --steps" if short else ""
    if episode.over:
        go_on = "expected a task that goes on for a fixed time, or --steps to cut all episodes"
        return f"ended early, after {t} steps; {go_on}"
    if t > domain.horizon:
        return f"has {t} steps; expected at most {domain.horizon}, or --steps {domain.horizon} to cut them"
    if episode.lengths != first:
        found = "has {} states and {} actions, the first has {} and {}".format(*episode.lengths, *first)
        return f"{found}; expected equally long episodes, or --steps"
    return ""


def _no_number(array: np.ndarray, name: str) -> str:
    """What is no finite number in an episode's array (steps, dimension) or (steps,), and where."""
    if array.dtype.kind not in "fiub":
        return f"{name}: has type {array.dtype}; expected numbers"
    for step, *coordinate in np.argwhere(~np.isfinite(array)):
        where = f"step {step}" + "".join(f", coordinate {i}" for i in coordinate)
        return f"{name}: holds NaN or infinity, first at {where}; expected finite numbers"
    return ""


def _episodes(path: Path) -> tuple[list[Episode], int]:
    """What the file or folder holds, and how many in a row are one person's (0: it does not say)."""
    kinds = "an .npz file, a Minari dataset, or trajectories saved by imitation"
    if not path.exists():
        where = f"{kinds} (a Minari dataset's folder: ~/.minari/datasets/ID)"
        raise InputError(f"{path}: there is no such file or folder; expected {where}")
    if path.suffix == ".npz":
        return _from_arrays(path)
    if (path / "state.json").is_file():
        found = _from_saved_trajectories(path)
    else:
        folders = sorted({file.parent for file in path.rglob("metadata.json") if file.parent.name == "data"})
        if len(folders) > 1:
            names = ", ".join(str(folder.parent.relative_to(path)) for folder in folders)
            raise InputError(f"{path}: holds {len(folders)} datasets ({names}); expected the folder of one")
        if not folders:
            raise InputError(f"{path}: holds no demonstrations that we can read; expected {kinds}")
        found = _from_minari(folders[0])
    if not found:
        raise InputError(f"{path}: holds no episode; expected at least one")
    return found, 0


def _from_arrays(path: Path) -> tuple[list[Episode], int]:
    """observations and actions (episodes, steps, dimension) or (persons, episodes, steps, dimension)."""
    arrays, faults = read_arrays(path)
    if faults:
        raise InputError(f"{path}: {faults[0]}")
    states, expected = arrays.get("observations"), "expected (episodes, steps, dimension)"
    if states is None or states.ndim not in (3, 4) or not states.size:
        held = ", ".join(arrays) or "nothing"
        shape = f"is missing (the file holds {held})" if states is None else f"has shape {states.shape}"
        raise InputError(f"{path}: observations: {shape}; {expected}, or one axis more in front for persons")
    lead = states.shape[:-2]
    for name, n_axes in (("actions", len(lead) + 2), ("rewards", len(lead) + 1), ("reset_seeds", len(lead))):
        if name in arrays and (arrays[name].shape[: len(lead)] != lead or arrays[name].ndim != n_axes):
            wanted = ", ".join([*map(str, lead), "steps", "dimension"][:n_axes])
            raise InputError(f"{path}: {name}: has shape {arrays[name].shape}; expected ({wanted})")
    if other := {"dones", "terminals", "truncations", "timeouts"} & arrays.keys():
        what = f"{', '.join(sorted(other))}: is not read"
        raise InputError(f"{path}: {what}; expected terminations, or nothing where no episode ended early")
    n, names = int(np.prod(lead)), ("observations", "actions", "rewards", "reset_seeds")
    flat = [arrays[k].reshape(n, *arrays[k].shape[len(lead) :]) if k in arrays else [None] * n for k in names]
    ended, t = arrays.get("terminations", np.zeros(lead)), arrays.get("actions", states).shape[-2]
    if ended.shape not in (lead, (*lead, t)):
        raise InputError(f"{path}: terminations: has shape {ended.shape}; expected {lead} or {(*lead, t)}")
    parts = zip(*flat, (bool(one.any()) for one in ended.reshape(n, -1)), strict=True)
    return [Episode(*part) for part in parts], lead[1] if len(lead) == 2 else 0


def _from_minari(folder: Path) -> list[Episode]:
    try:
        from minari import MinariDataset

        episodes = list(MinariDataset(folder).iterate_episodes())
    except ImportError:
        raise InputError(f"{folder}: needs Minari; expected pip install 'minari[hdf5]' first") from None
    except (OSError, ValueError, KeyError) as error:
        what = f"cannot be read ({type(error).__name__})"
        raise InputError(f"{folder}: {what}; expected a whole Minari dataset") from None
    for name in ("observations", "actions"):
        for part in (getattr(e, name) for e in episodes):
            if not isinstance(part, np.ndarray):  # but a dict or tuple of parts, or a list of texts
                what = f"{name} come as a {type(part).__name__}"
                raise InputError(f"{folder}: {what}; expected one vector of numbers for every step")
    return [Episode(e.observations, e.actions, e.rewards, over=any(e.terminations)) for e in episodes]


def _from_saved_trajectories(folder: Path) -> list[Episode]:
    """A folder written by ``imitation.data.serialize.save``: Arrow files with obs, acts, rews, terminal."""
    try:
        from pyarrow import ArrowInvalid, ipc
    except ImportError:
        raise InputError(f"{folder}: needs pyarrow; expected pip install pyarrow first") from None
    found = []
    try:
        for file in json.loads((folder / "state.json").read_text())["_data_files"]:
            with ipc.open_stream(folder / file["filename"]) as stream:
                table = stream.read_all()
            for row in range(len(table)):
                cells = {name: table[name][row] for name in table.column_names}
                acts, rews = (_array(cells[k]) if k in cells else None for k in ("acts", "rews"))
                over = "terminal" in cells and cells["terminal"].as_py()
                found.append(Episode(_array(cells["obs"]), acts, rews, over=over))
        return found
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArrowInvalid) as error:
        what = f"cannot be read ({type(error).__name__})"
        raise InputError(f"{folder}: {what}; expected trajectories with obs and acts") from None


def _array(cell: Any) -> np.ndarray:
    """A cell of an Arrow table, a list of numbers or of equally long lists of numbers, as an array."""
    rows, nested = cell.values, hasattr(cell.values, "flatten") and cell.values.type.num_fields
    flat = (rows.flatten() if nested else rows).to_numpy(zero_copy_only=False)
    return flat.reshape(len(rows), -1) if nested else flat
