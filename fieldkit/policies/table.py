"""The table of policies: a new one is a file and a line here."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import PolicyError, suggestion
from fieldkit.policies import counting, fisher, learned, passive
from fieldkit.policies.scene import Scene
from fieldkit.protocol import LEARNED

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Policy:
    """A utility per candidate, and whether it counts landmarks (then it comes with and without occlusion)."""

    utility: Callable[[Scene], Array]
    counts_landmarks: bool


POLICIES: dict[str, Policy] = {
    "stowed": Policy(passive.stowed, counts_landmarks=False),
    "forward": Policy(passive.forward, counts_landmarks=False),
    "random": Policy(passive.random, counts_landmarks=False),
    "max": Policy(counting.most_visible, counts_landmarks=True),
    "angle": Policy(counting.viewing_angle, counts_landmarks=True),
    "fim": Policy(fisher.fisher_information, counts_landmarks=True),
    **{name: Policy(functools.partial(learned.score_shipped, name), counts_landmarks=True) for name in LEARNED},
}

# Rows of the tables that rank nothing: the prior scored as a pose, and the oracle that scoring computes.
NOT_RANKED = ("odometry", "best_possible")


def available(name: str) -> Policy:
    """Return a policy by name; raises PolicyError when it is unknown, or learned and without shipped weights."""
    if name in LEARNED:
        learned.refuse_unshipped(name)
    if name in POLICIES:
        return POLICIES[name]
    known = [*POLICIES, *NOT_RANKED]
    raise PolicyError(f"unknown policy {name!r}", hint=suggestion(name, known))


def utility(policy: Policy, scene: Scene) -> Array:
    """Return the utility f64[v] of each candidate, -inf where not allowed; asserts that it is never nan."""
    values = np.asarray(policy.utility(scene), dtype=np.float64)
    assert values.shape == (len(scene.candidates.view_ids),), "a policy returns one utility per candidate"
    assert not np.isnan(values).any(), "a policy never returns nan"
    return values
