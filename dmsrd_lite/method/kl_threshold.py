"""The threshold eps of Algorithm 1: below it a mixture explains a demonstration. The paper gives none."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.method.airl import AIRL, clone_demonstrations
from dmsrd_lite.method.divergence import own_divergence, policy_divergences

if TYPE_CHECKING:
    from dmsrd_lite.method.dmsrd import DMSRDSettings


def reference_divergence(
    new: DemonstrationSet, candidate: Callable[[], AIRL], settings: "DMSRDSettings", seed: list[int]
) -> float:
    """How near a good explanation comes to a demonstration, without labels, in nats: eps lies ``kl_margin``
    above it.

    The divergence of the demonstration's trajectories from each other; the domain's own guess for a single
    one. With ``matched_starts``, where these differ as much as strategies do, that of its clone's rollouts
    from the same starts, as many as a mixture is measured with.
    """
    comparison = new.domain.comparison
    if not comparison.matched_starts:
        own = own_divergence(new.domain, new.observations[0])
        return own if np.isfinite(own) else comparison.own_at_most
    clone = candidate().clone or clone_demonstrations(new, [*seed, 101], settings.airl.cloning_steps).actor()
    return float(policy_divergences(clone, new, seed, n_rollouts=settings.mixture.final_rollouts)[0])
