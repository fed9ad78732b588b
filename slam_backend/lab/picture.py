"""The first thing to look at: the path before and after, landmarks and loops, to scale."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.graph import Decision
from ..core.measurement import Array
from ..core.trajectory import Trajectory
from ..io.result import Result
from .colours import LANDMARK, LOOP, ODOMETRY, REFUSED, SMOOTHED

PICTURE = "trajectory.png"

LAID_FLAT = 0.02  # share of the largest extent below which height is not worth a view of its own


def draw(result: Result, path: Path) -> None:
    """Write a picture: left odometry alone, right the smoothed trajectory over it. Axes in metres, equal."""
    plt = pyplot()
    snapshot = result.snapshot
    views = _views(snapshot.trajectory.sevens[:, :3])
    figure, grid = plt.subplots(len(views), 2, figsize=(14, 6.5 * len(views)), squeeze=False)
    for (left, right), (axes, names) in zip(grid, views, strict=True):
        before, after = snapshot.odometry.sevens[:, axes], snapshot.trajectory.sevens[:, axes]
        _path(left, before, ODOMETRY, "odometry alone")
        left.set_title("before: odometry alone")
        right.plot(*before.T, color=ODOMETRY, linewidth=0.7, alpha=0.35, label="odometry alone")
        _loops(right, result, axes)
        _path(right, after, SMOOTHED, "smoothed")
        if len(snapshot.landmarks):
            points = snapshot.landmarks[:, axes]
            right.scatter(
                *points.T, s=14, marker="^", color=LANDMARK, label=f"{len(points)} landmarks", zorder=3
            )
        right.set_title("after: smoothed")
        _limit(right, np.vstack([after, snapshot.landmarks[:, axes]]))
        for panel in (left, right):
            panel.set_aspect("equal", adjustable="box" if panel is right else "datalim")
            panel.set(xlabel=f"{names[0]} (m)", ylabel=f"{names[1]} (m)")
            panel.grid(alpha=0.3, linewidth=0.5)
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=6, fontsize=9, frameon=False)
    figure.suptitle(_title(result), fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def pyplot() -> Any:
    """Without a screen, and without a word about a home directory that cannot be written."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _views(positions: Array) -> list[tuple[list[int], str]]:
    """From above; from the side too where the path has height."""
    extent = np.ptp(positions, axis=0)
    above: tuple[list[int], str] = ([0, 1], "xy")
    return [above, ([0, 2], "xz")] if extent[2] > LAID_FLAT * extent.max() else [above]


def _path(panel: Any, points: Array, color: str, label: str) -> None:
    panel.plot(*points.T, color=color, linewidth=1.3, label=label, zorder=2)
    panel.plot(*points[0], "o", color=color, markersize=7, label="start", zorder=4)
    panel.plot(*points[-1], "s", color=color, markersize=6, label="end", zorder=4)


def _limit(panel: Any, points: Array) -> None:
    """Frame what is believed, not the drift behind it."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    panel.set_xlim(low[0] - margin, high[0] + margin)
    panel.set_ylim(low[1] - margin, high[1] + margin)


def _loops(panel: Any, result: Result, axes: list[int]) -> None:
    last: dict[str, Decision] = {d.id: d for d in result.decisions if d.ends is not None}
    groups = (
        (("accepted", "restored"), LOOP, "loops accepted", 0.35),
        (("refused", "removed", "probation"), REFUSED, "loops refused", 0.8),
    )
    for verdicts, color, name, alpha in groups:
        ends = [d.ends for d in last.values() if d.verdict in verdicts and d.ends is not None]
        lines = _lines(result.trajectory, ends, axes)
        if len(lines):
            xs, ys = (np.column_stack([lines[..., k], np.full(len(lines), np.nan)]).ravel() for k in (0, 1))
            panel.plot(
                xs, ys, color=color, linewidth=0.8, alpha=alpha, label=f"{len(lines)} {name}", zorder=1
            )


def _lines(trajectory: Trajectory, ends: Sequence[tuple[int, int]], axes: list[int]) -> Array:
    """(n, 2, 2): both ends of each loop that lies within the trajectory."""
    if not ends:
        return np.zeros((0, 2, 2))
    flat = trajectory.at(np.array(ends).ravel())[:, axes].reshape(-1, 2, 2)
    return np.asarray(flat[np.isfinite(flat).all(axis=(1, 2))])


def _title(result: Result) -> str:
    summary = result.summary
    counts, cost = summary["counts"], summary["cost"]
    name = ", ".join(Path(path).name for path in summary["input"])
    return (
        f"{name}: {counts['keyframes']} keyframes, {counts['factors']} factors, "
        f"cost {cost['initial']:.3g} by odometry alone, {cost['final']:.6g} smoothed"
    )
