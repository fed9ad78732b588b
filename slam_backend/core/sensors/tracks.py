"""Tracks of features through the frames of one camera: when they become factors, which, and when they are given up.

    one sighting            waits
    two and more            a smart factor (the point eliminated; Carlone et al., ICRA 2014), if its distance is known well
                            enough and its sightings agree; made anew with each further sighting
    `point_after`, stereo   a variable, with a factor for each sighting; the smart factor goes

The pose of a new frame is resected from the points that are known before others are placed by it, so that neither a drifting
odometry nor a feature that jumped makes a point. Nothing is believed for good: with each frame the points in view are judged
again by what the solver made of them; one that is behind a camera, or that its sightings do not agree on, is removed.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..config import PixelsSource
from ..context import Context
from ..graph import Decision, Delta, Motion, Pose, total
from ..measurement import Array
from ..robust.chi2 import chi2_limits
from .frames import Frame, Poses, Sighting
from .reprojection import Reprojection, id_of
from .resection import Known, judged, resected
from .triangulation import Lens, Sightings, covariances, images, triangulated

REFUSED, REMOVED = (
    "pixels",
    "points",
)  # stages of decisions: about what a message says, about what is in the graph
KEPT = 12  # sightings of a point that are looked at again
SPARED = 3  # sightings that a point keeps at least when one of them is found wrong; else all of it goes
REASONS = {
    "outlier": "it is not where its point is seen from there",
    "disagrees": "no point is where all sightings of the feature see it",
    "behind": "the point is behind a camera that saw it",
    "second_frame": "its keyframe has a frame of this source",
}
STRIKES = 3  # sightings in a row that do not fit, after which the feature is held to be another one


@dataclass(eq=False, slots=True)
class Track:
    """One feature. name: of its point. sightings: the newest last. key: of the point, once it is a variable; factors: ids of
    what is in the graph because of it. strikes: sightings in a row that did not fit.
    """

    id: int
    name: str
    sightings: list[Sighting] = field(default_factory=list)
    key: int | None = None
    factors: list[str] = field(default_factory=list)
    strikes: int = 0

    @property
    def newest(self) -> Frame:
        return self.sightings[-1][0]


class InGraph(NamedTuple):
    """Tracks that are in the graph, with their points (T, 3) in the map and the covariances (T, 3, 3) of these."""

    tracks: list[Track]
    points: Array
    covariances: Array

    def only(self, rows: list[int]) -> "InGraph":
        return InGraph([self.tracks[n] for n in rows], self.points[rows], self.covariances[rows])

    def seen_in(self, frame: Frame) -> tuple[list[Track], Known]:
        """Those that a frame shows, as it shows them."""
        rows = {number: row for row, number in enumerate(frame.ids.tolist())}
        which = [n for n, track in enumerate(self.tracks) if track.id in rows]
        at = np.array([rows[self.tracks[n].id] for n in which], dtype=np.intp)
        known = Known(self.points[which], self.covariances[which], frame.pixels[at], frame.sigmas[at])
        return [self.tracks[n] for n in which], known


def in_graph(tracks: list[Track], seen: Sightings, context: Context, lens: Lens) -> InGraph:
    """What the estimate makes of tracks now. Smart factors have no point of their own: it is sought; NaN where there is none."""
    points = np.zeros((len(tracks), 3))
    smart = np.array([track.key is None for track in tracks])
    if smart.any():
        found = triangulated(seen.only(smart)._replace(covariances=None), lens)
        points[smart] = np.where(np.isinf(found.share)[:, None], np.nan, found.points)
    for n, track in enumerate(tracks):
        if track.key is not None:
            points[n] = context.point(track.key)
    return InGraph(tracks, points, covariances(points, seen, lens))


def disagreement(points: Array, seen: Sightings, lens: Lens) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(N,) chi-square of each sighting, poses and points taken as exact; (T,) degrees of freedom; (T,) whether a camera that saw
    the point has it behind it.
    """
    expected, local = images(points[seen.tracks], seen.poses, lens)
    with np.errstate(all="ignore"):
        chi2 = np.nansum((seen.pixels - expected) ** 2, axis=1) / seen.sigmas**2
    behind = ~np.logical_and.reduceat(local[:, 2] > 0, seen.starts)
    return chi2, np.add.reduceat(2.0 + seen.stereo, seen.starts) - 3, behind


class Tracker:
    """What is remembered of one source from frame to frame."""

    def __init__(self, source: str, config: PixelsSource) -> None:
        self._source, self._config = source, config
        self._make = Reprojection(config)
        self._tracks: dict[int, Track] = {}
        self._frames: list[Frame] = []
        self._generations: dict[int, int] = {}  # id -> how many features have had it
        self.strange: set[str] = set()  # frames that have been said to be no match for the calibration

    def take(self, frame: Frame, context: Context, *, newest: bool) -> Delta:
        """All that a frame at a keyframe brings about. newest: its keyframe is new, and the pose only guessed."""
        if any(other.key == frame.key for other in self._frames):
            refusal = self._refusal(frame.id, frame, "second_frame", count=len(frame.ids))
            return Delta(decisions=(refusal,))
        self._forget(frame, context)
        poses = Poses(context)
        known, removed = self._reviewed(frame, context, poses)
        values = self._placed(frame, known, context, poses) if newest else {}
        refusals = self._gated(frame, known, poses)
        self._sighted(frame, {refusal.id for refusal in refusals})
        return total([removed, Delta(values=values, decisions=refusals), self._grown(frame, context, poses)])

    # -- what is forgotten -------------------------------------------------------------------------

    def _forget(self, frame: Frame, context: Context) -> None:
        """Tracks that ended; those of frames whose keyframe was taken back, or lies in another part of the graph; those whose
        factors somebody took out. All of them when the camera is another one.
        """
        part = context.component(frame.key)

        def stands(other: Frame) -> bool:
            placed = context.place(other.stamp)
            return (
                placed is not None and placed.keyframe.pose == other.key
                and context.component(other.key) == part and other.lens == frame.lens
                and other.mount.equals(frame.mount, 1e-9)
            )  # fmt: skip

        lost = {id(other) for other in self._frames if not stands(other)}
        self._frames = [other for other in self._frames if id(other) not in lost][-self._config.forget :]
        alive = {id(other) for other in self._frames}
        self._tracks = {
            track.id: track for track in self._tracks.values()
            if id(track.sightings[-1][0]) in alive and not (lost and any(id(each) in lost for each, _ in track.sightings))
            and (track.key is None or context.component(track.key) is not None)
            and (track.key is not None or all(map(context.kept, track.factors)))
        }  # fmt: skip

    def _drop(self, track: Track) -> None:
        """Whatever is seen with its id from now on is another feature."""
        self._tracks.pop(track.id, None)

    # -- what is in the graph ----------------------------------------------------------------------

    def _reviewed(self, frame: Frame, context: Context, poses: Poses) -> tuple[InGraph, Delta]:
        """The tracks of the graph that are in view or were in the last frame, less those that are given up now."""
        last, now = self._frames[-1:], set(frame.ids.tolist())
        near = dict.fromkeys([*(n for each in last for n in each.ids.tolist()), *frame.ids.tolist()])
        tracks = [
            track
            for number in near
            if (track := self._tracks.get(number))
            and track.factors
            and (number in now or track.newest in last)
        ]
        if not tracks:
            return InGraph([], np.zeros((0, 3)), np.zeros((0, 3, 3))), Delta()
        seen = poses.sightings([track.sightings for track in tracks])
        known = in_graph(tracks, seen, context, frame.lens)
        chi2, freedom, behind = disagreement(known.points, seen, frame.lens)
        limits = chi2_limits(self._config.probability, freedom)
        bad = np.flatnonzero(behind | (np.add.reduceat(chi2, seen.starts) > limits)).tolist()
        removed = []
        for n in bad:
            each = chi2[seen.starts[n] :][: len(tracks[n].sightings)]
            gone, reason = self._given_up(tracks[n], each, bool(behind[n]), context)
            removed.append(self._removal(gone, reason, tracks[n], frame.stamp, float(each.sum()), limits[n]))
        good = [n for n, track in enumerate(tracks) if self._tracks.get(track.id) is track]
        return known.only(good), total(removed)

    def _given_up(self, track: Track, chi2: Array, behind: bool, context: Context) -> tuple[list[str], str]:
        """Factors of a point that contradicts its sightings: of the worst of many, else all of them."""
        gone = track.factors
        if track.key is not None and len(track.sightings) > SPARED and not behind:
            worst, _ = track.sightings.pop(int(np.argmax(chi2)))
            gone = [id_of(track.id, worst)]
        else:
            self._drop(track)
        track.factors = [each for each in track.factors if each not in gone]
        return [each for each in gone if context.kept(each)], "behind" if behind else "outlier"

    def _removal(
        self, gone: list[str], reason: str, track: Track, stamp: int, chi2: float, limit: float
    ) -> Delta:
        told = Decision(
            stamp, "", self._source, "removed", REMOVED, reason, REASONS[reason], chi2, float(limit),
            basis={"point": track.name},
        )  # fmt: skip
        return Delta(remove=tuple(gone), decisions=tuple(replace(told, id=each) for each in gone))

    # -- the new frame -----------------------------------------------------------------------------

    def _placed(self, frame: Frame, known: InGraph, context: Context, poses: Poses) -> dict[int, Pose]:
        """Resect the frame's pose: its keyframe starts there."""
        if not self._frames:
            return {}
        before, to_camera = self._frames[-1], frame.mount.inverse().AdjointMap()
        grown = context.motion(before.stamp, frame.stamp).covariance
        prior = Motion(context.pose(frame.key), grown)
        found = resected(prior, frame.mount, known.seen_in(frame)[1], frame.lens)
        frame.covariance = to_camera @ found.covariance @ to_camera.T
        if found is prior:  # no better known than the frame before
            frame.covariance = frame.covariance + before.covariance
            return {}
        poses.put(frame, found.pose)
        return {frame.key: found.pose}

    def _gated(self, frame: Frame, known: InGraph, poses: Poses) -> tuple[Decision, ...]:
        """Sightings that are not where their point must be seen."""
        tracks, seen = known.seen_in(frame)
        if not tracks:
            return ()
        _, _, chi2 = judged(poses.of(frame), seen, frame.lens, frame.covariance)
        limits = chi2_limits(self._config.probability, 2 + np.isfinite(seen.pixels[:, 2]))
        refusals = []
        for n in np.flatnonzero(chi2 > limits).tolist():
            refusals.append(self._refusal(id_of(tracks[n].id, frame), frame, "outlier", chi2[n], limits[n]))
            self._strike(tracks[n])
        return tuple(refusals)

    def _strike(self, track: Track) -> None:
        track.strikes += 1
        if track.strikes >= STRIKES:
            self._drop(track)

    def _sighted(self, frame: Frame, refused: set[str]) -> None:
        """Book the frame's features, those of new tracks too."""
        self._frames.append(frame)
        for row, number in enumerate(frame.ids.tolist()):
            if id_of(number, frame) in refused:
                continue
            track = self._tracks.get(number)
            if track is None:
                track = self._tracks[number] = Track(number, self._name(number))
            track.sightings.append((frame, row))
            if track.key is not None:
                track.strikes = 0
                del track.sightings[:-KEPT]

    def _name(self, number: int) -> str:
        generation = self._generations[number] = self._generations.get(number, 0) + 1
        return f"{self._source}/{number}" + (f"#{generation}" if generation > 1 else "")

    # -- factors -----------------------------------------------------------------------------------

    def _grown(self, frame: Frame, context: Context, poses: Poses) -> Delta:
        """Factors for what the frame has seen."""
        tracks = [t for n in frame.ids.tolist() if (t := self._tracks.get(n)) and t.newest is frame]
        deltas = [self._followed(track, track.key) for track in tracks if track.key is not None]
        unplaced = [track for track in tracks if track.key is None and len(track.sightings) > 1]
        if not unplaced:
            return total(deltas)
        found = triangulated(poses.sightings([track.sightings for track in unplaced]), frame.lens)
        limits = chi2_limits(self._config.probability, found.freedom)
        for n, track in enumerate(unplaced):
            if found.chi2[n] > limits[n]:
                deltas.append(self._disagreed(frame, track, found.chi2[n], limits[n]))
            elif found.share[n] < self._config.share:
                track.strikes = 0
                deltas.append(self._made(track, found.points[n], context))
        return total(deltas)

    def _followed(self, track: Track, key: int) -> Delta:
        factor = self._make.of_point(track.id, track.sightings[-1], key)
        track.factors.append(factor.id)
        return Delta((factor,))

    def _disagreed(self, frame: Frame, track: Track, chi2: float, limit: float) -> Delta:
        """The newest sighting does not count. An older one may be the wrong one: then the next will not fit either."""
        refusal = self._refusal(id_of(track.id, frame), frame, "disagrees", chi2, limit)
        track.sightings.pop()
        self._strike(track)
        return Delta(decisions=(refusal,))

    def _made(self, track: Track, point: Array, context: Context) -> Delta:
        """The smart factor anew, or the point as a variable."""
        remove = tuple(track.factors)
        stereo = any(np.isfinite(frame.pixels[row, 2]) for frame, row in track.sightings)
        if len(track.sightings) < self._config.point_after and not stereo:
            factor = self._make.smart(track.id, track.sightings)
            track.factors = [factor.id]
            return Delta((factor,), remove)
        while (
            context.component(key := context.landmark(track.name)) is not None
        ):  # of a map that is continued
            track.name = self._name(track.id)
        made = tuple(self._make.of_point(track.id, each, key) for each in track.sightings)
        track.key, track.factors = key, [factor.id for factor in made]
        del track.sightings[:-KEPT]
        return Delta(made, remove, {key: point})

    def _refusal(
        self,
        id_: str,
        frame: Frame,
        reason: str,
        statistic: float | None = None,
        threshold: float | None = None,
        count: int = 1,
    ) -> Decision:
        return Decision(
            frame.stamp, id_, self._source, "refused", REFUSED, reason, REASONS[reason],
            None if statistic is None else float(statistic), None if threshold is None else float(threshold),
            count=count,
        )  # fmt: skip
