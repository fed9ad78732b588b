"""A run on the earth: how it lies there, how far it is from every fix, and whether the fixes' noise is what they say.

fixes.csv, one line per fix in order of arrival:
    stamp, source, use                 `used`, or `withheld` by the configuration
    latitude, longitude, altitude      degrees WGS-84, m
    sigma_horizontal, sigma_vertical   m, as the estimate took them
    east, north, up                    m from the origin that summary.json names
    away_east, away_north, away_up     m from the fix to where its antenna is believed to have been; empty where that is unknown
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import BadFile
from ..core.fixes import Compared
from ..core.measurement import Array, format_stamp, parse_stamp

if TYPE_CHECKING:
    from .result import Result

NAME = "fixes.csv"
HEADER = (
    "stamp", "source", "use", "latitude", "longitude", "altitude", "sigma_horizontal", "sigma_vertical",
    "east", "north", "up", "away_east", "away_north", "away_up",
)  # fmt: skip
SURE = 3.29  # standard deviations: 99.9 %


def on_earth(result: "Result") -> dict[str, Any] | None:
    """For summary.json; None for a run without a source of fixes. Angles in rad, lengths in m."""
    backend, earth = result.run.backend, result.snapshot.earth
    if earth is None:
        return None
    told = {**earth.as_json(), "fixes": {"told": 0, "withheld": 0}, "nis": nis(result)}
    if (found := backend.compared(result.snapshot)) is None:
        return told
    told["fixes"] = {"told": len(found.stamps), "withheld": int(found.withheld.sum())}
    if earth.pose is not None:
        told["away"] = {
            name: _rms(found, chosen, backend.space.name)
            for name, chosen in (("used", ~found.withheld), ("withheld", found.withheld))
            if chosen.any()
        }
    return told


def nis(result: "Result") -> dict[str, Any]:
    """By source: mean chi-square of the innovations, at most one a second, and where 99.9 % of such means lie if the noise is as stated."""
    axes = result.run.backend.space.point_dimension
    by_source: dict[str, list[float]] = {}
    for each in result.decisions:
        if each.stage == "doubt" and each.statistic is not None:
            by_source.setdefault(each.source, []).append(each.statistic)
    found = {}
    for source, values in by_source.items():
        spread = SURE * (2 * axes / len(values)) ** 0.5
        mean = float(np.mean(values))
        found[source] = {
            "mean": mean, "expected": axes, "low": max(axes - spread, 0.0), "high": axes + spread,
            "count": len(values), "noise_is": (mean / axes) ** 0.5,
        }  # fmt: skip
    return found


def write_fixes(path: Path, found: Compared) -> None:
    away = found.antennas - found.fixes
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(HEADER)
        numbers = np.hstack([found.places, found.sigmas, found.fixes, away])
        heads = zip(found.stamps.tolist(), found.sources, found.withheld.tolist(), strict=True)
        for (stamp, source, withheld), row in zip(heads, numbers.tolist(), strict=True):
            cells = ("" if each != each else repr(each) for each in row)  # noqa: PLR0124  # NaN is not itself
            out.writerow([format_stamp(stamp), source, "withheld" if withheld else "used", *cells])


def read_fixes(path: Path) -> Compared:
    """BadFile for what `write_fixes` did not write."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            head, *rows = list(csv.reader(file))
        numbers = np.array([[float(cell or "nan") for cell in row[3:]] for row in rows]).reshape(-1, 11)
        fixes = numbers[:, 5:8]
        if tuple(head) != HEADER:
            raise BadFile(f"{path}: is damaged: its columns are others; replay again")
        return Compared(
            np.array([parse_stamp(row[0]) for row in rows], dtype=np.int64), tuple(row[1] for row in rows),
            numbers[:, :3], numbers[:, 3:5], np.array([row[2] == "withheld" for row in rows], dtype=np.bool_),
            fixes, fixes + numbers[:, 8:],
        )  # fmt: skip
    except FileNotFoundError:
        raise BadFile(f"{path}: there is none: the run had no source of kind gnss") from None
    except (OSError, ValueError, IndexError) as error:
        raise BadFile(f"{path}: is damaged: {error}; replay again") from None


def _rms(found: Compared, chosen: Any, space: str) -> Mapping[str, float | None]:
    """Horizontal and vertical root mean squares over the fixes that can be compared; no height in the plane."""
    away = (found.antennas - found.fixes)[chosen]
    away = away[np.isfinite(away).all(axis=1)]
    if not len(away):
        return {"horizontal": None, "vertical": None}
    squares: Array = np.mean(away**2, axis=0)
    vertical = float(np.sqrt(squares[2])) if space == "3d" else None
    return {"horizontal": float(np.sqrt(squares[0] + squares[1])), "vertical": vertical}
