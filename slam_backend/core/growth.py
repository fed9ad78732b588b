"""New keyframes: one at a time along the odometry, or, without odometry, along the edges of relative poses."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .context import Context, Unusable
from .graph import Delta, Factor, Keyframe, Offer, Pose, keyframe, total
from .keyframes import Timeline, Track
from .measurement import format_stamp
from .parts import Parts
from .robust.kernels import noise_of
from .sensors import relative
from .sensors.relative import RelativePose
from .space import Space
from .waiting import refusal

GAUGE_SIGMA = 1e-3  # m and rad; of the prior that fixes a part of the graph in space
TILT = 0.5  # rad; of roll and pitch in it where an IMU tells them


def gauge(space: Space, key: int, stamp: int, pose: Pose, tilt: float = GAUGE_SIGMA) -> Factor:
    """Holds a part of the graph where this pose of it is. tilt: rad, of roll and pitch, where gravity tells these (3-D only)."""
    covariance = space.diagonal(GAUGE_SIGMA**2, GAUGE_SIGMA**2)
    if tilt != GAUGE_SIGMA:
        map_R_child = pose.rotation().matrix()
        covariance[:3, :3] = map_R_child.T @ np.diag([tilt**2, tilt**2, GAUGE_SIGMA**2]) @ map_R_child
    noise = noise_of(covariance)
    name = f"gauge/{format_stamp(stamp)}/0"
    return Factor(name, "gauge", space.prior(key, pose, noise), (key,), stamp)


class Growth:
    """Books new keyframes in the timeline, the parts and, where edges are the odometry, the track."""

    def __init__(self, space: Space, timeline: Timeline, track: Track, parts: Parts) -> None:
        self._space, self._timeline, self._track, self._parts = space, timeline, track, parts
        self.begins = 0  # the newest stamp of earlier sessions, whose keyframes are complete

    def start(
        self, stamp: int, origin: Pose | None = None, tilt: float = GAUGE_SIGMA
    ) -> tuple[Keyframe, Delta]:
        """A part of its own: its first pose is the origin, until something absolute says otherwise. origin: as gravity or a course
        turns it. tilt: as in `gauge`.
        """
        first, origin = self._added(stamp), self._space.identity if origin is None else origin
        factor = gauge(self._space, first.pose, stamp, origin, tilt)
        self._parts.begin(first.pose, factor.id)
        return first, Delta((factor,), values={first.pose: origin})

    def follow(self, a: Keyframe, stamp: int) -> Keyframe:
        """The next keyframe after a, in its part."""
        b = self._added(stamp)
        self._parts.put(b.pose, a.pose)
        return b

    def along(
        self, edges: list[Offer], context_of: Callable[[Mapping[int, Any]], Context]
    ) -> tuple[Delta, list[Offer]]:
        """Keyframes along edges, each from an end that is known; a part of its own where neither end is.

        Returns first guesses and gauges, and the edges, those that made keyframes marked.
        """
        grown: list[Delta] = []
        guesses: dict[int, Any] = {}
        marked: list[Offer] = []
        while edges:
            n = next((n for n, (_, m, _) in enumerate(edges) if any(map(self._present, m.ends or ()))), None)
            offer = edges.pop(n or 0)
            m = offer.measurement
            assert isinstance(m, RelativePose)
            context = context_of(guesses)
            try:
                step = self._step(m, context)
            except Unusable as why:
                grown.append(Delta(decisions=(refusal(offer, "relative", why.reason, why.detail),)))
                continue
            new = [stamp for stamp in m.ends if self._timeline.at(stamp) is None]
            if n is None and new:
                grown.append(self._root(new[0]))
                guesses.update(grown[-1].values)
            i, j = self._present(m.stamp_i), self._present(m.stamp_j)
            left = [stamp for stamp in new if self._timeline.at(stamp) is None]
            if i is not None and m.stamp_j in left:
                guesses.update(self._branch(i, m.stamp_j, step, context))
            elif j is not None and m.stamp_i in left:
                guesses.update(self._branch(j, m.stamp_i, step.inverse(), context))
            marked.append(offer._replace(motion=bool(left)))
        return total(grown) + Delta(values=guesses), marked

    def _present(self, stamp: int) -> Keyframe | None:
        """The keyframe with that stamp, if it is one of this session."""
        return self._timeline.at(stamp) if self._track.covers(stamp) else None

    def _step(self, m: RelativePose, context: Context) -> Pose:
        for stamp in m.ends:
            if stamp <= self.begins and self._timeline.at(stamp) is None:
                raise Unusable(
                    "overlap", "one of its ends lies in the map that is continued, and is no keyframe of it"
                )
        return relative.step(m, context)

    def _root(self, stamp: int) -> Delta:
        _, delta = self.start(stamp)
        self._tracked(stamp, self._space.identity, stamp)
        return delta

    def _branch(self, known: Keyframe, stamp: int, step: Pose, context: Context) -> dict[int, Any]:
        new = self.follow(known, stamp)
        self._tracked(stamp, self._track.pose(known.stamp).compose(step), known.stamp)
        return {new.pose: context.pose(known.pose).compose(step)}

    def _added(self, stamp: int) -> Keyframe:
        new = keyframe(len(self._timeline), stamp)
        self._timeline.add(new)
        return new

    def _tracked(self, stamp: int, pose: Pose, beside: int) -> None:
        self._track.add(stamp, pose)
        self._track.split(stamp, beside)
        self._track.protect()
