"""What was shown: demonstrations and test sets for rewards as ``.npz`` files. Nothing is ever unpickled."""

import json
import math
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from dmsrd_lite.domains import DOMAINS, Domain, InputError

if TYPE_CHECKING:  # torch takes seconds to load
    from dmsrd_lite.learning.networks import Policies
    from dmsrd_lite.learning.rollouts import Rollouts

SCHEMA_VERSION = 1
DATA_FOLDER = Path(__file__).resolve().parent.parent / "data"


@dataclass(frozen=True)
class DemonstrationSet:
    """Demonstrations of several users, equally long; an optional field that the file lacks is None.

    observations (n, k, T+1, obs_dim) raw, or (n, k, T, obs_dim) when the last successor is unknown; actions
    (n, k, T, action_dim) executed; rewards (n, k, T); strategy_labels (n,) for evaluation only; reset_seeds
    (n, k); log_likelihoods (n, k) nats, the demonstrator's own.
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
        states, actions, successors = (p.reshape(len(p), -1, p.shape[-1]) for p in parts)
        return states, actions, successors

    def arrays(self) -> dict[str, np.ndarray]:
        """The fields that are there, by name."""
        return {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}

    def faults(self) -> list[str]:
        """One sentence for every fault; an empty list when the set can be used."""
        return _check_demonstrations(self.arrays(), self.domain)

    def select(self, indices: Sequence[int] | np.ndarray) -> "DemonstrationSet":
        """The demonstrations ``indices`` (a list), in that order."""
        chosen: dict[str, Any] = {name: array[list(indices)] for name, array in self.arrays().items()}
        return replace(self, **chosen)

    def joined(self, other: "DemonstrationSet") -> "DemonstrationSet":
        """These demonstrations and then ``other``'s; an optional field stays where both have it."""
        mine, others = self.arrays(), other.arrays()
        both = {name: np.concatenate([mine[name], others[name]]) for name in mine if name in others}
        return DemonstrationSet(self.domain, **both, metadata=self.metadata)

    def pooled(self) -> "DemonstrationSet":
        """All trajectories as one demonstration, as if one user had given them (AIRL Batch)."""
        whole = {
            n: a.reshape(1, -1, *a.shape[2:]) for n, a in self.arrays().items() if n != "strategy_labels"
        }
        return DemonstrationSet(self.domain, **whole, metadata=self.metadata)


_ARRAYS = ("observations", "actions", "rewards", "strategy_labels", "reset_seeds", "log_likelihoods")


AT_ONCE = 100_000  # states of a policy whose density is asked: memory stays bounded


def demonstrations_from(data: "Rollouts", actor: "Policies") -> DemonstrationSet:
    """Rollouts of M policies as M demonstrations, with the policies' own log-likelihood of them."""
    m, k, t = data.rewards.shape
    executed, some = data.executed_actions, max(1, AT_ONCE // (m * t))  # episodes at a time
    own = np.zeros((m, k))
    for i in range(0, k, some):
        states, acted = data.observations[:, i : i + some, :-1], executed[:, i : i + some]
        log_pi = actor.log_density(
            states.reshape(m, -1, states.shape[-1]), acted.reshape(m, -1, acted.shape[-1])
        )
        own[:, i : i + some] = log_pi.reshape(m, -1, t).astype(np.float64).sum(-1)
    return DemonstrationSet(
        data.domain, data.observations, executed, data.rewards, np.arange(m), data.reset_seeds, own
    )


@dataclass(frozen=True)
class RewardTestSet:
    """Trajectories from failure to success with their true returns, to evaluate a reward.

    observations (n, T/stride, obs_dim), every ``stride``-th new state; returns (n,) of the whole trajectory;
    policy (n,), snapshot (n,): who made it and when in training; returns_every_step (n,), never stopped, and
    failed (n, T/stride), 1 where the failure has happened by then: None where the file lacks it.
    """

    domain: Domain
    observations: np.ndarray
    returns: np.ndarray
    policy: np.ndarray
    snapshot: np.ndarray
    metadata: dict
    returns_every_step: np.ndarray | None = None
    failed: np.ndarray | None = None


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """All arrays of a file, and a sentence for each that cannot be read."""
    if not path.is_file():
        return {}, ["there is no such file; expected a demonstration set (.npz)"]
    arrays, faults = {}, []
    try:
        file = np.load(path, allow_pickle=False)
        if isinstance(file, np.ndarray):
            return {}, ["holds a single array; expected an .npz with named arrays"]
        with file:
            for name in file.files:
                try:
                    arrays[name] = file[name]
                except ValueError as error:
                    if "Object arrays" not in str(error):
                        raise
                    faults.append(
                        f"{name}: holds pickled objects (trajectories of unequal length end up so); "
                        "expected one array of numbers, all trajectories equally long"
                    )
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("bytes instead of an array")
    except (ValueError, OSError, EOFError, MemoryError, NotImplementedError, RuntimeError,
            zipfile.BadZipFile, zlib.error):  # fmt: skip
        return {}, ["cannot be read (cut, pickled or no .npz file); expected an .npz file with named arrays"]
    return arrays, faults


def _read_metadata(arrays: dict, known: dict[str, Domain]) -> tuple[dict, list[str]]:
    if "metadata" not in arrays:
        text = "expected a JSON text with domain and schema_version (plain arrays: convert them first)"
        return {}, [f"metadata: is missing; {text}"]
    try:
        metadata = json.loads(str(arrays["metadata"]))
        assert isinstance(metadata, dict)
    except (ValueError, AssertionError):
        return {}, ["metadata: is no JSON object; expected a JSON text with domain and schema_version"]
    faults, name, version = [], metadata.get("domain"), metadata.get("schema_version")
    if name not in list(known):
        faults.append(f"metadata: domain {name!r} is unknown; expected one of {', '.join(known)}")
    if version != SCHEMA_VERSION:
        faults.append(f"metadata: schema_version is {version!r}; expected {SCHEMA_VERSION}")
    return metadata, faults


def _check_array(array: np.ndarray, name: str, shape: tuple) -> list[str]:
    """Faults of one array; ``shape``: numbers (that length), sets (one of these) or words (any from 1)."""
    if array.dtype.kind not in "fiub":
        return [f"{name}: has type {array.dtype}; expected numbers"]
    fits = 0 not in array.shape and array.ndim == len(shape)
    pairs = zip(array.shape, shape, strict=True) if fits else ()
    if not (fits and all(isinstance(s, str) or n in (s if isinstance(s, set) else {s}) for n, s in pairs)):
        wanted = ", ".join(" or ".join(map(str, sorted(s))) if isinstance(s, set) else str(s) for s in shape)
        hint = " and at least one demonstration" if 0 in array.shape else ""
        return [f"{name}: has shape {array.shape}; expected ({wanted}){hint}"]
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        return [f"{name}: holds NaN or infinity, first at index {where}; expected finite numbers"]
    return []


def _check_demonstrations(arrays: dict, domain: Domain) -> list[str]:
    missing = [name for name in ("observations", "actions") if name not in arrays]
    if missing:
        expected = "expected an array (demonstrations, trajectories, steps, dimension)"
        return [f"{name}: is missing; {expected}" for name in missing]
    actions = arrays["actions"]
    faults = _check_array(actions, "actions", ("demonstrations", "trajectories", "steps", domain.action_dim))
    if faults:
        return faults
    n, k, t = actions.shape[:3]
    shapes = {"observations": (n, k, {t, t + 1}, domain.obs_dim), "rewards": (n, k, t)}
    shapes |= {"strategy_labels": (n,), "reset_seeds": (n, k), "log_likelihoods": (n, k)}
    faults += [
        f for name, shape in shapes.items() if name in arrays for f in _check_array(arrays[name], name, shape)
    ]
    if not 10 <= t <= domain.horizon:
        expected = f"expected 10 to {domain.horizon}, the horizon of {domain.name}"
        faults.append(f"actions: trajectories have {t} steps; {expected}")
    low, high = np.array(domain.action_low), np.array(domain.action_high)
    outside = (actions < low - 1e-6) | (actions > high + 1e-6)
    if outside.any():
        where = tuple(int(i) for i in np.argwhere(outside)[0])
        bounds = f"[{low[where[-1]]:g}, {high[where[-1]]:g}]"
        faults.append(
            f"actions: {actions[where]:g} at index {where} is outside the bounds; expected executed actions "
            f"in {bounds}"
        )
    for name in ("reset_seeds", "strategy_labels"):
        if name in arrays and (arrays[name].dtype.kind not in "iu" or arrays[name].min(initial=0) < 0):
            kind = arrays[name].dtype
            faults.append(f"{name}: has type {kind} or negative values; expected whole numbers of at least 0")
    return faults


def _check_test_set(arrays: dict, metadata: dict, domain: Domain) -> list[str]:
    missing = [n for n in ("observations", "policy", "snapshot") if n not in arrays]
    if missing:
        return [f"{name}: is missing; expected an array of a test set" for name in missing]
    faults = _check_array(arrays["returns"], "returns", ("trajectories",))
    if not isinstance(metadata.get("stride"), int):
        faults.append("metadata: stride is missing; expected every how many steps a state was kept")
    if faults:
        return faults
    n = len(arrays["returns"])
    shapes = {
        "observations": (n, "steps", domain.obs_dim),
        "policy": (n,),
        "snapshot": (n,),
        "returns_every_step": (n,),
        "failed": (n, "steps"),
    }
    return [
        f for name, shape in shapes.items() if name in arrays for f in _check_array(arrays[name], name, shape)
    ]


def _inspect(path: Path, domain: Domain | None = None) -> tuple[dict[str, np.ndarray], dict, list[str]]:
    """Arrays, metadata and faults of a file, read once; ``domain`` may be one that is not in ``DOMAINS``."""
    known = {**DOMAINS, **({domain.name: domain} if domain else {})}
    (arrays, faults), metadata = read_arrays(path), dict[str, Any]()
    if arrays or not faults:
        metadata, more = _read_metadata(arrays, known)
        faults += more
    if not faults:
        its = known[metadata["domain"]]
        is_test_set = "returns" in arrays
        faults = _check_test_set(arrays, metadata, its) if is_test_set else _check_demonstrations(arrays, its)
    return arrays, metadata, [f"{path}: {fault}" for fault in faults]


def validate_file(path: str | Path) -> list[str]:
    """One sentence for every fault of a demonstration file or test set; an empty list when it can be used."""
    return _inspect(Path(path).resolve())[2]


def _load_checked(path: str | Path, kind: str, domain: Domain | None) -> tuple[dict, dict, Domain]:
    path = Path(path).resolve()
    arrays, metadata, faults = _inspect(path, domain)
    if faults:
        raise InputError(faults[0] + (f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""))
    found = "test set" if "returns" in arrays else "demonstration set"
    if found != kind:
        raise InputError(f"{path}: is a {found}; expected a {kind}")
    if domain is not None and metadata["domain"] != domain.name:
        raise InputError(f"{path}: metadata: domain is {metadata['domain']}; expected {domain.name}")
    return arrays, metadata, domain or DOMAINS[metadata["domain"]]


def load_demonstrations(path: str | Path, domain: Domain | None = None) -> DemonstrationSet:
    """Read and check a demonstration set; ``InputError`` when it is faulty or of another domain."""
    arrays, metadata, domain = _load_checked(path, "demonstration set", domain)
    types = {"strategy_labels": np.int64, "reset_seeds": np.int64}
    kept = {name: arrays[name].astype(types.get(name, np.float64)) for name in _ARRAYS if name in arrays}
    return DemonstrationSet(domain, **kept, metadata=metadata)


def load_test_set(path: str | Path, domain: Domain | None = None) -> RewardTestSet:
    """Read and check a test set for rewards; ``InputError`` when it cannot be used."""
    arrays, metadata, domain = _load_checked(path, "test set", domain)
    every_step = arrays["returns_every_step"].astype(np.float64) if "returns_every_step" in arrays else None
    states, returns = arrays["observations"].astype(np.float32), arrays["returns"].astype(np.float64)
    who, failed = (arrays["policy"], arrays["snapshot"]), arrays.get("failed")
    return RewardTestSet(domain, states, returns, *who, metadata, every_step, failed)


def load_shipped(domain: Domain, kind: str = "demonstrations") -> DemonstrationSet:
    """Demonstrations that the repository ships: ``demonstrations``, ``second_take`` or ``lifelong``."""
    return load_demonstrations(DATA_FOLDER / f"{domain.name}_{kind}.npz", domain)


def load_shipped_test_set(domain: Domain, kind: str = "test_set") -> RewardTestSet:
    """A test set for rewards that the repository ships: ``test_set``, or ``development_set`` for tuning."""
    return load_test_set(DATA_FOLDER / f"{domain.name}_{kind}.npz", domain)


def plain(value: Any) -> Any:
    """Numbers, strings, lists and dicts only, so that JSON can hold it; NaN becomes None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_folder(path: str | Path) -> Path:
    """``path`` resolved, its folder made if need be; ``InputError`` when nothing can be written there."""
    path = Path(path).resolve()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        text = f"{path.parent}: cannot be written to ({error.strerror}); expected a writable folder"
        raise InputError(text) from None
    return path


def write_atomically(path: str | Path, content: bytes | Callable[[IO[bytes]], object]) -> Path:
    """Bytes, or ``content(binary file)``, in a temporary file, renamed to ``path``: the old file or the whole
    new one."""
    path = check_folder(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            if isinstance(content, bytes):
                file.write(content)
            else:
                content(file)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        os.unlink(temporary)
        if isinstance(error, OSError):
            raise InputError(
                f"{path}: cannot be written ({error.strerror}); expected room for a file"
            ) from None
        raise
    return path


def read_tensors(
    path: Path, framework: str, expected: str, decode: Callable[[str], Any] = str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The header of a safetensors file, decoded, and its tensors; ``InputError`` when it cannot be read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework=framework) as file:
            header = {k: decode(v) for k, v in (file.metadata() or {}).items()}
            return header, {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    except (OSError, ValueError, SafetensorError) as error:
        text = f"cannot be read ({type(error).__name__}); expected {expected}, whole"
        raise InputError(f"{path}: {text}") from None


def save_demonstrations(path: str | Path, demonstrations: DemonstrationSet) -> Path:
    """Write a demonstration set (checked first, atomically, compressed, without pickle)."""
    arrays, domain = demonstrations.arrays(), demonstrations.domain
    if faults := demonstrations.faults():
        raise InputError(f"{Path(path).resolve()}: {faults[0]}")
    metadata = {**demonstrations.metadata, "domain": domain.name, "schema_version": SCHEMA_VERSION}
    content: dict[str, Any] = {**arrays, "metadata": np.array(json.dumps(metadata))}
    return write_atomically(path, lambda file: np.savez_compressed(file, **content))
