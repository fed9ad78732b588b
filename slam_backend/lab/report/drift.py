"""How far dead reckoning and the online estimate lie from the smoothed path, over time."""

from itertools import cycle

import numpy as np

from ...core.measurement import SECOND, Array
from ...core.trajectory import Stamps, Trajectory
from ..colours import ODOMETRY, ONLINE, OTHERS, SMOOTHED
from .page import Section, drawn, figure, line, said, table
from .subject import Subject

NO_TRUTH = (
    "The smoothed path is the best that is known here, not the truth. What the online estimate lacked is what later measurements told. "
    "With `slam-backend report RUN --truth F` the truth takes its place."
)
TRUTH_TOLD = "The truth is laid over the smoothed path as a whole (SE(3), least squares); everything else stands where the run put it."


def section(run: Subject) -> Section:
    smoothed = run.trajectory
    against, name = (run.truth, "truth") if run.truth else (smoothed, "smoothed path")
    others = zip(run.beside.items(), cycle(OTHERS), strict=False)
    compared = {
        "odometry alone": (run.odometry, ODOMETRY),
        "online, when it was newest": (run.online, ONLINE),
        **{other: (each, colour) for (other, each), colour in others},
        **({"smoothed": (smoothed, SMOOTHED)} if run.truth else {}),
    }
    seconds = (smoothed.stamps - smoothed.stamps[0]) / SECOND
    gaps = {
        which: (_gap(smoothed.stamps, each, against), colour) for which, (each, colour) in compared.items()
    }
    unit = f"distance to the {name} (m)"
    drawing = figure(
        [line(which, colour, seconds, gap) for which, (gap, colour) in gaps.items()],
        "time along the run (s)",
        unit,
    )
    rows = [
        (
            which,
            *(f"{np.nanpercentile(gap, p):.3f}" for p in (50, 95, 100)),
            f"{gap[np.isfinite(gap)][-1]:.3f}",
        )
        for which, (gap, _) in gaps.items()
        if np.isfinite(gap).any()
    ]
    body = said(NO_TRUTH if run.truth is None else TRUTH_TOLD) + drawn("drift")
    return Section(
        "Drift", body + table((unit, "median", "95 %", "largest", "at the end"), rows), {"drift": drawing}
    )


def _gap(stamps: Stamps, one: Trajectory, other: Trajectory) -> Array:
    """(N,) m at the stamps; NaN where one of them does not reach."""
    return np.asarray(np.linalg.norm(one.at(stamps)[:, :3] - other.at(stamps)[:, :3], axis=1))
