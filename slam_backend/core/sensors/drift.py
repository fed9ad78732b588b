"""What the drift of the odometry does to sightings from many poses: it moves all of them together, and the more the farther apart."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..graph import Pose
from ..measurement import Array


class Drift(NamedTuple):
    """Along a way. poses: of its keyframes in the map, in order of time; steps: covariance of the motion to each but the first, at
    its tangent. The errors of the steps are independent, so those of the poses are not.
    """

    poses: Sequence[Pose]
    steps: Sequence[Array]

    def covariance(self, at: NDArray[np.intp], places: Array, by_place: Array, by_turn: Array) -> Array:
        """(M, M) of M residuals, as the poses err about the middle one.

        at: (M,) number of the pose; places: (M, d) of the sensor in the map; by_place: (M, d) derivative by its position; by_turn:
        (M, t) by the rotation of the pose in the map (t: 1 in the plane, 3 in space), its position aside.
        """
        later = self.poses[1:]
        if not later:
            return np.zeros((len(at), len(at)))
        turned = np.array([pose.rotation().matrix() for pose in later])  # (K, d, d)
        there = np.array([pose.translation() for pose in later])
        arms = places[:, None] - there[None]  # (M, K, d)
        slide = np.einsum("mi,kij->mkj", by_place, turned)
        if arms.shape[2] == 2:
            swing = arms[..., 0] * by_place[:, None, 1] - arms[..., 1] * by_place[:, None, 0]
            effect = np.concatenate([slide, swing[..., None] + by_turn[:, None]], axis=2)
        else:
            swing = np.cross(arms, by_place[:, None]) + by_turn[:, None]
            effect = np.concatenate([np.einsum("mki,kij->mkj", swing, turned), slide], axis=2)
        effect *= self._reached(at)[:, :, None]
        carried = np.einsum("mka,kab->mkb", effect, np.array(self.steps))
        return np.asarray(np.tensordot(carried, effect, axes=([1, 2], [1, 2])))

    def _reached(self, at: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(M, K) which steps lie between the middle pose and that of a residual."""
        middle, step = len(self.poses) // 2, np.arange(1, len(self.poses))
        after = (middle < step) & (step <= at[:, None])
        before = (at[:, None] < step) & (step <= middle)
        return np.asarray(after | before)
