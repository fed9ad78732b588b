"""Robots on a floor in space 3d: priors on the height and the tilt of every keyframe.

Each is a native factor about its own axes only, so that nothing pulls at x, y and yaw: a height is a position whose x and y are known
to LARGEST_SIGMA, a tilt the direction in which the base's z points (gtsam's attitude factor).
"""

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from .config import Floor
from .graph import Factor, Keyframe
from .measurement import format_stamp
from .robust.kernels import LARGEST_SIGMA

UP = np.array((0.0, 0.0, 1.0))


def priors(floor: Floor, keyframes: Sequence[Keyframe]) -> Iterator[Factor]:
    for each in keyframes:
        if floor.z is not None:
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array((LARGEST_SIGMA, LARGEST_SIGMA, floor.z)))
            yield _factor(each, 0, gtsam.PoseTranslationPrior3D(each.pose, np.zeros(3), noise))
        if floor.tilt is not None:
            noise = gtsam.noiseModel.Isotropic.Sigma(2, floor.tilt)
            up = gtsam.Unit3(UP)
            yield _factor(each, 1, gtsam.AttitudeFactorPose3(each.pose, up, noise, up))


def _factor(keyframe: Keyframe, n: int, factor: gtsam.NonlinearFactor) -> Factor:
    name = f"floor/{format_stamp(keyframe.stamp)}/{n}"
    return Factor(name, "floor", factor, (keyframe.pose,), keyframe.stamp)
