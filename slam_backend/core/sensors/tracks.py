"""Tracks of features through the frames of one camera: when they become factors, which, and when they are given up.

    one sighting            waits
    two and more            a smart factor (the point eliminated; Carlone et al., ICRA 2014), if its distance is known well
                            enough and its sightings agree; made anew with each further sighting
    `point_after`, stereo   a variable, with a factor for each sighting; the smart factor goes

The pose of a new frame is resected from the points that are known before others are placed by it, so that neither a drifting
odometry nor a feature that jumped makes a point. Nothing is believed for good: with each frame the points in view are judged
again by what the solver made of them; one that is behind a camera, or that its sightings do not agree on, is removed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..config import PixelsSource
from ..context import Context
from ..graph import Decision, Delta, Factor, Motion, Pose, total
from ..measurement import Array
from ..robust.chi2 import chi2_limits
from .frames import Film, Frame, Poses
from .reprojection import Reprojection, id_of
from .resection import Known, judged, resected
from .triangulation import Lens, Sightings, covariances, images, triangulated

REFUSED, REMOVED = (
    "pixels",
    "points",
)  # stages of decisions: about what a message says, about what is in the graph
KEPT = 12  # sightings of a point that are looked at again
SPARED = 3  # sightings that a point keeps at least when one of them is found wrong; else all of it goes
NOTHING = Known(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
REASONS = {
    "outlier": "it is not where its point is seen from there",
    "disagrees": "no point is where all sightings of the feature see it",
    "behind": "the point is behind a camera that saw it",
    "second_frame": "its keyframe has a frame of this source",
}
STRIKES = 3  # sightings in a row that do not fit, after which the feature is held to be another one


@dataclass(eq=False, slots=True)
class Track:
    """One feature. name: of its point. sightings: numbers in the film, the newest last. key: of the point, once it is a variable;
    factors: ids of what is in the graph because of it. strikes: sightings in a row that did not fit.
    """

    id: int
    name: str
    sightings: list[int] = field(default_factory=list)
    key: int | None = None
    factors: list[str] = field(default_factory=list)
    strikes: int = 0


class InView(NamedTuple):
    """Tracks of the graph that a frame shows, in its rows (K,): what is known of their points, and where it shows them."""

    tracks: list[Track]
    rows: NDArray[np.intp]
    known: Known


def in_graph(tracks: list[Track], seen: Sightings, context: Context, lens: Lens) -> Array:
    """(T, 3) where the estimate has the points of tracks now. Smart factors have none of their own: it is sought; NaN where there
    is none.
    """
    points = np.zeros((len(tracks), 3))
    smart = np.array([track.key is None for track in tracks])
    if smart.any():
        found = triangulated(seen.only(smart)._replace(covariances=None), lens)
        points[smart] = np.where(np.isinf(found.share)[:, None], np.nan, found.points)
    if not smart.all():
        points[~smart] = [context.point(track.key) for track in tracks if track.key is not None]
    return points


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
        self._film, self._full = Film(), config.forget
        self._generations: dict[int, int] = {}  # id -> how many features have had it
        self.strange: set[str] = set()  # frames that have been said to be no match for the calibration

    def take(self, frame: Frame, context: Context, *, newest: bool) -> Delta:
        """All that a frame at a keyframe brings about. newest: its keyframe is new, and the pose only guessed."""
        if any(other.key == frame.key for other in self._frames):
            refusal = self._refusal(frame.id, frame, "second_frame", count=len(frame.ids))
            return Delta(decisions=(refusal,))
        self._forget(frame, context)
        poses = Poses(context)
        view, removed = self._reviewed(frame, context, poses)
        values = self._placed(frame, view.known, context, poses) if newest else {}
        refused, refusals = self._gated(frame, view, poses)
        self._sighted(frame, refused)
        return total([removed, Delta(values=values, decisions=refusals), self._grown(frame, context, poses)])

    # -- what is forgotten -------------------------------------------------------------------------

    def _forget(self, frame: Frame, context: Context) -> None:
        """Frames whose keyframe was taken back, or lies in another part of the graph, with all tracks that they show; all of them
        when the camera is another one. Then tracks that ended.
        """
        part = context.component(frame.key)

        def stands(other: Frame) -> bool:
            placed = context.place(other.stamp)
            return (
                placed is not None and placed.keyframe.pose == other.key
                and context.component(other.key) == part and other.lens == frame.lens
                and other.mount.equals(frame.mount, 1e-9)
            )  # fmt: skip

        lost = [other for other in self._frames if not stands(other)]
        self._frames = [other for other in self._frames if other not in lost][-self._config.forget :]
        for other in lost:
            shown = range(other.first, other.first + len(other.ids))
            gone = [t for t in self._tracks.values() if any(each in shown for each in t.sightings)]
            for track in gone:
                self._drop(track)
        if len(self._film) >= self._full:
            self._sweep()

    def _sweep(self) -> None:
        """What is asked for again is found to have ended anyway; this is only for the memory."""
        oldest = self._oldest
        self._tracks = {n: track for n, track in self._tracks.items() if track.sightings[-1] >= oldest}
        self._film.cut(min((track.sightings[0] for track in self._tracks.values()), default=oldest))
        self._full = len(self._film) + self._config.forget

    @property
    def _oldest(self) -> int:
        """The first sighting of a track that may go on."""
        return self._frames[0].first if self._frames else self._film.end

    def _going_on(self, numbers: list[int], context: Context) -> Iterator[Track]:
        """The tracks with these ids, but those that ended, and those whose factors somebody took out."""
        oldest = self._oldest
        for number in numbers:
            track = self._tracks.get(number)
            if track is None:
                continue
            key = track.key
            held = (
                all(map(context.kept, track.factors)) if key is None else context.component(key) is not None
            )
            if held and track.sightings[-1] >= oldest:
                yield track
            else:
                self._drop(track)

    def _drop(self, track: Track) -> None:
        """Whatever is seen with its id from now on is another feature."""
        self._tracks.pop(track.id, None)

    # -- what is in the graph ----------------------------------------------------------------------

    def _reviewed(self, frame: Frame, context: Context, poses: Poses) -> tuple[InView, Delta]:
        """The tracks of the graph that are in view or were in the last frame are judged anew; of those that are not given up now,
        the ones in view.
        """
        rows = {number: row for row, number in enumerate(frame.ids.tolist())}
        last, since = (self._frames[-1].ids.tolist(), self._frames[-1].first) if self._frames else ([], 0)
        tracks = [
            track
            for track in self._going_on(list(dict.fromkeys([*last, *rows])), context)
            if track.factors and (track.id in rows or track.sightings[-1] >= since)
        ]
        if not tracks:
            return InView([], np.zeros(0, np.intp), NOTHING), Delta()
        seen = self._film.sightings([track.sightings for track in tracks], poses)
        points = in_graph(tracks, seen, context, frame.lens)
        chi2, freedom, behind = disagreement(points, seen, frame.lens)
        limits = chi2_limits(self._config.probability, freedom)
        bad = behind | (np.add.reduceat(chi2, seen.starts) > limits)
        removed = []
        for n in np.flatnonzero(bad).tolist():
            each = chi2[seen.starts[n] :][: len(tracks[n].sightings)]
            gone, reason = self._given_up(tracks[n], each, bool(behind[n]), context)
            removed.append(self._removal(gone, reason, tracks[n], frame.stamp, float(each.sum()), limits[n]))
        at = np.array([rows.get(t.id, -1) if self._tracks.get(t.id) is t else -1 for t in tracks])
        shown, at = at >= 0, at[at >= 0]
        known = Known(
            points[shown],
            covariances(points[shown], seen.only(shown), frame.lens),
            frame.pixels[at],
            frame.sigmas[at],
        )
        return InView([tracks[n] for n in np.flatnonzero(shown).tolist()], at, known), total(removed)

    def _given_up(self, track: Track, chi2: Array, behind: bool, context: Context) -> tuple[list[str], str]:
        """Factors of a point that contradicts its sightings: of the worst of many, else all of them."""
        gone = track.factors
        if track.key is not None and len(track.sightings) > SPARED and not behind:
            worst = track.sightings.pop(int(np.argmax(chi2)))
            gone = [id_of(track.id, self._film.at(worst)[0])]
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

    def _placed(self, frame: Frame, known: Known, context: Context, poses: Poses) -> dict[int, Pose]:
        """Resect the frame's pose: its keyframe starts there."""
        if not self._frames:
            return {}
        before, to_camera = self._frames[-1], frame.mount.inverse().AdjointMap()
        grown = context.motion(before.stamp, frame.stamp).covariance
        prior = Motion(context.pose(frame.key), grown)
        found = resected(prior, frame.mount, known, frame.lens)
        frame.covariance = to_camera @ found.covariance @ to_camera.T
        if found is prior:  # no better known than the frame before
            frame.covariance = frame.covariance + before.covariance
            return {}
        poses.put(frame, found.pose)
        return {frame.key: found.pose}

    def _gated(self, frame: Frame, view: InView, poses: Poses) -> tuple[set[int], tuple[Decision, ...]]:
        """Sightings that are not where their point must be seen: their rows."""
        if not view.tracks:
            return set(), ()
        known = view.known
        _, _, chi2 = judged(poses.of(frame), known, frame.lens, frame.covariance)
        limits = chi2_limits(self._config.probability, 2 + np.isfinite(known.pixels[:, 2]))
        refusals, wrong = [], np.flatnonzero(chi2 > limits)
        for n in wrong.tolist():
            track = view.tracks[n]
            refusals.append(self._refusal(id_of(track.id, frame), frame, "outlier", chi2[n], limits[n]))
            self._strike(track)
        return set(view.rows[wrong].tolist()), tuple(refusals)

    def _strike(self, track: Track) -> None:
        track.strikes += 1
        if track.strikes >= STRIKES:
            self._drop(track)

    def _sighted(self, frame: Frame, refused: set[int]) -> None:
        """Book the frame's features, those of new tracks too. refused: rows."""
        self._film.add(frame)
        self._frames.append(frame)
        tracks = self._tracks
        for row, number in enumerate(frame.ids.tolist()):
            if row in refused:
                continue
            track = tracks.get(number)
            if track is None:
                track = tracks[number] = Track(number, self._name(number))
            track.sightings.append(frame.first + row)
            if track.key is not None:
                track.strikes = 0
                del track.sightings[:-KEPT]

    def _name(self, number: int) -> str:
        generation = self._generations[number] = self._generations.get(number, 0) + 1
        return f"{self._source}/{number}" + (f"#{generation}" if generation > 1 else "")

    # -- factors -----------------------------------------------------------------------------------

    def _grown(self, frame: Frame, context: Context, poses: Poses) -> Delta:
        """Factors for what the frame has seen."""
        tracks = [
            t for n in frame.ids.tolist() if (t := self._tracks.get(n)) and t.sightings[-1] >= frame.first
        ]
        grown = Delta(tuple(self._followed(t, t.key, frame) for t in tracks if t.key is not None))
        unplaced = [track for track in tracks if track.key is None and len(track.sightings) > 1]
        if not unplaced:
            return grown
        seen = self._film.sightings([track.sightings for track in unplaced], poses)
        found = triangulated(seen, frame.lens)
        limits = chi2_limits(self._config.probability, found.freedom)
        stereo = np.logical_or.reduceat(seen.stereo, seen.starts)
        contradicted, near = found.chi2 > limits, found.share < self._config.share
        refusals = [
            self._disagreed(frame, unplaced[n], found.chi2[n], limits[n])
            for n in np.flatnonzero(contradicted).tolist()
        ]
        made = [
            self._made(unplaced[n], found.points[n], bool(stereo[n]), context)
            for n in np.flatnonzero(near & ~contradicted).tolist()
        ]
        return total([grown, *made, Delta(decisions=tuple(refusals))])

    def _followed(self, track: Track, key: int, frame: Frame) -> Factor:
        factor = self._make.of_point(track.id, frame, track.sightings[-1] - frame.first, key)
        track.factors.append(factor.id)
        return factor

    def _disagreed(self, frame: Frame, track: Track, chi2: float, limit: float) -> Decision:
        """The newest sighting does not count. An older one may be the wrong one: then the next will not fit either."""
        track.sightings.pop()
        self._strike(track)
        return self._refusal(id_of(track.id, frame), frame, "disagrees", chi2, limit)

    def _made(self, track: Track, point: Array, stereo: bool, context: Context) -> Delta:
        """The smart factor anew, or the point as a variable."""
        remove = tuple(track.factors)
        track.strikes = 0
        sightings = [self._film.at(each) for each in track.sightings]
        if len(sightings) < self._config.point_after and not stereo:
            factor = self._make.smart(track.id, sightings)
            track.factors = [factor.id]
            return Delta((factor,), remove)
        while (
            context.component(key := context.landmark(track.name)) is not None
        ):  # of a map that is continued
            track.name = self._name(track.id)
        made = tuple([self._make.of_point(track.id, *each, key) for each in sightings])
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
