"""The firewall: what a message tells alone (`checked`), and what needs its neighbours (`rechecked`).

Both are generators over a stream of measurements and decisions; what they refuse becomes a Decision. Only what the
configuration uses is judged: the axes of the space, and covariances that are read. `firewall.rules` has the table of
rules; between the two stages `settle` judges the clock.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from math import inf
from typing import Any

from .config import Config
from .firewall.continuity import Continuity, Pace
from .firewall.covariances import (
    CAPPED,
    NOTHING,
    Notes,
    capped,
    judge_covariance,
    judge_information,
    judge_noise,
)
from .firewall.repeats import Repeats
from .firewall.rules import Fault, decided
from .firewall.values import judge_fix, judge_pose, judge_sample, judge_sighting, judge_stamps
from .graph import Decision
from .measurement import SECOND, ImuSample, Measurement, StaticTransform
from .sensors.gnss import Fix
from .sensors.landmark import LandmarkObservation
from .sensors.odometry import OdometryPose
from .sensors.pixels import PixelFrame
from .sensors.pose import AbsolutePose
from .sensors.relative import RelativePose
from .space import SPACES, Space

Stream = Iterable[Measurement | Decision]


def checked(items: Stream, config: Config) -> Iterator[Measurement | Decision]:
    """Refuse what cannot be right by itself."""
    space = SPACES[config.space]
    noted: set[tuple[str, str]] = set()
    for item in items:
        judge = JUDGES.get(type(item))
        if judge is None or isinstance(item, Decision):
            yield item
            continue
        source = config.sources.get(item.source)
        try:
            notes = judge(item, space, source)
        except Fault as fault:
            yield decided(item, "refused", f"check/{fault.reason}", fault.statistic, fault.threshold)
            continue
        if not notes:
            yield item
            continue
        for note in notes:
            if (item.source, note) not in noted:  # of the source, not of a loop
                noted.add((item.source, note))
                yield replace(decided(item, "accepted", f"check/{note}"), ends=None)
        yield _capped(item, source) if CAPPED in notes else item


def rechecked(items: Stream, config: Config) -> Iterator[Measurement | Decision]:
    """After settling: refuse duplicate and teleporting odometry, what is told in another frame, and loops told twice."""
    tracks: dict[str, Continuity] = {}
    repeats = Repeats()
    sampled: dict[str, int] = {}  # IMU -> stamp of its newest sample
    for item in items:
        if isinstance(item, OdometryPose):
            track = tracks.get(item.source)
            if track is None:
                pace = pace_of(item.source, config)
                track = tracks[item.source] = Continuity(pace, SPACES[config.space])
            yield from track.judge(item)
        elif isinstance(item, ImuSample):
            before = sampled.get(item.source, 0)
            if item.stamp > before:
                sampled[item.source] = item.stamp
                yield item
            else:
                rule = "recheck/duplicate" if item.stamp == before else "recheck/integrated"
                yield decided(item, "refused", rule, (before - item.stamp) / SECOND)
        elif isinstance(item, RelativePose) and repeats.told(item):
            yield decided(item, "refused", "recheck/duplicate")
        elif isinstance(item, AbsolutePose) and item.parent.strip("/") not in ("", config.map_frame):
            yield decided(item, "refused", "recheck/other_frame")
        else:
            yield item
    for track in tracks.values():
        yield from track.drop_doubt()


def pace_of(name: str, config: Config) -> Pace:
    """What bounds the motion between two messages of a source; nothing, unless it is odometry."""
    source = config.sources.get(name)
    return Pace(getattr(source, "max_speed", inf), SPACES[config.space])


def _odometry(item: OdometryPose, space: Space, source: Any) -> Notes:
    judge_stamps(item.stamp)
    judge_pose(item.pose, space)
    if source.noise == "model":
        return NOTHING
    return judge_covariance(getattr(item, _NOISE[source.noise]), space.used)


def _relative(item: RelativePose, space: Space, source: Any) -> Notes:  # noqa: ARG001  # one signature for the table
    judge_stamps(item.stamp, item.stamp_i, item.stamp_j)
    judge_pose(item.pose, space)
    if item.information is not None:
        return judge_information(item.information)
    return judge_covariance(item.covariance, space.used)


def _static(item: StaticTransform, space: Space, source: Any) -> Notes:  # noqa: ARG001
    judge_pose(item.pose, space)  # its stamp says nothing, and is often zero
    return NOTHING


def _absolute(item: AbsolutePose, space: Space, source: Any) -> Notes:  # noqa: ARG001
    judge_stamps(item.stamp)
    judge_pose(item.pose, space)
    return judge_covariance(item.covariance, space.used)


def _landmark(item: LandmarkObservation, space: Space, source: Any) -> Notes:  # noqa: ARG001
    judge_stamps(item.stamp)
    return judge_noise(item.covariance, judge_sighting(item, space))


def _fix(item: Fix, space: Space, source: Any) -> Notes:  # noqa: ARG001
    judge_stamps(item.stamp)
    return judge_noise(item.covariance, judge_fix(item, space))


def _pixels(item: PixelFrame, space: Space, source: Any) -> Notes:  # noqa: ARG001  # single pixels are judged by their sensor
    judge_stamps(item.stamp)
    return NOTHING


def _capped(item: Any, source: Any) -> Any:
    """With the covariance that is read cut to size."""
    name = _NOISE[source.noise] if isinstance(item, OdometryPose) else "covariance"
    return replace(item, **{name: capped(getattr(item, name))})


_NOISE = {"twist": "twist_covariance", "pose": "covariance"}  # `noise` of an odometry source -> field


def _imu(item: ImuSample, space: Space, source: Any) -> Notes:  # noqa: ARG001
    judge_stamps(item.stamp)
    judge_sample(item)
    return NOTHING


JUDGES: Mapping[type, Callable[[Any, Space, Any], Notes]] = {
    OdometryPose: _odometry,
    RelativePose: _relative,
    AbsolutePose: _absolute,
    LandmarkObservation: _landmark,
    Fix: _fix,
    StaticTransform: _static,
    ImuSample: _imu,
    PixelFrame: _pixels,
}
