"""The path: odometry alone, as believed while driving, and smoothed; landmarks, and loops by verdict."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from ...core.measurement import Array
from ...core.trajectory import Trajectory
from ..colours import LANDMARK, ODOMETRY, ONLINE, OTHERS, SMOOTHED, TRUTH, VERDICTS
from .page import Figure, Section, dots, drawer, drawn, figure, line, numbers, script_data
from .subject import Subject
from .verdicts import loops_of, sentence

LAID_FLAT = 0.02  # share of the largest extent below which height is not worth a third axis
MOST = 20_000  # points of a line: more cannot be seen
CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 24)), np.sin(np.linspace(0, 2 * np.pi, 24))])
ELLIPSES = 2_000  # landmarks, at most, that get one
CLICK = """
const place = document.getElementById("path");
ready.path.then(() => place.on("plotly_click", event => {
  const point = event.points.find(each => each.customdata !== undefined);
  if (point) document.getElementById("loop-told").innerHTML = text(told[point.customdata]);
}));
"""
NORMALLY = "Click on a loop, and what was decided about it stands here."


def section(run: Subject) -> Section:
    lines = {
        "odometry alone": (run.odometry, ODOMETRY),
        "online (as believed while driving)": (run.online, ONLINE),
        "smoothed": (run.trajectory, SMOOTHED),
        **{
            name: (each, colour)
            for (name, each), colour in zip(run.beside.items(), cycle(OTHERS), strict=False)
        },
        **({"truth": (run.truth, TRUTH)} if run.truth else {}),
    }
    flat = is_flat(run.trajectory)
    loops = _placed(run)
    traces = [] if flat else [_solid(name, each, colour) for name, (each, colour) in lines.items()]
    if flat:
        traces = [line(name, colour, *_thinned(each)[:, :2].T) for name, (each, colour) in lines.items()]
        traces += _landmarks(run)
    groups: dict[str, list[int]] = defaultdict(list)
    for n, (decision, _) in enumerate(loops):
        groups[decision["verdict"]].append(n)
    for verdict, members in groups.items():
        traces += _segments(verdict, members, np.array([loops[n][1] for n in members]), flat)
    drawing = figure(traces, "x (m)", "y (m)", equal=True, height=640) if flat else _solid_figure(traces)
    told = [sentence(decision) for decision, _ in loops]
    click = f'<div class="told" id="loop-told">{NORMALLY}</div>' if loops else ""
    return Section(
        "Trajectory",
        drawn("path") + click,
        {"path": drawing},
        script_data("told", told) + CLICK if loops else "",
    )


def is_flat(trajectory: Trajectory) -> bool:
    extent = np.ptp(trajectory.sevens[:, :3], axis=0)
    return bool(extent[2] <= LAID_FLAT * max(extent.max(), 1e-9))


def _placed(run: Subject) -> list[tuple[Mapping[str, Any], Array]]:
    """What holds of each loop, and (2, 3) where its ends lie in the smoothed path."""
    loops = loops_of(run)
    stamps = np.array([moments for _, moments in loops], dtype=np.int64).ravel()
    places = run.trajectory.at(stamps)[:, :3].reshape(-1, 2, 3)
    found = zip((decision for decision, _ in loops), places, strict=True)
    return [(decision, place) for decision, place in found if np.isfinite(place).all()]


def _thinned(trajectory: Trajectory) -> Array:
    return trajectory.sevens[:: -(-len(trajectory) // MOST), :3]


def _segments(verdict: str, members: Sequence[int], ends: Array, flat: bool) -> list[dict[str, Any]]:
    """One line of gaps, and a mark in the middle of each loop that can be clicked."""
    broken = np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1).reshape(-1, 3)
    colour, name = VERDICTS[verdict], f"{len(members)} loops {'on ' * (verdict == 'probation')}{verdict}"
    middle = ends.mean(axis=1)
    if not flat:
        marker = {"color": colour, "size": 3}
        return [
            _cloud(name, broken, "lines", line={"color": colour, "width": 2}),
            _cloud(name, middle, "markers", marker=marker, customdata=members, showlegend=False),
        ]
    return [
        line(
            name, colour, *broken[:, :2].T, type=drawer(len(ends)), opacity=0.3, legendgroup=verdict, hoverinfo="skip"
        ),
        dots(
            name, colour, *middle[:, :2].T, customdata=members, legendgroup=verdict, showlegend=False,
            hovertemplate="click: why<extra></extra>",
        ),
    ]  # fmt: skip


def _landmarks(run: Subject) -> list[dict[str, Any]]:
    if not run.landmarks:
        return []
    points = np.array(list(run.landmarks.values()))
    marks = dots(
        f"{len(points)} landmarks", LANDMARK, *points[:, :2].T, text=list(run.landmarks),
        hovertemplate="landmark %{text}<extra></extra>",
    )  # fmt: skip
    marks["marker"] = {"color": LANDMARK, "size": 6, "symbol": "triangle-up"}
    rings = [_ellipse(points[n], each) for n, each in enumerate(run.landmark_covariances[:ELLIPSES])]
    outline = np.concatenate(rings)
    return [marks, line("two sigma", LANDMARK, *outline.T, opacity=0.5, hoverinfo="skip")]


def _ellipse(center: Array, covariance: Array) -> Array:
    """(25, 2) two sigma around a point seen from above, a gap at its end; nothing but gaps where it is not known."""
    if not np.isfinite(covariance).all():
        return np.full((1, 2), np.nan)
    sizes, axes = np.linalg.eigh(covariance[:2, :2])
    ring = center[:2, None] + 2 * axes @ (np.sqrt(np.maximum(sizes, 0))[:, None] * CIRCLE)
    return np.vstack([ring.T, np.full(2, np.nan)])


def _solid(name: str, trajectory: Trajectory, colour: str) -> dict[str, Any]:
    return _cloud(name, _thinned(trajectory), "lines", line={"color": colour, "width": 3})


def _cloud(name: str, points: Array, mode: str, **more: Any) -> dict[str, Any]:
    x, y, z = (numbers(column) for column in points.T)
    return {"type": "scatter3d", "name": name, "mode": mode, "x": x, "y": y, "z": z, **more}


def _solid_figure(traces: Sequence[Mapping[str, Any]]) -> Figure:
    axes = {f"{axis}axis": {"title": {"text": f"{axis} (m)"}} for axis in "xyz"}
    drawing = figure(traces, "", "", height=680, scene={**axes, "aspectmode": "data"})
    drawing["layout"].pop("xaxis"), drawing["layout"].pop("yaxis")
    return drawing
