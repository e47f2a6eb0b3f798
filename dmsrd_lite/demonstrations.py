"""Demonstration sets and test sets as ``.npz`` files: load, check, save. Nothing is ever unpickled."""

import json
import math
import os
import tempfile
import zipfile
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dmsrd_lite.envs import DOMAINS, Domain, InputError, get_domain
from dmsrd_lite.rollouts import Rollouts

SCHEMA_VERSION = 1
DATA_FOLDER = Path(__file__).resolve().parent.parent / "data"


@dataclass(frozen=True)
class DemonstrationSet:
    """Demonstrations of several users, equally long; an optional field that the file lacks is None.

    observations (n, k, T+1, obs_dim) raw, or (n, k, T, obs_dim) when the last successor is unknown; actions
    (n, k, T, action_dim) executed; rewards (n, k, T); strategy_labels (n,) for evaluation only; reset_seeds (n, k);
    log_likelihoods (n, k) nats, the demonstrator's own.
    """

    domain: Domain
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray | None = None
    strategy_labels: np.ndarray | None = None
    reset_seeds: np.ndarray | None = None
    log_likelihoods: np.ndarray | None = None
    metadata: dict = field(default_factory=dict)

    @property
    def n_demonstrations(self) -> int:
        return len(self.actions)

    @property
    def horizon(self) -> int:
        return self.actions.shape[2]

    @property
    def returns(self) -> np.ndarray | None:
        """Undiscounted return of every trajectory, (n, k)."""
        return None if self.rewards is None else self.rewards.sum(-1)

    def transitions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``(s, a, s')``, each (n, k * t, dim); with only T states given, the last transition is left out."""
        t = self.observations.shape[2] - 1
        parts = self.observations[:, :, :t], self.actions[:, :, :t], self.observations[:, :, 1:]
        return tuple(p.reshape(len(p), -1, p.shape[-1]) for p in parts)

    def arrays(self) -> dict[str, np.ndarray]:
        """The fields that are there, by name."""
        return {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}

    def select(self, indices) -> "DemonstrationSet":
        """The demonstrations ``indices`` (a list), in that order."""
        return replace(self, **{name: array[list(indices)] for name, array in self.arrays().items()})

    def joined(self, other: "DemonstrationSet") -> "DemonstrationSet":
        """These demonstrations and then ``other``'s; an optional field stays where both have it."""
        mine, others = self.arrays(), other.arrays()
        both = {name: np.concatenate([mine[name], others[name]]) for name in _ARRAYS if name in mine and name in others}
        return DemonstrationSet(self.domain, **both, metadata=self.metadata)

    def pooled(self) -> "DemonstrationSet":
        """All trajectories as one demonstration, as if one user had given them (AIRL Batch)."""
        whole = {name: array for name, array in self.arrays().items() if name != "strategy_labels"}
        return DemonstrationSet(self.domain, **{n: a.reshape(1, -1, *a.shape[2:]) for n, a in whole.items()}, metadata=self.metadata)


_ARRAYS = ("observations", "actions", "rewards", "strategy_labels", "reset_seeds", "log_likelihoods")


def demonstrations_from(data: Rollouts, actor, metadata: dict | None = None) -> DemonstrationSet:
    """Rollouts of an actor's M policies as M demonstrations, with executed actions and the actor's own log-likelihood of them."""
    m, k, t = data.rewards.shape
    executed = data.executed_actions
    log_pi = actor.log_density(data.observations[:, :, :-1].reshape(m, k * t, -1), executed.reshape(m, k * t, -1))
    own = log_pi.reshape(m, k, t).astype(np.float64).sum(-1)
    return DemonstrationSet(data.domain, data.observations, executed, data.rewards, np.arange(m), data.reset_seeds, own, metadata or {})


@dataclass(frozen=True)
class RewardTestSet:
    """Trajectories from failure to success with their true returns, to evaluate a reward.

    observations (n, T/stride, obs_dim), every ``stride``-th new state; returns (n,) of the whole trajectory; policy (n,),
    snapshot (n,): who made it and when in training; returns_every_step (n,), never stopped; None where the file lacks it.
    """

    domain: Domain
    observations: np.ndarray
    returns: np.ndarray
    policy: np.ndarray
    snapshot: np.ndarray
    metadata: dict
    returns_every_step: np.ndarray | None = None


def _read(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """All arrays of a file, and a sentence for each that cannot be read."""
    if not path.is_file():
        return {}, [f"{path}: there is no such file; expected a demonstration set (.npz)"]
    arrays, faults = {}, []
    try:
        file = np.load(path, allow_pickle=False)
        if isinstance(file, np.ndarray):
            return {}, [f"{path}: holds a single array; expected an .npz with named arrays"]
        with file:
            for name in file.files:
                try:
                    array = file[name]
                    if not isinstance(array, np.ndarray):
                        raise ValueError(f"{name} is no array")
                    arrays[name] = array
                except ValueError as error:
                    if "Object arrays" not in str(error):
                        raise
                    faults.append(
                        f"{path}: {name}: holds pickled objects (trajectories of unequal length end up so); "
                        "expected one array of numbers, all trajectories equally long"
                    )
    except (ValueError, OSError, EOFError, MemoryError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return {}, [f"{path}: cannot be read (truncated, pickled or no .npz file); expected a file written by save_demonstrations"]
    return arrays, faults


def _read_metadata(arrays: dict, path: Path) -> tuple[dict, list[str]]:
    if "metadata" not in arrays:
        return {}, [f"{path}: metadata: is missing; expected a JSON text with domain and schema_version"]
    try:
        metadata = json.loads(str(arrays["metadata"]))
        assert isinstance(metadata, dict)
    except (ValueError, AssertionError):
        return {}, [f"{path}: metadata: is no JSON object; expected a JSON text with domain and schema_version"]
    faults = []
    if metadata.get("domain") not in list(DOMAINS):
        faults.append(f"{path}: metadata: domain {metadata.get('domain')!r} is unknown; expected one of {', '.join(DOMAINS)}")
    if metadata.get("schema_version") != SCHEMA_VERSION:
        faults.append(f"{path}: metadata: schema_version is {metadata.get('schema_version')!r}; expected {SCHEMA_VERSION}")
    return metadata, faults


def _check_array(array, name: str, shape: tuple, path: Path) -> list[str]:
    """Faults of one array; ``shape`` holds a number (that length), a set (one of these) or a word (any, at least 1)."""
    if array.dtype.kind not in "fiub":
        return [f"{path}: {name}: has type {array.dtype}; expected numbers"]
    wanted = "(" + ", ".join(" or ".join(map(str, sorted(s))) if isinstance(s, set) else str(s) for s in shape) + ")"
    fits = 0 not in array.shape and array.ndim == len(shape)
    fits = fits and all(isinstance(s, str) or n in (s if isinstance(s, set) else {s}) for n, s in zip(array.shape, shape, strict=True))
    if not fits:
        hint = " and at least one demonstration" if 0 in array.shape else ""
        return [f"{path}: {name}: has shape {array.shape}; expected {wanted}{hint}"]
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        return [f"{path}: {name}: holds NaN or infinity, first at index {where}; expected finite numbers"]
    return []


def _check_demonstrations(arrays: dict, domain: Domain, path: Path) -> list[str]:
    missing = [name for name in ("observations", "actions") if name not in arrays]
    if missing:
        return [f"{path}: {name}: is missing; expected an array (demonstrations, trajectories, steps, dimension)" for name in missing]
    faults = _check_array(arrays["actions"], "actions", ("demonstrations", "trajectories", "steps", domain.action_dim), path)
    if faults:
        return faults
    n, k, t = arrays["actions"].shape[:3]
    shapes = {
        "observations": (n, k, {t, t + 1}, domain.obs_dim),
        "rewards": (n, k, t),
        "strategy_labels": (n,),
        "reset_seeds": (n, k),
        "log_likelihoods": (n, k),
    }
    for name, shape in shapes.items():
        if name in arrays:
            faults += _check_array(arrays[name], name, shape, path)
    if not 10 <= t <= domain.horizon:
        faults.append(f"{path}: actions: trajectories have {t} steps; expected 10 to {domain.horizon}, the horizon of {domain.name}")
    low, high = np.array(domain.action_low) - 1e-6, np.array(domain.action_high) + 1e-6
    outside = (arrays["actions"] < low) | (arrays["actions"] > high)
    if outside.any():
        where = tuple(int(i) for i in np.argwhere(outside)[0])
        faults.append(
            f"{path}: actions: {arrays['actions'][where]:g} at index {where} is outside the bounds; expected executed "
            f"actions in [{domain.action_low[where[-1]]:g}, {domain.action_high[where[-1]]:g}]"
        )
    for name in {"reset_seeds", "strategy_labels"} & set(arrays):
        if arrays[name].dtype.kind not in "iu" or arrays[name].min(initial=0) < 0:
            faults.append(f"{path}: {name}: has type {arrays[name].dtype} or negative values; expected whole numbers of at least 0")
    return faults


def _inspect(path: Path) -> tuple[dict[str, np.ndarray], dict, list[str]]:
    """Arrays, metadata and faults of a file, read once."""
    arrays, faults = _read(path)
    if faults and not arrays:
        return arrays, {}, faults
    metadata, more = _read_metadata(arrays, path)
    faults += more
    if not faults:
        domain = get_domain(metadata["domain"])
        faults += _check_test_set(arrays, metadata, domain, path) if "returns" in arrays else _check_demonstrations(arrays, domain, path)
    return arrays, metadata, faults


def validate_file(path) -> list[str]:
    """One sentence for every fault of a demonstration file or test set; an empty list when it can be used."""
    return _inspect(Path(path).resolve())[2]


def _load_checked(path, kind: str) -> tuple[dict, dict, Path]:
    path = Path(path).resolve()
    arrays, metadata, faults = _inspect(path)
    if faults:
        raise InputError(faults[0] + (f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""))
    found = "test set" if "returns" in arrays else "demonstration set"
    if found != kind:
        raise InputError(f"{path}: is a {found}; expected a {kind}")
    return arrays, metadata, path


def load_demonstrations(path, domain: Domain | None = None) -> DemonstrationSet:
    """Read and check a demonstration set; ``InputError`` when it is faulty or of another domain than ``domain``."""
    arrays, metadata, path = _load_checked(path, "demonstration set")
    if domain is not None and metadata["domain"] != domain.name:
        raise InputError(f"{path}: metadata: domain is {metadata['domain']}; expected {domain.name}")
    kept = {
        name: arrays[name].astype(np.int64 if name in ("strategy_labels", "reset_seeds") else np.float64)
        for name in _ARRAYS
        if name in arrays
    }
    return DemonstrationSet(get_domain(metadata["domain"]), **kept, metadata=metadata)


def load_shipped(domain: Domain, kind: str = "demonstrations"):
    """A file that the repository ships: ``demonstrations``, ``second_take``, ``test_set`` or ``development_set``."""
    path = DATA_FOLDER / f"{domain.name}_{kind}.npz"
    return load_test_set(path) if kind in ("test_set", "development_set") else load_demonstrations(path, domain)


def _check_test_set(arrays: dict, metadata: dict, domain: Domain, path: Path) -> list[str]:
    missing = [n for n in ("observations", "policy", "snapshot") if n not in arrays]
    if missing:
        return [f"{path}: {name}: is missing; expected an array of a test set" for name in missing]
    faults = _check_array(arrays["returns"], "returns", ("trajectories",), path)
    if not isinstance(metadata.get("stride"), int):
        faults.append(f"{path}: metadata: stride is missing; expected every how many steps a state was kept")
    if faults:
        return faults
    n = len(arrays["returns"])
    shapes = {"observations": (n, "steps", domain.obs_dim), "policy": (n,), "snapshot": (n,), "returns_every_step": (n,)}
    return [fault for name, shape in shapes.items() if name in arrays for fault in _check_array(arrays[name], name, shape, path)]


def load_test_set(path) -> RewardTestSet:
    """Read and check a test set for rewards; ``InputError`` when it cannot be used."""
    arrays, metadata, _ = _load_checked(path, "test set")
    return RewardTestSet(
        get_domain(metadata["domain"]),
        arrays["observations"].astype(np.float32),
        arrays["returns"].astype(np.float64),
        arrays["policy"],
        arrays["snapshot"],
        metadata,
        arrays["returns_every_step"].astype(np.float64) if "returns_every_step" in arrays else None,
    )


def plain(value):
    """Numbers, strings, lists and dicts only, so that JSON can hold it; NaN becomes None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_folder(path) -> Path:
    """``path`` resolved, its folder made if need be; ``InputError`` when nothing can be written there."""
    path = Path(path).resolve()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"{path.parent}: cannot be written to ({error.strerror}); expected a writable folder") from None
    return path


def write_atomically(path, write) -> Path:
    """Call ``write(binary file)`` on a temporary file beside ``path`` and rename it: the old file or the whole new one."""
    path = check_folder(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        os.unlink(temporary)
        if isinstance(error, OSError):
            raise InputError(f"{path}: cannot be written ({error.strerror}); expected room for a file") from None
        raise
    return path


def save_demonstrations(path, demonstrations: DemonstrationSet) -> Path:
    """Write a demonstration set (checked first, atomically, compressed, without pickle)."""
    arrays = demonstrations.arrays()
    faults = _check_demonstrations(arrays, demonstrations.domain, Path(path).resolve())
    if faults:
        raise InputError(faults[0])
    metadata = {**demonstrations.metadata, "domain": demonstrations.domain.name, "schema_version": SCHEMA_VERSION}
    return write_atomically(path, lambda f: np.savez_compressed(f, metadata=np.array(json.dumps(metadata)), **arrays))
