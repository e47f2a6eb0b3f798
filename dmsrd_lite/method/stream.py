"""A stream that survives being killed: states as files, Algorithm 1 with a checkpoint after every user."""

import hashlib
import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from dmsrd_lite.demonstrations import DemonstrationSet, check_folder, plain, read_tensors, write_atomically
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.learning.networks import under
from dmsrd_lite.method.dmsrd import DMSRDSettings, learn
from dmsrd_lite.method.state import State

_FORMAT, _VERSION = "dmsrd_lite state", 3
_JOURNAL = "records.jsonl"


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
    return write_atomically(path, binary)


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
    state: State,
    shown: DemonstrationSet,
    settings: DMSRDSettings,
    folder: str | Path,
    source: str = "",
    kept: Sequence[int] = (),
) -> Iterator[State]:
    """``learn`` with a checkpoint in ``folder`` after every demonstration; goes on from the newest that can
    be read.

    Killed at any moment and called again with the same arguments, it redoes at most the demonstration that
    was in flight and ends with the bits of an uninterrupted run. Two files take turns: one that was spoiled
    costs one demonstration. A checkpoint holds neither demonstrations (``shown`` has them) nor records (each
    is a line of ``records.jsonl``), so its size grows by M weights a user only. After ``kept`` demonstrations
    a copy stays, for ``kept_states``.

    Yields the newest state of earlier calls first, if there is one. ``InputError`` when the folder holds
    another stream, more of it than ``shown``, or one of another ``source`` (of the code:
    ``records.source_hash``).
    """
    folder, digests = Path(folder).resolve(), _digests(shown)
    journal, note = check_folder(folder / _JOURNAL), folder / "settings.txt"
    made_with = repr((state.domain.name, state.seed, settings, source))
    if note.exists() and note.read_text() != made_with:
        text = "holds checkpoints of another seed, other settings or other code; expected another folder"
        raise InputError(f"{folder}: {text}")
    if state.records and _digests(state.shown) != digests[: len(state.records)]:
        raise InputError("a state that knows other demonstrations; expected those that were shown first")
    write_atomically(note, made_with.encode())
    state = max(
        [state, *_found(folder, "checkpoint_*", shown, digests)], key=lambda known: len(known.records)
    )
    n, total = len(state.records), shown.n_demonstrations
    lines = [json.dumps(pair) + "\n" for pair in zip(digests[:n], state.records, strict=True)]
    write_atomically(journal, "".join(lines).encode())  # without one in flight
    if n:
        yield state
    for after in learn(state, shown.select(range(n, total)), settings):
        n, bare = len(after.records), replace(after, demonstrations=None, records=())
        with journal.open("a") as file:
            file.write(json.dumps([digests[n - 1], after.records[-1]]) + "\n")
        names = [f"kept_{n:06}"] if n in kept else []
        for name in (*names, f"checkpoint_{n % 2}"):  # a resume is from n on
            save_state(folder / f"{name}.safetensors", bare)
        yield after


def kept_states(folder: str | Path, shown: DemonstrationSet) -> Iterator[State]:
    """The states that ``learn_stream`` kept in ``folder``, in order; ``shown``: its demonstrations."""
    yield from _found(Path(folder).resolve(), "kept_*", shown, _digests(shown))


def _found(folder: Path, pattern: str, shown: DemonstrationSet, digests: list[str]) -> Iterator[State]:
    """What the files hold, with its demonstrations and records; a warning for each that cannot be used."""
    known, records = list[str](), list[dict]()
    for line in (folder / _JOURNAL).read_text().splitlines() if (folder / _JOURNAL).exists() else ():
        try:
            digest, record = json.loads(line)
        except ValueError:  # killed while it was written
            break
        known.append(digest)
        records.append(record)
    if known[: len(digests)] != digests[: len(known)]:
        raise InputError(f"{folder}: holds checkpoints of other demonstrations; expected another folder")
    if (n := len(known)) > len(digests):
        text = f"holds checkpoints of {n} demonstrations, more than the {len(digests)} given"
        raise InputError(f"{folder}: {text}; expected at least {n}")
    for path in sorted(folder.glob(f"{pattern}.safetensors")):
        try:
            state = load_state(path, shown.domain)
            if (n := len(state.weights)) > len(records):
                raise InputError(f"{path}: knows {n} demonstrations; expected {n} lines in {_JOURNAL}")
            yield replace(state, demonstrations=shown.select(range(n)), records=tuple(records[:n]))
        except InputError as error:
            warnings.warn(f"{error}; going on from the checkpoint before it", stacklevel=3)


def _digests(shown: DemonstrationSet) -> list[str]:
    """Of each demonstration: what it holds, by name."""
    found = []
    for i in range(shown.n_demonstrations):
        digest = hashlib.sha256()
        for name, array in sorted(shown.arrays().items()):
            digest.update(name.encode() + array[i].tobytes())
        found.append(digest.hexdigest()[:16])
    return found
