"""A stream that survives being killed: states as files, Algorithm 1 with a checkpoint after every user."""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet, check_folder, plain, read_tensors, write_atomically
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.networks import under
from dmsrd_lite.method.dmsrd import DMSRDSettings, learn
from dmsrd_lite.method.state import State

_FORMAT, _VERSION = "dmsrd_lite state", 3


def save_state(path: str | Path, state: State) -> Path:
    """Write a state (safetensors, atomically): arrays and networks, all else as JSON in the header."""
    from safetensors.torch import save

    known = {} if state.demonstrations is None else state.demonstrations.arrays()
    tensors = {f"demonstrations.{k}": torch.from_numpy(v.copy()) for k, v in known.items()}
    tensors |= {f"networks.{k}": v.contiguous() for k, v in state.networks.items()}
    tensors["weights"] = torch.from_numpy(state.weights)
    header = {"format": _FORMAT, "version": _VERSION, "domain": state.domain.name, "seed": state.seed,
              "pure": state.pure, "records": state.records, "alpha": state.alpha, "form": state.form,
              "metadata": state.shown.metadata if known else {}}  # fmt: skip
    binary = save(tensors, metadata={k: json.dumps(plain(v)) for k, v in header.items()})
    return write_atomically(path, lambda file: file.write(binary))


def load_state(path: str | Path, domain: Domain) -> State:
    """Read a state; ``InputError`` when it is cut short, of another version or of another domain."""
    path = Path(path).resolve()
    header, tensors = read_tensors(path, "pt", "a state written by save_state", json.loads)
    if (found := (header.get("format"), header.get("version"))) != (_FORMAT, _VERSION):
        expected = f"expected {_FORMAT!r} of version {_VERSION}"
        raise InputError(f"{path}: is a {found[0]!r} of version {found[1]!r}; {expected}")
    if header["domain"] != domain.name:
        raise InputError(f"{path}: holds a state of {header['domain']}; expected {domain.name}")
    shown = {k: v.numpy() for k, v in under("demonstrations", tensors).items()}
    known = DemonstrationSet(domain, **shown, metadata=header["metadata"]) if shown else None
    pure, records, weights = tuple(header["pure"]), tuple(header["records"]), tensors["weights"].numpy()
    networks = under("networks", tensors)
    alpha, form = header["alpha"], header["form"]
    return State(domain, header["seed"], known, weights, pure, networks, records, alpha, form)


def learn_stream(
    state: State, shown: DemonstrationSet, settings: DMSRDSettings, folder: str | Path, source: str = ""
) -> Iterator[State]:
    """``learn`` with a checkpoint in ``folder`` after every demonstration; goes on from the newest that can
    be read.

    Killed at any moment and called again with the same arguments, it redoes at most the demonstration that
    was in flight and ends with the bits of an uninterrupted run. Two files take turns: one that was spoiled
    costs one demonstration. Yields the newest state of earlier calls first, if there is one. ``InputError``
    when the folder holds another stream, or one of another ``source`` (of the code: ``records.source_hash``).
    """
    folder, states = Path(folder).resolve(), [state]
    check_folder(folder / "any")
    made_with, note = repr((state.domain.name, state.seed, settings, source)), folder / "settings.txt"
    if note.exists() and note.read_text() != made_with:
        text = "holds checkpoints of another seed, other settings or other code; expected another folder"
        raise InputError(f"{folder}: {text}")
    write_atomically(note, lambda file: file.write(made_with.encode()))
    for path in sorted(folder.glob("checkpoint_*.safetensors")):
        try:
            states.append(load_state(path, state.domain))
        except InputError as error:
            warnings.warn(f"{error}; going on from the checkpoint before it", stacklevel=2)
    state = max(states, key=lambda known: len(known.records))
    n = len(state.records)
    known, given = state.shown.arrays() if n else {}, shown.arrays()
    if any(name not in given or not np.array_equal(a, given[name][:n]) for name, a in known.items()):
        text = "holds checkpoints of other demonstrations; expected another folder"
        raise InputError(f"{folder}: {text}")
    if n:
        yield state
    for after in learn(state, shown.select(range(n, shown.n_demonstrations)), settings):
        save_state(folder / f"checkpoint_{len(after.records) % 2}.safetensors", after)
        yield after
