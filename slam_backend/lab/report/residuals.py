"""Which input lies: chi-square of every source against what its noise promises, and what noise would fit."""

import numpy as np

from ...core.measurement import SECOND, Array, parse_stamp
from .page import Section, dots, drawn, figure, said, table
from .subject import Subject

COLOURS = ("#1f4e9c", "#3c9a5f", "#d9822b", "#8e6bbf", "#c0392b", "#2a9d9d", "#555555")
HELD = ("gauge", "datum", "earth")  # what only says where the map lies
MOST = 4_000  # dots of one source
LITTLE = 3.0  # degrees of freedom left over, below which nothing can be said


def section(run: Subject) -> Section:
    linear = run.linearized
    sources = np.array([each.partition("/")[0] for each in linear.ids.tolist()])
    left = linear.redundancy()
    rows, traces = [], []
    named = [name for name in dict.fromkeys(sources.tolist()) if name not in HELD]
    for name, colour in zip(named, COLOURS * len(named), strict=False):
        here = np.flatnonzero(sources == name)
        rows.append(_row(name, linear.chi_squares[here], left[here]))
        some = here[:: -(-len(here) // MOST)]
        stamps = np.array([_stamp(each) for each in linear.ids[some].tolist()], dtype=np.int64)
        seconds = (stamps - run.trajectory.stamps[0]) / SECOND
        ratio = np.sqrt(linear.chi_squares[some] / linear.rows[some])
        label = {
            "text": linear.ids[some].tolist(),
            "hovertemplate": "%{text}<br>%{y:.2f} sigma<extra></extra>",
        }
        traces.append(dots(name, colour, seconds, ratio, opacity=0.6, **label))
    drawing = figure(traces, "time along the run (s)", "residual (standard deviations, rms over the axes)")
    drawing["layout"]["yaxis"]["rangemode"] = "tozero"
    body = said(
        "A source whose noise is stated truly has a ratio of 1: its chi-square is as large as the degrees of freedom that the others leave to check it. "
        "Above the bound it is worse than it says (or disturbed), below it is better. Weights of robust kernels are included."
    )
    head = ("source", "factors", "chi-square", "expected", "ratio", "95 % bounds", "verdict")
    return Section("Residuals", body + table(head, rows) + drawn("residuals"), {"residuals": drawing})


def _row(name: str, squares: Array, left: Array) -> tuple[object, ...]:
    chi, free = float(squares.sum()), float(left.sum())
    if free < LITTLE:
        return name, len(squares), f"{chi:.4g}", f"{free:.3g}", "", "", "nothing else measures the same"
    ratio, spread = chi / free, 1.96 * np.sqrt(2 / free)
    low, high = max(1 - spread, 0.0), 1 + spread
    verdict = "consistent"
    if not low <= ratio <= high:
        word = "optimistic" if ratio > high else "pessimistic"
        verdict = f"{word}: {np.sqrt(ratio):.2f} times its standard deviations would fit"
    return (
        name,
        len(squares),
        f"{chi:.4g}",
        f"{free:.4g}",
        f"{ratio:.3f}",
        f"{low:.3f} to {high:.3f}",
        verdict,
    )


def _stamp(identifier: str) -> int:
    return parse_stamp(identifier.split("/")[1])
