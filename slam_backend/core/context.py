"""What a sensor may know of the rest when it makes its factors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .graph import Decision, Estimate, Motion, Offer, Pose
from .keyframes import Placed
from .measurement import Array
from .space import Space


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """Read-only view of the back-end at one keyframe.

    guesses: first guesses of the variables of this change, which the estimate does not know yet.
    place: stamp -> nearest keyframe and the motion to the stamp; None where no odometry covers it.
    motion: (start, end) -> `start_T_end` by the driving source.
    landmark: name -> key. component: key -> number of its connected component (None: not in the graph).
    """

    space: Space
    estimate: Estimate
    guesses: Mapping[int, Any]
    mounts: Mapping[str, Pose]
    place: Callable[[int], Placed | None]
    motion: Callable[[int, int], Motion]
    landmark: Callable[[str], int]
    component: Callable[[int], int | None]

    def pose(self, key: int) -> Pose:
        guess = self.guesses.get(key)
        return self.estimate.pose(key) if guess is None else guess

    def mount(self, frame: str) -> Pose | None:
        """`base_T_frame`; the space's identity for the base itself, None for an unknown frame."""
        return self.mounts.get(frame)


def refuse(offer: Offer, stage: str, reason: str, detail: str) -> Decision:
    """A decision against a measurement that cannot become a factor."""
    m = offer.measurement
    return Decision(m.stamp, offer.id, m.source, "refused", stage, reason, detail, ends=m.ends)


def defaulted(covariance: Array, defaults: Array) -> Array:
    """A covariance whose zero or NaN variances are replaced by the configured ones."""
    missing = ~(np.diag(covariance) > 0)
    if not missing.any():
        return covariance
    filled = np.where(missing[:, None] | missing[None, :], 0.0, covariance)
    filled[missing, missing] = defaults[missing, missing]
    return filled
