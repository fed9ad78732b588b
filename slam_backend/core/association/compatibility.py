"""Which sighting is of which landmark: nearest neighbour, and joint compatibility (JCBB: Neira & Tardos, TRA 17(6), 2001)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..measurement import Array
from ..robust.chi2 import chi2_quantile

MOST_STEPS = 200  # nodes of one search; beyond, the best so far serves
REGULAR = 1e-12  # m^2, on the diagonal of what is inverted

Pairs = dict[int, int]  # sighting -> landmark


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """n sightings against K landmarks, all as points in the frame of one pose, d numbers each.

    errors: (n, K, d) sighting minus predicted landmark. noises: (n, d, d) of the sightings.
    covariance: (K d, K d) joint, of the predicted landmarks: it holds the uncertainty of the pose, which they share.
    """

    errors: Array
    noises: Array
    covariance: Array

    def distances(self) -> Array:
        """(n, K) squared Mahalanobis distances, each pair by itself."""
        _, count, d = self.errors.shape
        own = np.arange(count)[:, None] * d + np.arange(d)
        blocks = self.covariance[own[:, :, None], own[:, None, :]]
        total = blocks[None] + self.noises[:, None] + REGULAR * np.eye(d)
        solved = np.linalg.solve(total, self.errors[..., None])[..., 0]
        return np.asarray((self.errors * solved).sum(axis=-1))

    def joint(self, pairs: Pairs) -> float:
        """Squared Mahalanobis distance of all pairs together."""
        d = self.errors.shape[2]
        at = np.concatenate([np.arange(d) + d * landmark for landmark in pairs.values()])
        total = self.covariance[np.ix_(at, at)] + REGULAR * np.eye(len(at))
        for k, sighting in enumerate(pairs):
            total[k * d : k * d + d, k * d : k * d + d] += self.noises[sighting]
        error = np.concatenate([self.errors[sighting, landmark] for sighting, landmark in pairs.items()])
        return float(error @ np.linalg.solve(total, error))


def nearest(distances: Array, threshold: float) -> Pairs:
    """The closest pairs first, each sighting and each landmark once."""
    pairs: Pairs = {}
    taken: set[int] = set()
    rows, columns = np.nonzero(distances <= threshold)
    order = np.argsort(distances[rows, columns], kind="stable")
    for sighting, landmark in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if sighting not in pairs and landmark not in taken:
            pairs[sighting] = landmark
            taken.add(landmark)
    return dict(sorted(pairs.items()))


def jointly(prediction: Prediction, distances: Array, probability: float) -> Pairs:
    """The largest set of pairs that are compatible together; of equal ones the closest.

    Where the nearest neighbours are compatible together and none is missing, no larger set exists: they serve.
    """
    d = prediction.errors.shape[2]
    fits = distances <= chi2_quantile(probability, d)
    pairs = nearest(distances, chi2_quantile(probability, d))
    if not pairs:
        return {}
    if len(pairs) == int(fits.any(axis=1).sum()) and prediction.joint(pairs) <= chi2_quantile(
        probability, d * len(pairs)
    ):
        return pairs
    return _Search(prediction, distances, fits, probability).best


class _Search:
    """Branch and bound over the sightings, those with fewest candidates first.

    It starts from a set that is found without search: the closest pairs first, each taken if it is compatible with those before.
    """

    def __init__(
        self, prediction: Prediction, distances: Array, fits: NDArray[np.bool_], probability: float
    ) -> None:
        self._prediction, self._probability = prediction, probability
        self._order = [i for i in np.argsort(fits.sum(axis=1), kind="stable").tolist() if fits[i].any()]
        self._choices = [
            [int(j) for j in np.argsort(distances[i], kind="stable") if fits[i, j]] for i in self._order
        ]
        self._steps = 0
        self.best, self._closest = self._in_sequence(distances, fits)
        self._descend(0, {}, 0.0)

    def _in_sequence(self, distances: Array, fits: NDArray[np.bool_]) -> tuple[Pairs, float]:
        pairs: Pairs = {}
        closest = 0.0
        rows, columns = np.nonzero(fits)
        for k in np.argsort(distances[rows, columns], kind="stable").tolist():
            sighting, landmark = int(rows[k]), int(columns[k])
            if sighting in pairs or landmark in pairs.values():
                continue
            joint = self._prediction.joint(grown := {**pairs, sighting: landmark})
            if self._is_compatible(joint, len(grown)):
                pairs, closest = grown, joint
        return dict(sorted(pairs.items())), closest

    def _is_compatible(self, joint: float, pairs: int) -> bool:
        return joint <= chi2_quantile(self._probability, self._prediction.errors.shape[2] * pairs)

    def _descend(self, depth: int, pairs: Pairs, distance: float) -> None:
        self._steps += 1
        left = len(self._order) - depth
        if (len(pairs), -distance) > (len(self.best), -self._closest):
            self.best, self._closest = dict(sorted(pairs.items())), distance
        if not left or len(pairs) + left < len(self.best) or self._steps >= MOST_STEPS:
            return
        for landmark in self._free(self._choices[depth], pairs.values()):
            grown = {**pairs, self._order[depth]: landmark}
            joint = self._prediction.joint(grown)
            if self._is_compatible(joint, len(grown)):
                self._descend(depth + 1, grown, joint)
        if len(pairs) + left - 1 >= len(self.best):
            self._descend(depth + 1, pairs, distance)

    @staticmethod
    def _free(choices: Sequence[int], taken: object) -> list[int]:
        held = set(taken)  # type: ignore[call-overload]  # values of a dict
        return [landmark for landmark in choices if landmark not in held]
