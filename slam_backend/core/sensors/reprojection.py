"""Pixels as gtsam's own factors: of a pose and a point, and smart ones, of poses alone."""

from collections.abc import Sequence
from functools import cache
from math import isnan
from typing import Any

import gtsam
import numpy as np

from ..config import PixelsSource
from ..graph import Factor
from ..robust.kernels import with_kernel
from .frames import Frame

# A point behind its camera gives a constant error and no gradient instead of an exception; the tracker removes it.
SILENT = (False, False)
RANK = 1e-3  # least singular value of a smart factor's triangulation


class Reprojection:
    """kind of all its factors: pixel. An id is that of the frame and the number of the feature: `<source>/<stamp>/<n>:<feature>`."""

    def __init__(self, config: PixelsSource) -> None:
        self._noise = cache(
            lambda sigma, rows: with_kernel(gtsam.noiseModel.Isotropic.Sigma(rows, sigma), config)
        )
        self._smart = _smart_parameters()

    def of_point(self, number: int, frame: Frame, row: int, key: int) -> Factor:
        """A feature that is seen where the point is."""
        u, v, right, sigma = frame.rows[row]
        optics = frame.optics
        made: Any = (
            gtsam.GenericProjectionFactorCal3_S2(
                np.array((u, v)), self._noise(sigma, 2), frame.key, key, optics.mono, *SILENT, *optics.mount
            )
            if isnan(right)
            else gtsam.GenericStereoFactor3D(
                gtsam.StereoPoint2(u, right, v), self._noise(sigma, 3), frame.key, key, optics.stereo,
                *SILENT, *optics.mount,
            )
        )  # fmt: skip
        return Factor(id_of(number, frame), "pixel", made, (frame.key, key), frame.stamp)

    def smart(self, number: int, sightings: Sequence[tuple[Frame, int]]) -> Factor:
        """One factor for all sightings, frames and rows in them, the point eliminated. gtsam takes one noise for all: their root
        mean square.
        """
        frame = sightings[-1][0]
        sigma = float(np.sqrt(np.mean([each.sigmas[row] ** 2 for each, row in sightings])))
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        made = gtsam.SmartProjectionPoseFactorCal3_S2(noise, frame.optics.mono, frame.mount, self._smart)
        for each, row in sightings:
            made.add(each.pixels[row, :2], each.key)
        keys = tuple(each.key for each, _ in sightings)
        return Factor(f"{id_of(number, frame)}:smart", "pixel", made, keys, frame.stamp)


def id_of(number: int, frame: Frame) -> str:
    """Of the factor that a sighting makes, and of what is decided about it."""
    return f"{frame.id}:{number}"


def _smart_parameters() -> gtsam.SmartProjectionParams:
    """Its point is sought anew at each linearization, so that the result does not depend on who looked before."""
    params = gtsam.SmartProjectionParams(
        gtsam.LinearizationMode.HESSIAN, gtsam.DegeneracyMode.ZERO_ON_DEGENERACY, *SILENT, 0.0
    )
    params.setRankTolerance(RANK)
    return params
