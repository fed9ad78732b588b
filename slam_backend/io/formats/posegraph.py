"""A pose graph as arrays: what every graph format is read into and written from.

`states` are the numbers as the files have them (x y theta in 2-D, x y z qx qy qz qw in 3-D, the quaternion of any
length), so that a file survives reading and writing to the bit; `poses` are the same for use, as seven numbers.
Vertices and landmarks are named by their *rank*: the index into the sorted ids.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from ...core.measurement import SECOND, Array, Measurement, frozen
from .lines import Ids, Ranks, Stamps

if TYPE_CHECKING:
    from ...core.sensors.landmark import LandmarkObservation
    from ...core.sensors.relative import RelativePose

SpaceName = Literal["2d", "3d"]
Convention = Literal["gtsam", "g2o"]
PERIOD = SECOND // 10  # ns between vertices that have no stamps


def _none(*shape: int) -> Array:
    return np.zeros(shape)


def _no_ranks() -> Ranks:
    return np.zeros(0, dtype=np.int64)


def _no_ids() -> Ids:
    return np.zeros(0, dtype=np.uint64)


@dataclass(frozen=True, eq=False)
class Links:
    """M measurements of the thing of rank j from the vertex of rank i, in the order of the file.

    states: (M, 3 | 7) poses or (M, 2 | 3) positions. information: (M, d, d) at the tangent of j: x y yaw in 2-D,
    rotation first in 3-D; for positions along the axes of i. covariance: the same noise where the file states a
    covariance, else None. stamps: (M,) ns where the file states them.
    """

    i: Ranks = field(default_factory=_no_ranks)
    j: Ranks = field(default_factory=_no_ranks)
    states: Array = field(default_factory=lambda: _none(0, 3))
    information: Array = field(default_factory=lambda: _none(0, 3, 3))
    covariance: Array | None = None
    stamps: Stamps | None = None

    def __len__(self) -> int:
        return len(self.i)


class Edges(Links):
    """Poses of j in i."""

    @cached_property
    def poses(self) -> Array:
        """(M, 7) `i_T_j`."""
        return sevens_of(self.states)


class Sightings(Links):
    """Positions of landmark j in the frame of vertex i."""


class Priors(Links):
    """Poses (or positions, of landmarks) in the map; i = j is the rank of what is held."""


@dataclass(frozen=True, eq=False)
class Ranges:
    """M distances (m) from vertex i to landmark j, or to vertex j where `to_landmark` is False."""

    i: Ranks = field(default_factory=_no_ranks)
    j: Ranks = field(default_factory=_no_ranks)
    to_landmark: np.ndarray[tuple[int], np.dtype[np.bool_]] = field(
        default_factory=lambda: np.zeros(0, dtype=np.bool_)
    )
    ranges: Array = field(default_factory=lambda: _none(0))
    variances: Array = field(default_factory=lambda: _none(0))
    stamps: Stamps | None = None

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """ids: (N,) sorted. states: (N, 3 | 7), or None where the file states no vertices. stamps: (N,) ns or None.

    landmarks: (L,) sorted ids, a namespace of their own; positions: (L, 2 | 3), NaN where none is stated.
    fixed: ranks of vertices that are held. notes: what the reader has to say about the file.
    """

    space: SpaceName
    ids: Ids
    states: Array | None = None
    edges: Edges = field(default_factory=Edges)
    stamps: Stamps | None = None
    landmarks: Ids = field(default_factory=_no_ids)
    positions: Array = field(default_factory=lambda: _none(0, 3))
    sightings: Sightings = field(default_factory=Sightings)
    ranges: Ranges = field(default_factory=Ranges)
    priors: Priors = field(default_factory=Priors)
    landmark_priors: Priors = field(default_factory=Priors)
    fixed: Ranks = field(default_factory=_no_ranks)
    notes: tuple[str, ...] = ()

    @cached_property
    def poses(self) -> Array | None:
        """(N, 7) `map_T_vertex`, or None where the file states no vertices."""
        return None if self.states is None else sevens_of(self.states)

    @property
    def sees_landmarks(self) -> bool:
        """Whether a sighting or a range leads to one."""
        return len(self.sightings) > 0 or bool(self.ranges.to_landmark.any())

    @property
    def timeless(self) -> list[str]:
        """What is not among its `measurements`, in words: it comes with no vertex, or the first one is held instead of it."""
        counts = {
            "ranges between vertices": len(self.ranges) - int(self.ranges.to_landmark.sum()),
            "priors of vertices": len(self.priors),
            "fixed vertices": int(np.count_nonzero(self.fixed)),  # the first is held anyway
            "priors of landmarks": len(self.landmark_priors),
        }
        return [f"{count} {what}" for what, count in counts.items() if count]

    def stamps_at(self, period: int = PERIOD) -> Stamps:
        """(N,) ns: the rank of each vertex times `period`, counted from one."""
        return (np.arange(len(self.ids), dtype=np.int64) + 1) * period


def sevens_of(states: Array) -> Array:
    """(N, 3) x y theta or (N, 7) to (N, 7) x y z qx qy qz qw of unit length, read-only."""
    if states.shape[1] == 3:
        sevens = np.zeros((len(states), 7))
        sevens[:, :2] = states[:, :2]
        sevens[:, 5], sevens[:, 6] = np.sin(states[:, 2] / 2), np.cos(states[:, 2] / 2)
    else:
        sevens = states.copy()
        sevens[:, 3:] /= np.linalg.norm(states[:, 3:], axis=1, keepdims=True)
    sevens.setflags(write=False)
    return sevens


def states_of(space: SpaceName, sevens: Array) -> Array:
    """(N, 7) to what a graph of that space keeps: (N, 3) x y theta, or the seven as they are."""
    if space == "3d":
        return sevens
    return np.column_stack([sevens[:, :2], 2 * np.arctan2(sevens[:, 5], sevens[:, 6])])


def name_of(identifier: int) -> str:
    """An id for people: `A12` for a 64-bit robot key (letter in the top byte), else the number."""
    letter, number = chr(identifier >> 56), identifier & (2**56 - 1)
    return f"{letter}{number}" if letter.isascii() and letter.isalpha() else str(identifier)


def measurements(
    graph: PoseGraph, source: str = "edges", landmark_source: str = "landmarks", period: int = PERIOD
) -> "Iterator[Measurement]":
    """The graph as if live: vertex r has the stamp (r + 1) * period, everything comes once both its ends exist.

    Within a stamp the edge whose other end is newest comes first (it is the motion), sightings and then ranges of landmarks
    come after the edges, equals in the order of the file. Ranges between vertices and priors are not among them.
    """
    edges, sightings, ranging = graph.edges, graph.sightings, graph.ranges.i[graph.ranges.to_landmark]
    newest = np.concatenate([np.maximum(edges.i, edges.j), sightings.i, ranging])
    other = np.concatenate(
        [np.minimum(edges.i, edges.j), np.full(len(sightings), -1), np.full(len(ranging), -2)]
    )
    records = [
        *_relatives(graph, source, period),
        *_observations(graph, landmark_source, period),
        *_distances(graph, landmark_source, period),
    ]
    for n in np.lexsort((-other, newest)).tolist():
        yield records[n]


def _relatives(graph: PoseGraph, source: str, period: int) -> "list[RelativePose]":
    from ...core.sensors.relative import RelativePose

    edges, stamps, unstated = graph.edges, graph.stamps_at(period), frozen(np.zeros(36))
    first, second = stamps[edges.i], stamps[edges.j]
    poses, information = edges.poses, frozen(edges.information)
    return [
        RelativePose(stamp, source, i, j, "", "", poses[n], unstated, information[n])
        for n, (stamp, i, j) in enumerate(
            zip(np.maximum(first, second).tolist(), first.tolist(), second.tolist(), strict=True)
        )
    ]


def _observations(graph: PoseGraph, source: str, period: int) -> "list[LandmarkObservation]":
    from ...core.sensors.landmark import LandmarkObservation

    sightings = graph.sightings
    size = sightings.states.shape[1]
    values = np.zeros((len(sightings), 3))
    values[:, :size] = sightings.states
    covariances = np.zeros((len(sightings), 3, 3))
    covariances[:, 2, 2] = 1  # z of a planar sighting, which nothing uses
    covariances[:, :size, :size] = _inverse_of(sightings.information)
    values, covariances = frozen(values), frozen(covariances)
    stamps = graph.stamps_at(period)[sightings.i].tolist()
    names = [name_of(identifier) for identifier in graph.landmarks.tolist()]
    return [
        LandmarkObservation(stamp, source, "", names[j], "position", values[n], covariances[n])
        for n, (stamp, j) in enumerate(zip(stamps, sightings.j.tolist(), strict=True))
    ]


def _distances(graph: PoseGraph, source: str, period: int) -> "list[LandmarkObservation]":
    from ...core.sensors.landmark import LandmarkObservation

    ranges, stamps = graph.ranges, graph.stamps_at(period)
    names = [name_of(identifier) for identifier in graph.landmarks.tolist()]
    values, variances = frozen(ranges.ranges[:, None]), frozen(ranges.variances[:, None, None])
    return [
        LandmarkObservation(
            int(stamps[ranges.i[n]]), source, "", names[ranges.j[n]], "range", values[n], variances[n]
        )
        for n in np.flatnonzero(ranges.to_landmark).tolist()
    ]


def _inverse_of(information: Array) -> Array:
    """Covariances; a direction without information gets a sigma 30,000 times that of the best one, a zero matrix NaN."""
    values, vectors = np.linalg.eigh(information)
    best = values.max(axis=-1, keepdims=True, initial=0)
    with np.errstate(all="ignore"):  # 1e-320 has no finite inverse; the firewall says so
        inverse = np.where(best > 0, 1 / np.maximum(values, 1e-9 * best), np.nan)
        return np.asarray((vectors * inverse[:, None, :]) @ np.swapaxes(vectors, -1, -2))
