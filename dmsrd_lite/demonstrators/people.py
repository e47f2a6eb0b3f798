"""The demonstrators themselves: their policies as a file, and as many fresh takes of them as wanted."""

from pathlib import Path

import numpy as np

from dmsrd_lite.demonstrations import (
    DATA_FOLDER,
    DemonstrationSet,
    demonstrations_from,
    read_tensors,
    write_atomically,
)
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import Actor, Policies
from dmsrd_lite.learning.rollouts import rollout
from dmsrd_lite.method.policy_mixture import Mixtures

_FORMAT = "dmsrd_lite demonstrators"


def save_demonstrators(path: str | Path, actor: Actor, made_with: str = "") -> Path:
    """Write policies (safetensors, atomically); ``made_with`` says how they were made."""
    from safetensors.numpy import save

    header = {"format": _FORMAT, "domain": actor.domain.name, "made_with": made_with}
    binary = save({k: np.ascontiguousarray(v) for k, v in actor.arrays().items()}, metadata=header)
    return write_atomically(path, binary)


def load_demonstrators(path: str | Path, domain: Domain, n_people: int = 0) -> tuple[Actor, str]:
    """Read policies, and how they were made.

    ``InputError`` when the file is cut short, of another domain or of fewer than ``n_people``.
    """
    path = Path(path).resolve()
    header, arrays = read_tensors(path, "np", "demonstrators written by save_demonstrators")
    if header.get("format") != _FORMAT:
        raise InputError(f"{path}: is a {header.get('format')!r}; expected {_FORMAT!r}")
    if header["domain"] != domain.name:
        raise InputError(f"{path}: holds demonstrators of {header['domain']}; expected {domain.name}")
    actor = Actor.from_arrays(domain, arrays)
    if actor.n_strategies < n_people:
        expected = f"expected at least {n_people}, one for each demonstration"
        raise InputError(f"{path}: holds {actor.n_strategies} demonstrators; {expected}")
    return actor, header["made_with"]


def load_shipped_demonstrators(domain: Domain, n_people: int = 0) -> Actor:
    """The people who gave the shipped demonstrations, in their order."""
    return load_demonstrators(DATA_FOLDER / f"{domain.name}_demonstrators.safetensors", domain, n_people)[0]


def stream_actor(stream: DemonstrationSet) -> Policies:
    """The users of a generated stream as they act: mixtures of its base users by their true weights."""
    weights = np.array(stream.metadata["weights"])
    weights /= weights.sum(1, keepdims=True)  # they are rounded in the file
    people = load_shipped_demonstrators(stream.domain, weights.shape[1])
    return Mixtures(people.select(range(weights.shape[1])), weights)


def fresh_takes(
    actor: Policies, domain: Domain, n_rollouts: int, seed: Seed, reset_seeds: np.ndarray | None = None
) -> DemonstrationSet:
    """The same people once more: ``n_rollouts`` from new starts, or a second take from given ones (M, k)."""
    return demonstrations_from(rollout(domain, actor, n_rollouts, seed, reset_seeds=reset_seeds), actor)
