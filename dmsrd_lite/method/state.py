"""What DMSRD knows after some demonstrations, and how to look at it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.domains.domain import Seed
from dmsrd_lite.learning.networks import GaussianPolicies, under
from dmsrd_lite.method.between_class_discrimination import recognized
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.method.policy_mixture import Mixtures
from dmsrd_lite.method.rewards import Rewards

Module = TypeVar("Module", bound=torch.nn.Module)


@dataclass(frozen=True)
class State:
    """All that is known after n demonstrations and M strategies; never changed, only replaced.

    ``State(domain, seed)`` knows nothing yet. ``weights`` (n, M) say of what mixture each demonstration is,
    ``pure[j]`` which demonstration created strategy j, ``records`` why (``dmsrd.learn``); ``policies()``,
    ``rewards()`` and ``mixtures()`` give what was learned.
    """

    domain: Domain
    seed: int
    demonstrations: DemonstrationSet | None = None  # all n so far
    weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # w, (n, M)
    pure: tuple[int, ...] = ()  # m_j: the demonstration that created strategy j
    networks: dict[str, torch.Tensor] = field(default_factory=dict)  # ``AIRL.networks``, by name
    records: tuple[dict, ...] = ()  # one for each demonstration
    alpha: float = 0.0  # weight of the strategy rewards in ``networks``
    form: str = ""  # of Algorithm 1 that made it (``DMSRDSettings.form``)

    @property
    def n_strategies(self) -> int:
        """M."""
        return len(self.pure)

    @property
    def shown(self) -> DemonstrationSet:
        """All demonstrations so far; ``InputError`` before the first."""
        if self.demonstrations is None:
            raise InputError("nothing has been learned yet; expected at least one demonstration before this")
        return self.demonstrations

    def policies(self) -> GaussianPolicies:
        """The M strategies' policies."""
        return self._load(GaussianPolicies(self.domain, self.n_strategies or 1, 0), "policies")

    def rewards(self) -> Rewards:
        """R_Task and the M strategy rewards, averaged over the training (``AIRL.averaged_rewards``)."""
        return self._load(Rewards(self.domain, self.n_strategies or 1, 0.99, 0, self.alpha), "averaged")

    def mixtures(self, some: Sequence[int] | np.ndarray | slice = slice(None)) -> Mixtures:
        """What explains the demonstrations ``some`` (default: all), one mixture each."""
        return Mixtures(self.policies().actor(), self.weights[some])

    def divergences(self, some: Sequence[int] | np.ndarray, seed: Seed, n_rollouts: int) -> np.ndarray:
        """KL of the demonstrations ``some`` under what explains them, (len(some),) nats."""
        return policy_divergences(self.mixtures(some), self.shown.select(some), seed, n_rollouts=n_rollouts)

    def recognized(self, some: Sequence[int] | np.ndarray) -> np.ndarray:
        """Does each strategy reward rank its pure demonstration first among ``some`` (sorted)? (M,) bool."""
        return recognized(
            self.rewards().mean_rewards(self.shown.select(some)), np.searchsorted(some, self.pure)
        )

    def _load(self, module: Module, name: str) -> Module:
        known = under(name, self.networks) if self.shown else {}  # InputError before the first demonstration
        module.load_state_dict(known)
        return module

    def explained(self, new: DemonstrationSet, weights: np.ndarray) -> "State":
        """With one more demonstration and its weights (M,)."""
        known = new if self.demonstrations is None else self.demonstrations.joined(new)
        return replace(self, demonstrations=known, weights=np.vstack([self.weights, weights]))

    def with_strategy(
        self, new: DemonstrationSet, networks: dict[str, torch.Tensor], task_share: float = 0.0
    ) -> "State":
        """With one more demonstration that is a strategy of its own: weights ``e_M+1``, its networks behind
        the others.

        The task reward is shared; it comes with the first strategy, and goes ``task_share`` of the way to the
        newcomer's later (its weights do).
        """
        m, old = self.n_strategies, self.networks
        joined = {
            k: v
            if not old
            else torch.lerp(old[k], v, task_share)
            if ".task_reward." in k
            else torch.cat([old[k], v])
            for k, v in networks.items()
        }
        wider = np.pad(self.weights, ((0, 0), (0, 1)))
        state = replace(self, weights=wider, pure=(*self.pure, len(wider)), networks=joined)
        return state.explained(new, np.eye(m + 1)[m])
