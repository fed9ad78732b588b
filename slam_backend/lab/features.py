"""What a simulated camera sees: features tracked from image to image, some of them wrongly."""

from collections.abc import Iterator

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from ..core.measurement import Array, frozen
from ..core.sensors.pixels import PixelFrame
from ..core.sensors.triangulation import Lens, images
from .options import Options

EYE = "eye"  # the frame of the camera: z ahead, x right, y down
LENS = Lens(400.0, 400.0, 320.0, 240.0)
WIDTH, HEIGHT = 640.0, 480.0  # pixels
NEAREST = 0.5  # m


def frames(
    truth: Array, points: Array, mount: Array, stamps: list[int], options: Options, rng: Generator
) -> Iterator[PixelFrame]:
    """An image at every pose, of (M, 3) points, by a camera that is mounted so (4, 4) on the base. A feature that is lost, or out of
    view, comes back under another id; a wrong sighting is anywhere in the image.
    """
    ids, fresh = np.full(len(points), -1, dtype=np.int64), 0
    for stamp, pose in zip(stamps, truth @ mount, strict=True):
        rows, expected = _in_view(points, pose, options)
        kept = rng.random(len(rows)) >= options.feature_loss
        rows, expected = rows[kept], expected[kept]
        before, ids = ids[rows], np.full_like(ids, -1)
        new = before < 0
        before[new] = fresh + np.arange(new.sum())
        ids[rows], fresh = before, fresh + int(new.sum())
        seen = expected + options.pixel_sigma * rng.standard_normal(expected.shape)
        anywhere = rng.random((len(rows), 2)) * [WIDTH, HEIGHT]
        wrong = rng.random(len(rows)) < options.wrong_feature_rate
        disparity = seen[:, 0] - seen[:, 2]
        seen[wrong, :2] = anywhere[wrong]
        seen[:, 2] = seen[:, 0] - disparity if options.stereo_baseline else np.nan
        if len(rows):
            sigmas = np.full(len(rows), options.pixel_sigma)
            yield PixelFrame(stamp, "features", EYE, before, frozen(seen), frozen(sigmas))


def _in_view(points: Array, pose: Array, options: Options) -> tuple[NDArray[np.intp], Array]:
    """Rows of the points that are in the left image, and in the right one if there is one; (N, 3) u, v, right u of each."""
    near = np.flatnonzero(np.linalg.norm(points - pose[:3, 3], axis=1) < options.feature_range)
    expected, local = images(points[near], np.broadcast_to(pose, (len(near), 4, 4)), lens_of(options))
    seen = expected if options.stereo_baseline else expected[:, :2]
    inside = ((seen >= 0) & (seen < [WIDTH, HEIGHT, WIDTH][: seen.shape[1]])).all(axis=1)
    good = inside & (local[:, 2] > NEAREST)
    return near[good], expected[good]


def lens_of(options: Options) -> Lens:
    return LENS._replace(baseline=options.stereo_baseline)


def around(truth: Array, count: int, rng: Generator) -> Array:
    """(count, 3) features 2 to 12 m beside the path, all along it."""
    at = truth[rng.integers(len(truth), size=count), :3, 3]
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return np.asarray(at + direction * rng.uniform(2.0, 12.0, (count, 1)))
