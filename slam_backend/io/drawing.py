"""A snapshot as clouds and markers, decisions as lines of diagnostics."""

import json
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.books import SECOND_PLACE
from ..core.decisions import as_json
from ..core.graph import Decision
from ..core.measurement import SECOND, Array
from ..core.trajectory import Snapshot
from .encode import Marker, Status, encode_cloud

Color = tuple[float, float, float, float]

ODOMETRY: Color = (0.35, 0.55, 0.85, 1.0)
LANDMARKS: Color = (0.9, 0.8, 0.2, 1.0)
LOOPS: dict[str, tuple[frozenset[str], Color]] = {  # marker -> verdicts that it shows, color
    "loops": (frozenset({"accepted", "restored"}), (0.2, 0.75, 0.3, 1.0)),
    "probation": (frozenset({"probation"}), (1.0, 0.6, 0.1, 1.0)),
    "refused": (frozenset({"refused", "removed"}), (0.9, 0.1, 0.1, 1.0)),
}


LEVELS = {"accepted": 0, "restored": 0, "probation": 1, "refused": 2, "removed": 2}  # OK, WARN, ERROR


def trajectory_cloud(stamp: int, frame: str, snapshot: Snapshot, covariances: ArrayLike | None) -> bytes:
    """PointCloud2, a point per keyframe: stamp_sec (int32) stamp_nsec (uint32) x y z qx qy qz qw and, when given, cov (36).

    float64 throughout: this is the trajectory for programs; RViz, which draws float32 only, has the path.
    """
    seconds, nanoseconds = np.divmod(snapshot.stamps, SECOND)
    columns: dict[str, NDArray[Any]] = {
        "stamp_sec": seconds.astype(np.int32),
        "stamp_nsec": nanoseconds.astype(np.uint32),
    }
    columns |= dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), snapshot.trajectory.sevens.T, strict=True))
    if covariances is not None:
        columns["cov"] = np.asarray(covariances, dtype=np.float64).reshape(len(seconds), 36)
    return encode_cloud(stamp, frame, columns)


def landmark_cloud(stamp: int, frame: str, snapshot: Snapshot, covariances: ArrayLike | None) -> bytes:
    """PointCloud2, a point per landmark: id (uint32) x y z (float64) and, when given, cov (9).

    Where every name is a number that fits, it is the id, of both places of a number that is at two. Otherwise ids count the points of this
    message. Where an id does not say all of a name, the names travel in the field `name`: UTF-8 in uint8, filled up with zeros.
    """
    names = snapshot.names
    columns: dict[str, NDArray[Any]] = {"id": np.arange(len(names), dtype=np.uint32)}
    told = [name.removesuffix(SECOND_PLACE) for name in names]
    if all(_is_number(name) for name in told):
        columns["id"] = np.array([int(name) for name in told], dtype=np.uint32)
    if not all(_is_number(name) for name in names):
        encoded = np.array([name.encode() for name in names])
        columns["name"] = encoded.view(np.uint8).reshape(len(names), encoded.itemsize)
    columns |= dict(zip("xyz", snapshot.landmarks.T, strict=True))
    if covariances is not None:
        columns["cov"] = np.asarray(covariances, dtype=np.float64).reshape(len(names), 9)
    return encode_cloud(stamp, frame, columns)


def _is_number(name: str) -> bool:
    """Whether a uint32 says all that the name says ('007' is not 7)."""
    return name.isascii() and name.isdigit() and str(int(name)) == name and int(name) < 2**32


def drawn_graph(snapshot: Snapshot, decisions: Iterable[Decision], width: float) -> list[Marker]:
    """Always the same five markers: odometry as one strip, loops by verdict, landmarks. width: of the lines, m."""
    markers = [Marker("odometry", "strip", snapshot.trajectory.sevens[:, :3], width, ODOMETRY)]
    last = {decision.id: decision for decision in decisions if decision.ends is not None}
    for name, (verdicts, color) in LOOPS.items():
        ends = [decision.ends for decision in last.values() if decision.verdict in verdicts]
        markers.append(Marker(name, "lines", _lines(snapshot, ends), width, color))
    return [*markers, Marker("landmarks", "spheres", snapshot.landmarks, 5 * width, LANDMARKS)]


def _lines(snapshot: Snapshot, ends: list[tuple[int, int] | None]) -> Array:
    """(2 M, 3): where the robot was at both stamps; edges that leave the trajectory are not drawn."""
    stamps = np.array(ends, dtype=np.int64).ravel()
    pairs = snapshot.at(stamps)[:, :3].reshape(-1, 6)
    return pairs[~np.isnan(pairs).any(axis=1)].reshape(-1, 3)


def newest(snapshot: Snapshot) -> int:
    """Stamp of the newest keyframe; 0 without any."""
    return int(snapshot.stamps[-1]) if len(snapshot.stamps) else 0


def status_of(decision: Decision) -> Status:
    """name: the id; message: `stage/reason: detail`; hardware id: the source; values: a line of decisions.jsonl, nulls left out."""
    rule = f"{decision.stage}/{decision.reason}"
    values = {
        key: value if isinstance(value, str) else json.dumps(value)
        for key, value in as_json(decision).items()
        if value is not None
    }
    message = f"{rule}: {decision.detail}" if decision.detail else rule
    return Status(LEVELS[decision.verdict], decision.id, message, decision.source, values)
