"""How far dead reckoning and the online estimate lie from the smoothed path, over time."""

import numpy as np

from ...core.measurement import SECOND, Array
from ...core.trajectory import Trajectory
from ...io.rundir import FinishedRun
from ..colours import ODOMETRY, ONLINE
from .page import Section, drawn, figure, line, said, table


def section(run: FinishedRun) -> Section:
    smoothed = run.trajectory
    seconds = (smoothed.stamps - smoothed.stamps[0]) / SECOND
    gaps = {
        "odometry alone": (_gap(smoothed, run.odometry), ODOMETRY),
        "online, when it was newest": (_gap(smoothed, run.online), ONLINE),
    }
    drawing = figure(
        [line(name, colour, seconds, gap) for name, (gap, colour) in gaps.items()],
        "time along the run (s)",
        "distance to the smoothed path (m)",
    )
    rows = [
        (
            name,
            *(f"{np.nanpercentile(gap, p):.3f}" for p in (50, 95, 100)),
            f"{gap[np.isfinite(gap)][-1]:.3f}",
        )
        for name, (gap, _) in gaps.items()
        if np.isfinite(gap).any()
    ]
    body = said(
        "The smoothed path is the best that is known here, not the truth. What the online estimate lacked is what later measurements told."
    )
    body += drawn("drift") + table(
        ("distance to the smoothed path (m)", "median", "95 %", "largest", "at the end"), rows
    )
    return Section("Drift", body, {"drift": drawing})


def _gap(smoothed: Trajectory, other: Trajectory) -> Array:
    """(N,) m at the keyframes; NaN where the other does not reach."""
    return np.asarray(np.linalg.norm(other.at(smoothed.stamps)[:, :3] - smoothed.sevens[:, :3], axis=1))
