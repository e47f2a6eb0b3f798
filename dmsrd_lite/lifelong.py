"""Dynamic multi-strategy reward distillation (DMSRD): demonstrations arrive one by one. Paper: Algorithm 1."""

import json
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from dmsrd_lite.airl import AIRL, AIRLSettings, Rewards
from dmsrd_lite.demonstrations import DemonstrationSet, check_folder, plain, write_atomically
from dmsrd_lite.discrimination import recognized
from dmsrd_lite.divergence import own_divergence
from dmsrd_lite.envs import Domain, InputError
from dmsrd_lite.metrics import policy_divergences
from dmsrd_lite.mixture import MixtureFit, Mixtures, MixtureSettings, search_mixture
from dmsrd_lite.msrd import MSRD, MSRDSettings
from dmsrd_lite.networks import GaussianPolicies, under


@dataclass(frozen=True)
class LifelongSettings:
    kl_threshold: float = 0.0  # eps: accept a mixture at or below this divergence (nats); 0: a reference + kl_margin
    kl_margin: float = 0.5  # nats above the reference (``DMSRD._reference``)
    add_task_reward: bool = True  # AIRL trains alpha g beside the frozen R_Task (the paper: alone)
    between_class: bool = True
    airl: AIRLSettings = AIRLSettings(n_iterations=12)
    msrd: MSRDSettings = MSRDSettings(n_iterations=5, episodes=4, discriminator_steps=24)  # one round after each demonstration
    mixture: MixtureSettings = MixtureSettings()
    policies_after_mixture: bool = True  # policies learn in the round after a mixture, too (the paper), or only rewards
    remembered: int = 0  # how many mixtures among the earlier demonstrations a round works on (``DMSRD._remembered``); 0: all
    measured_rollouts: int = 10  # for the KL before and after a round
    audit_every: int = 0  # measure KL and recognition of all demonstrations after every so many; 0: never

    def __post_init__(self):
        if self.kl_threshold < 0 or not np.isfinite(self.kl_threshold):
            raise InputError(f"kl_threshold {self.kl_threshold!r}: expected a positive number of nats, or 0 to calibrate it")
        if self.airl.coverage != self.msrd.coverage:
            raise InputError("coverage is on in only one of airl and msrd: expected both or neither, because MSRD goes on with AIRL's")


_LANDER = MSRDSettings(n_iterations=5, episodes=4, discriminator_steps=6)  # with 24 the task reward gets worse round by round
SETTINGS = {"inverted_pendulum": LifelongSettings(), "lunar_lander": LifelongSettings(kl_margin=1.0, msrd=_LANDER)}


@dataclass(frozen=True)
class LifelongState:
    """All that is known after some demonstrations; never changed, only replaced.

    demonstrations: all so far, None before the first; weights (n, M); pure (M,): the demonstration that created each
    strategy; networks: tensors by name (``AIRL.networks``), leading axis M but for the task reward; records: one for each demonstration.
    """

    domain: Domain
    seed: int
    demonstrations: DemonstrationSet | None = None
    weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    pure: tuple[int, ...] = ()
    networks: dict[str, torch.Tensor] = field(default_factory=dict)
    records: tuple[dict, ...] = ()

    @property
    def n_strategies(self) -> int:
        return len(self.pure)


def _is_shared(name: str) -> bool:
    return ".task_reward." in name


class DMSRD:
    """Algorithm 1. ``learn`` takes demonstrations in any order, at any time, and yields a record for each of them.

    The record's ``steps`` are those of search, AIRL and MSRD; measuring KL before and after is not counted.

    ``state`` is replaced after every demonstration; an error leaves it as it was.
    """

    def __init__(self, domain: Domain, settings: LifelongSettings, seed: int, n_threads: int = 0, state: LifelongState | None = None):
        self.domain, self.settings, self.n_threads = domain, settings, n_threads
        self.state = state or LifelongState(domain, seed)
        if self.state.domain.name != domain.name:
            raise InputError(f"the state is of {self.state.domain.name}; expected one of {domain.name}")
        if self.state.networks and ("coverage.0" in self.state.networks) != settings.msrd.coverage:
            raise InputError(f"coverage is {settings.msrd.coverage} in the settings, and not so in the state; expected the same in both")

    def policies(self) -> GaussianPolicies:
        """The M strategies' policies."""
        return self._load(GaussianPolicies(self.domain, self.state.n_strategies, [0]), "policies")

    def rewards(self) -> Rewards:
        """The task reward and the M strategy rewards, averaged over the training (``AIRL.averaged_rewards``)."""
        settings = self.settings.msrd
        return self._load(Rewards(self.domain, self.state.n_strategies, settings.discount, [0], settings.alpha), "averaged")

    def mixtures(self) -> Mixtures:
        """What explains each demonstration so far: n mixtures."""
        return Mixtures(self.policies().actor(), self.state.weights)

    def _load(self, module, name: str):
        if not self.state.networks:
            raise InputError("nothing has been learned yet; expected at least one demonstration before this")
        module.load_state_dict(under(name, self.state.networks))
        return module

    def learn(self, demonstrations: DemonstrationSet) -> Iterator[dict]:
        """Take the demonstrations of a set one after the other; the record of each is also kept in ``state.records``."""
        self._check(demonstrations)
        for i in range(demonstrations.n_demonstrations):
            self.state = self._learn(demonstrations.select([i]))
            yield self.state.records[-1]

    def _check(self, new: DemonstrationSet) -> None:
        if new.domain.name != self.domain.name:
            raise InputError(f"a demonstration of {new.domain.name} arrived; expected one of {self.domain.name}")
        known = self.state.demonstrations
        for name in ("observations", "actions") if known is not None else ():
            before, now = (getattr(some, name).shape[1:] for some in (known, new))
            if before != now:
                raise InputError(
                    f"a demonstration with {name} of shape {now} arrived; expected {before} (trajectories, steps, dimension) as before"
                )

    def _learn(self, new: DemonstrationSet) -> LifelongState:
        s, old, started = self.settings, self.state, time.perf_counter()
        n, m = len(old.weights), old.n_strategies
        seed, steps = [old.seed, 102, n], {"search": 0, "airl": 0, "msrd": 0}
        learner = self._new_learner(new, [*seed, 2]) if self.domain.matched_starts else None
        reference = self._reference(new, learner, [*seed, 7])
        threshold = s.kl_threshold or reference + s.kl_margin
        kl_mix = kl_new = float("inf")
        if m:
            fit = search_mixture(self.policies().actor(), new, s.mixture, [*seed, 1], enough=threshold, n_threads=self.n_threads)
            kl_mix, weights, steps["search"] = fit.divergence, fit.weights, fit.steps
        networks, pure, branch = old.networks, old.pure, "mixture"
        if kl_mix > threshold:
            learner = learner or self._new_learner(new, [*seed, 2])
            kl_new = self._train(learner, new, [*seed, 2])
            steps["airl"] = learner.steps
            branch = "mixture, better than a new strategy"
            if not kl_mix < kl_new:
                branch, pure, weights = "new strategy", (*pure, n), np.eye(m + 1)[m]
                networks = self._with_strategy(learner.networks())
        table = np.zeros((n + 1, len(pure)))
        table[:n, :m], table[n] = old.weights, weights
        known = new if old.demonstrations is None else old.demonstrations.joined(new)
        state = replace(old, demonstrations=known, weights=table, pure=pure, networks=networks)
        some = self._remembered(state, [*seed, 6])
        thresholds = np.array([*(r["threshold"] for r in old.records), threshold])[some]
        moving = s.policies_after_mixture or branch == "new strategy"
        before = after = self._divergences(state, some, [*seed, 3]) if moving else np.zeros(0)
        if len(pure) > 1:
            networks, steps["msrd"] = self._round(state, some, moving, [*seed, 4])
            state = replace(state, networks=networks)
            after = self._divergences(state, some, [*seed, 3]) if moving else before
        risen = [k for k in np.flatnonzero(after > thresholds[: len(after)]) if len(pure) > 1 and some[k] not in {*pure, n}]
        searched = {}
        for k in risen:  # its own strategies have moved away
            i = int(some[k])
            fit = self._search_again(state, i, thresholds[k], [*seed, 5, i])
            searched[i], steps["search"] = [after[k], fit.divergence], steps["search"] + fit.steps
            table[i] = fit.weights if fit.divergence < after[k] else table[i]
        record = {
            "demonstration": n,
            "branch": branch,
            "kl_mix": kl_mix,
            "kl_new": kl_new,
            "reference": reference,
            "threshold": threshold,
            "weights": weights,
            "n_strategies": len(pure),
            "steps": steps,
            "remembered": some,
            "kl_before_round": before,
            "kl_after_round": after,
            "searched_again": searched,
            "recognized": self._recognized(state, some),
            "seconds": time.perf_counter() - started,
        }
        if s.audit_every and (n + 1) % s.audit_every == 0:
            everyone = np.arange(n + 1)
            record["audit"] = {"kl": self._divergences(state, everyone, [*seed, 8]), "recognized": self._recognized(state, everyone)}
        return replace(state, records=(*old.records, plain(record)))

    def _search_again(self, state: LifelongState, i: int, threshold: float, seed) -> MixtureFit:
        """The mixture search for demonstration ``i`` of the state, its present weights among the candidates."""
        policies, shown = self._at(state).policies().actor(), state.demonstrations.select([i])
        keywords = {"incumbent": state.weights[i], "enough": threshold, "n_threads": self.n_threads}
        return search_mixture(policies, shown, self.settings.mixture, seed, **keywords)

    def _remembered(self, state: LifelongState, seed) -> np.ndarray:
        """The demonstrations that this round works on: the pure ones, the newest, and a bounded number of the others.

        Of these first the one with the largest weight on each strategy, which its reward confuses most easily with its own.
        """
        everyone, n = np.arange(len(state.weights)), self.settings.remembered
        others = np.setdiff1d(everyone, [*state.pure, everyone[-1]])
        if not 0 < n < len(others):
            return everyone
        nearest = np.unique(others[state.weights[others].argmax(0)])[:n]
        drawn = np.random.default_rng(seed).choice(np.setdiff1d(others, nearest), n - len(nearest), replace=False)
        return np.union1d(np.setdiff1d(everyone, others), [*nearest, *drawn])

    def _recognized(self, state: LifelongState, some: np.ndarray) -> np.ndarray:
        """Does each strategy reward rank its pure demonstration first among ``some``? (M,) bool."""
        means = self._at(state).rewards().evaluate(state.demonstrations.select(some).observations).mean((2, 3))
        return recognized(means, np.searchsorted(some, state.pure))

    def _reference(self, new: DemonstrationSet, learner: AIRL | None, seed) -> float:
        """How near a good explanation comes to a demonstration, without labels, in nats.

        The divergence of the demonstration's trajectories from each other; the domain's own guess for a single one. With
        ``matched_starts``, where these differ as much as strategies do, that of its clone's rollouts from the same starts.
        """
        if learner is None:
            own = own_divergence(self.domain, new.observations[0])
            return own if np.isfinite(own) else self.domain.kl_threshold
        clone = learner.clone or AIRL(new, replace(self.settings.airl, warm_start=True), seed).clone
        return float(policy_divergences(clone, new, seed, n_threads=self.n_threads)[0])

    def _new_learner(self, new: DemonstrationSet, seed) -> AIRL:
        """AIRL on the new demonstration alone, cloned and not yet trained."""
        s = self.settings
        shared = Rewards(self.domain, 1, s.airl.discount, seed, s.msrd.alpha)  # its task reward is zero
        if self.state.networks and s.add_task_reward:
            shared = self.rewards()
        return AIRL(new, s.airl, seed, self.n_threads, shared=shared)

    def _train(self, learner: AIRL, new: DemonstrationSet, seed) -> float:
        """Train it, and the KL of its policy."""
        for _ in learner.train():
            pass
        return float(policy_divergences(learner.policies.actor(), new, [*seed, 9], n_threads=self.n_threads)[0])

    def _with_strategy(self, new: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        old = self.state.networks
        return {k: (old[k] if _is_shared(k) else torch.cat([old[k], v])) if old else v for k, v in new.items()}

    def _round(self, state: LifelongState, some: np.ndarray, moving: bool, seed) -> tuple[dict[str, torch.Tensor], int]:
        """MSRD on the pure demonstrations with BCD on ``some``; returns the networks and the steps of all strategies."""
        s, pure = self.settings, state.pure
        known = state.demonstrations.select(some), state.weights[some], np.searchsorted(some, pure)
        between = known if s.between_class else None
        learner = MSRD(state.demonstrations.select(pure), s.msrd, seed, self.n_threads, networks=state.networks, between=between)
        learner.n_averaged = s.msrd.n_iterations * sum(r["n_strategies"] > 1 for r in state.records)
        learner.learns_policies = moving
        for _ in learner.train():
            pass
        learner.settle()
        return learner.networks(), learner.steps * len(pure)

    def _at(self, state: LifelongState) -> "DMSRD":
        return DMSRD(self.domain, self.settings, state.seed, self.n_threads, state)

    def _divergences(self, state: LifelongState, some: np.ndarray, seed) -> np.ndarray:
        """KL of the demonstrations ``some`` under what explains them, (n,)."""
        mixtures, shown = Mixtures(self._at(state).policies().actor(), state.weights[some]), state.demonstrations.select(some)
        return policy_divergences(mixtures, shown, seed, n_rollouts=self.settings.measured_rollouts, n_threads=self.n_threads)


_FORMAT, _VERSION = "dmsrd_lite lifelong state", 1


def save_state(path, state: LifelongState) -> Path:
    """Write a state (safetensors, atomically, without pickle): arrays and networks, everything else as JSON in the header."""
    from safetensors.torch import save

    known = {} if state.demonstrations is None else state.demonstrations.arrays()
    tensors = {f"demonstrations.{k}": torch.from_numpy(v.copy()) for k, v in known.items()}
    tensors |= {f"networks.{k}": v.contiguous() for k, v in state.networks.items()} | {"weights": torch.from_numpy(state.weights)}
    header = {"format": _FORMAT, "version": _VERSION, "domain": state.domain.name, "seed": state.seed, "pure": state.pure,
              "records": state.records, "metadata": state.demonstrations.metadata if known else {}}  # fmt: skip
    binary = save(tensors, metadata={k: json.dumps(plain(v)) for k, v in header.items()})
    return write_atomically(path, lambda file: file.write(binary))


def load_state(path, domain: Domain) -> LifelongState:
    """Read a state; ``InputError`` when it is cut short, of another version or of another domain."""
    from safetensors import SafetensorError, safe_open

    path = Path(path).resolve()
    try:
        with safe_open(path, framework="pt") as file:
            header = {k: json.loads(v) for k, v in (file.metadata() or {}).items()}
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    except (OSError, ValueError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read ({type(error).__name__}); expected a state written by save_state, whole") from None
    if header.get("format") != _FORMAT or header.get("version") != _VERSION:
        raise InputError(
            f"{path}: is a {header.get('format')!r} of version {header.get('version')!r}; expected {_FORMAT!r} of version {_VERSION}"
        )
    if header["domain"] != domain.name:
        raise InputError(f"{path}: holds a state of {header['domain']}; expected {domain.name}")

    shown = {k: v.numpy() for k, v in under("demonstrations", tensors).items()}
    return LifelongState(
        domain,
        header["seed"],
        DemonstrationSet(domain, **shown, metadata=header["metadata"]) if shown else None,
        tensors["weights"].numpy(),
        tuple(header["pure"]),
        under("networks", tensors),
        tuple(header["records"]),
    )


def learn_stream(learner: DMSRD, shown: DemonstrationSet, folder, source: str = "") -> Iterator[dict]:
    """``learner.learn`` with a checkpoint in ``folder`` after every demonstration; goes on from the newest one that can be read.

    Killed at any moment and called again with the same arguments, it redoes at most the demonstration that was in flight and
    ends with the bits of an uninterrupted run. Two files take turns: one that was spoiled costs one demonstration. Yields the
    records of all demonstrations, those of earlier calls first. ``InputError`` when the folder holds another stream, or one of
    another ``source`` (of the code: ``plans.package_hash``).
    """
    folder, states = Path(folder).resolve(), [learner.state]
    check_folder(folder / "any")
    made_with, note = repr((learner.domain.name, learner.state.seed, learner.settings, source)), folder / "settings.txt"
    if note.exists() and note.read_text() != made_with:
        raise InputError(f"{folder}: holds checkpoints of another seed, other settings or other code; expected the same, or another folder")
    write_atomically(note, lambda file: file.write(made_with.encode()))
    for path in sorted(folder.glob("checkpoint_*.safetensors")):
        try:
            states.append(load_state(path, learner.domain))
        except InputError as error:
            warnings.warn(f"{error}; going on from the checkpoint before it", stacklevel=2)
    learner.state = state = max(states, key=lambda state: len(state.records))
    n = len(state.records)
    known = state.demonstrations.arrays() if n else {}
    if any(not np.array_equal(array, getattr(shown, name)[:n]) for name, array in known.items()):
        raise InputError(f"{folder}: holds checkpoints of other demonstrations; expected the same stream, or another folder")
    yield from state.records
    for record in learner.learn(shown.select(range(n, shown.n_demonstrations))):
        save_state(folder / f"checkpoint_{len(learner.state.records) % 2}.safetensors", learner.state)
        yield record
