"""Images of one camera at keyframes, and where the camera is believed to have been."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..context import Context
from ..graph import Pose
from ..measurement import Array
from .triangulation import Lens, Sightings


@dataclass(eq=False, slots=True)
class Frame:
    """id: of the offer. key: of the keyframe. mount: base_T_camera, optical axes. ids (N,), pixels (N, 3), sigmas (N,), as a
    lens without distortion sees them.

    covariance: of the camera's pose at its tangent when the frame came, beside the frames before it.
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


Sighting = tuple[Frame, int]  # and the row in it


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

    def sightings(self, tracks: Sequence[Sequence[Sighting]]) -> Sightings:
        """Of each track all of its sightings."""
        flat = [sighting for track in tracks for sighting in track]
        frames = list({id(frame): frame for frame, _ in flat}.values())
        rows = {id(frame): n for n, frame in enumerate(frames)}
        of = np.array([rows[id(frame)] for frame, _ in flat])
        starts = np.cumsum([0, *(len(frame.ids) for frame in frames[:-1])])
        at = starts[of] + np.array([row for _, row in flat])
        return Sightings(
            np.cumsum([0, *(len(track) for track in tracks[:-1])]),
            np.stack([self.of(frame).matrix() for frame in frames])[of],
            np.concatenate([frame.pixels for frame in frames])[at],
            np.concatenate([frame.sigmas for frame in frames])[at],
            np.stack([frame.covariance for frame in frames])[of],
        )
