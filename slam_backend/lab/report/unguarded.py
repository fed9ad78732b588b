"""The same graph with every loop that was offered: what the judges kept out of the map."""

import numpy as np

from ...io.formats import tum
from ..colours import REFUSED, SMOOTHED
from ..unguarded import NAME
from .page import Section, drawn, figure, line, said
from .subject import Subject
from .verdicts import loops_of


def section(run: Subject) -> Section | None:
    if not (run.path / NAME).exists():
        return None
    warped = tum.read(run.path / NAME).sevens
    apart = np.linalg.norm(warped[:, :3] - run.trajectory.sevens[:, :3], axis=1)
    out = sum(decision["verdict"] not in ("accepted", "restored") for decision, _ in loops_of(run))
    drawing = figure(
        [
            line(f"with all loops, {out} of them not in the map", REFUSED, *warped[:, :2].T),
            line("the map", SMOOTHED, *run.trajectory.sevens[:, :2].T),
        ],
        "x (m)", "y (m)", equal=True, height=520,
    )  # fmt: skip
    told = (
        f"Had every loop that was offered been taken, poses would lie {np.median(apart):.3g} m (median) "
        f"and up to {apart.max():.3g} m from where the map has them."
    )
    return Section("Without judges", said(told) + drawn("unguarded"), {"unguarded": drawing})
