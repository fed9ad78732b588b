"""A finished run for other programs: PLY for point cloud viewers, GeoJSON and KML for maps, and whatever `convert` can make of its files."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np

from ..core.errors import BadConfig, BadFile
from ..core.geometry import seven_of_matrix
from ..core.georeference import Georeference
from ..core.measurement import Array, format_stamp
from ..core.sensors.gnss import geodetic
from .finished import FinishedRun
from .formats import FORMATS, convert, endings

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
    elif ending in WRITERS:
        earth = run.earth if origin is None else _given(origin)
        if earth is None or earth.pose is None:
            raise BadConfig(
                f"{target}: is in degrees, and the run does not know where it lies on the earth: say so with --origin LAT,LON"
            )
        WRITERS[ending](target, run, earth)
    elif target.name.lower().endswith(endings("graph")):
        return convert(run.path / "graph.g2o", target)
    elif target.name.lower().endswith(endings("trajectory")):
        return convert(run.path / "trajectory.tum", target)
    else:
        known = ", ".join([*(end for form in FORMATS for end in form.extensions), ".ply", *WRITERS])
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


def _given(origin: Origin) -> Georeference:
    c, s = np.cos(np.radians(origin.yaw)), np.sin(np.radians(origin.yaw))
    turned = np.eye(4)
    turned[:2, :2] = [[c, s], [-s, c]]
    return Georeference(origin[:3], seven_of_matrix(turned))


def write_geojson(path: Path, run: FinishedRun, earth: Georeference) -> None:
    """RFC 7946: the path as a LineString with the stamps of its points, each landmark as a Point."""
    line = _degrees(run.trajectory.sevens[:, :3], earth)
    stamps = [format_stamp(stamp) for stamp in run.trajectory.stamps.tolist()]
    features = (
        [_feature("LineString", line, {"name": "trajectory", "stamps": stamps})] if len(line) > 1 else []
    )
    points = np.array(list(run.landmarks.values())).reshape(-1, 3)
    for name, place in zip(run.landmarks, _degrees(points, earth), strict=True):
        features.append(_feature("Point", place, {"name": name}))
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}) + "\n", encoding="utf-8")


def _feature(
    kind: str, coordinates: list[float] | list[list[float]], properties: dict[str, object]
) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def write_kml(path: Path, run: FinishedRun, earth: Georeference) -> None:
    """OGC KML 2.3: the path as a LineString, each landmark as a Point; altitudes only of a run in 3-D, else on the ground."""
    mode = "absolute" if run.config.space == "3d" else "clampToGround"

    def placemark(name: str, kind: str, places: list[list[float]]) -> str:
        words = " ".join(f"{x!r},{y!r},{z!r}" for x, y, z in places)
        shape = f"<{kind}><altitudeMode>{mode}</altitudeMode><coordinates>{words}</coordinates></{kind}>"
        return f"<Placemark><name>{escape(name)}</name>{shape}</Placemark>"

    marks = [placemark("trajectory", "LineString", _degrees(run.trajectory.sevens[:, :3], earth))]
    points = np.array(list(run.landmarks.values())).reshape(-1, 3)
    marks += [
        placemark(name, "Point", [place])
        for name, place in zip(run.landmarks, _degrees(points, earth), strict=True)
    ]
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    path.write_text("\n".join([head, *marks, "</Document></kml>", ""]), encoding="utf-8")


WRITERS: Mapping[str, Callable[[Path, FinishedRun, Georeference], None]] = {
    ".geojson": write_geojson,
    ".kml": write_kml,
}


def _degrees(points: Array, earth: Georeference) -> list[list[float]]:
    """(N, 3) m in the map to longitude, latitude (degrees), altitude (m)."""
    assert earth.origin is not None
    rows = geodetic(earth.on_earth(points), earth.origin)[:, [1, 0, 2]].tolist()
    return [[round(x, DECIMALS), round(y, DECIMALS), round(z, 4)] for x, y, z in rows]
