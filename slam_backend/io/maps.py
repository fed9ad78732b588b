"""A finished run for other programs: PLY for point cloud viewers, GeoJSON for maps, and whatever `convert` can make of its files."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pymap3d

from ..core.errors import BadConfig, BadFile
from ..core.measurement import Array, format_stamp
from .formats import FORMATS, convert, endings
from .rundir import FinishedRun

PATH, LANDMARK = (31, 78, 156), (217, 130, 43)  # red green blue
DECIMALS = 9  # of degrees: 0.1 mm


class Origin(NamedTuple):
    """Where the map's origin lies: degrees WGS-84, m above the ellipsoid; yaw: of the map's x axis, degrees from east to north."""

    latitude: float
    longitude: float
    altitude: float = 0.0
    yaw: float = 0.0


def origin_of(text: str) -> Origin:
    """LAT,LON[,ALT[,YAW]]. BadConfig for anything else."""
    try:
        origin = Origin(*(float(word) for word in text.split(",")))
    except (TypeError, ValueError):
        raise BadConfig(f"--origin {text}: write LAT,LON or LAT,LON,ALT or LAT,LON,ALT,YAW") from None
    if not (abs(origin.latitude) <= 90 and abs(origin.longitude) <= 180 and np.isfinite(origin).all()):
        raise BadConfig(f"--origin {text}: latitude is within 90 degrees, longitude within 180")
    return origin


def export(run: FinishedRun, target: Path, origin: Origin | None = None) -> str:
    """Write a run in the format that the extension names; say in one line what was done. BadFile if there is none such."""
    ending = target.suffix.lower()
    if ending == ".ply":
        write_ply(target, run)
    elif ending == ".geojson":
        if origin is None:
            raise BadConfig(
                f"{target}: GeoJSON is in degrees: say where the map's origin lies with --origin LAT,LON"
            )
        write_geojson(target, run, origin)
    elif target.name.lower().endswith(endings("graph")):
        return convert(run.path / "graph.g2o", target)
    elif target.name.lower().endswith(endings("trajectory")):
        return convert(run.path / "trajectory.tum", target)
    else:
        known = ", ".join([*(end for form in FORMATS for end in form.extensions), ".ply", ".geojson"])
        raise BadFile(f"{target}: cannot tell what to write from its name: end it in {known}")
    return (
        f"{run.path} -> {target} ({ending[1:]}): {len(run.trajectory)} poses, {len(run.landmarks)} landmarks"
    )


def write_ply(path: Path, run: FinishedRun) -> None:
    """Keyframes and landmarks as coloured vertices, the path as edges between keyframes; m in the map."""
    keyframes, landmarks = run.trajectory.sevens[:, :3], list(run.landmarks.values())
    head = [
        "ply", "format ascii 1.0", "comment keyframes first, then landmarks; metres",
        f"element vertex {len(keyframes) + len(landmarks)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        f"element edge {len(keyframes) - 1}", "property int vertex1", "property int vertex2", "end_header",
    ]  # fmt: skip
    vertices = [
        _vertex(p, colour) for points, colour in ((keyframes, PATH), (landmarks, LANDMARK)) for p in points
    ]
    edges = [f"{n} {n + 1}" for n in range(len(keyframes) - 1)]
    path.write_text("\n".join([*head, *vertices, *edges, ""]), encoding="ascii")


def _vertex(point: Array, colour: Sequence[int]) -> str:
    return " ".join([*map(repr, point.tolist()), *map(str, colour)])


def write_geojson(path: Path, run: FinishedRun, origin: Origin) -> None:
    """RFC 7946: the path as a LineString with the stamps of its points, each landmark as a Point."""
    line = _degrees(run.trajectory.sevens[:, :3], origin)
    stamps = [format_stamp(stamp) for stamp in run.trajectory.stamps.tolist()]
    features = (
        [_feature("LineString", line, {"name": "trajectory", "stamps": stamps})] if len(line) > 1 else []
    )
    points = np.array(list(run.landmarks.values())).reshape(-1, 3)
    for name, place in zip(run.landmarks, _degrees(points, origin), strict=True):
        features.append(_feature("Point", place, {"name": name}))
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}) + "\n", encoding="utf-8")


def _feature(
    kind: str, coordinates: list[float] | list[list[float]], properties: dict[str, object]
) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _degrees(points: Array, origin: Origin) -> list[list[float]]:
    """(N, 3) m in the map to longitude, latitude (degrees), altitude (m)."""
    c, s = np.cos(np.radians(origin.yaw)), np.sin(np.radians(origin.yaw))
    east, north = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
    latitude, longitude, altitude = pymap3d.enu2geodetic(
        east, north, points[:, 2], origin.latitude, origin.longitude, origin.altitude
    )
    rows = zip(np.atleast_1d(longitude), np.atleast_1d(latitude), np.atleast_1d(altitude), strict=True)
    return [[round(float(x), DECIMALS), round(float(y), DECIMALS), round(float(z), 4)] for x, y, z in rows]
