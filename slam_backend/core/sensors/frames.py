"""Images of one camera at keyframes, what they show, and where the camera is believed to have been."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..context import Context
from ..graph import Pose
from ..measurement import Array
from .triangulation import Lens, Sightings


class Optics(NamedTuple):
    """What gtsam's factors take of a camera. mount: base_T_camera; empty where that is the identity."""

    mono: gtsam.Cal3_S2
    stereo: gtsam.Cal3_S2Stereo
    mount: tuple[Any, ...]


@dataclass(eq=False, slots=True)
class Frame:
    """id: of the offer. key: of the keyframe. mount: base_T_camera, optical axes. ids (N,), pixels (N, 3), sigmas (N,), as a
    lens without distortion sees them.

    covariance: of the camera's pose at its tangent when the frame came, beside the frames before it.
    first: the number of its first sighting, once it is in a Film. rows: u, v, right u and sigma again, as plain numbers.
    """

    id: str
    stamp: int
    key: int
    mount: Pose
    lens: Lens
    ids: NDArray[np.int64]
    pixels: Array
    sigmas: Array
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    first: int = 0
    rows: list[tuple[float, ...]] = field(init=False)
    optics: Optics = field(init=False)

    def __post_init__(self) -> None:
        self.rows = list(zip(*self.pixels.T.tolist(), self.sigmas.tolist(), strict=True))
        self.optics = Optics(
            *_calibrations(self.lens), () if self.mount.equals(_HERE, 0.0) else (self.mount,)
        )


_HERE = gtsam.Pose3()


@cache
def _calibrations(lens: Lens) -> tuple[gtsam.Cal3_S2, gtsam.Cal3_S2Stereo]:
    five = (lens.fx, lens.fy, 0.0, lens.cx, lens.cy)
    return gtsam.Cal3_S2(*five), gtsam.Cal3_S2Stereo(*five, lens.baseline)


class Film:
    """The frames of a source in order of arrival. All that they show is numbered through, so that a sighting is a whole number.

    end: the number of the next.
    """

    def __init__(self) -> None:
        self._frames: list[Frame] = []
        self._firsts: list[int] = []
        self.end = 0

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, frame: Frame) -> None:
        frame.first = self.end
        self.end += len(frame.ids)
        self._frames.append(frame)
        self._firsts.append(frame.first)

    def cut(self, sighting: int) -> None:
        """Forget the frames before that of a sighting."""
        n = self._index(sighting)
        del self._frames[:n], self._firsts[:n]

    def at(self, sighting: int) -> tuple[Frame, int]:
        """The frame, and the row in it."""
        frame = self._frames[self._index(sighting)]
        return frame, sighting - frame.first

    def _index(self, sighting: int) -> int:
        return bisect_right(self._firsts, sighting) - 1

    def sightings(self, tracks: Sequence[Sequence[int]], poses: "Poses") -> Sightings:
        """Of each track all of its sightings."""
        counts = np.fromiter(map(len, tracks), np.intp, len(tracks))
        numbers = np.fromiter(chain.from_iterable(tracks), np.intp, int(counts.sum()))
        begin = self._index(int(numbers.min()))
        frames, firsts = self._frames[begin:], np.array(self._firsts[begin:])
        of, at = np.searchsorted(firsts, numbers, side="right") - 1, numbers - firsts[0]
        used = np.flatnonzero(np.bincount(of))
        cameras, noises = np.zeros((len(frames), 4, 4)), np.zeros((len(frames), 6, 6))
        for n in used.tolist():
            cameras[n], noises[n] = poses.of(frames[n]).matrix(), frames[n].covariance
        return Sightings(
            np.cumsum(counts) - counts,
            cameras[of],
            np.concatenate([frame.pixels for frame in frames])[at],
            np.concatenate([frame.sigmas for frame in frames])[at],
            noises[of],
        )


class Poses:
    """map_T_camera of frames: as estimated, until something better is put."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._found: dict[int, Pose] = {}

    def put(self, frame: Frame, map_T_base: Pose) -> None:
        self._found[id(frame)] = map_T_base.compose(frame.mount)

    def of(self, frame: Frame) -> Pose:
        if id(frame) not in self._found:
            self.put(frame, self._context.pose(frame.key))
        return self._found[id(frame)]
