"""Which input lies: chi-square of every source against what its noise promises, axis by axis and over time, and what noise would fit."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...core.measurement import SECOND, Array, parse_stamp
from .page import Section, dots, drawn, figure, line, said, table
from .subject import Subject

COLOURS = ("#1f4e9c", "#3c9a5f", "#d9822b", "#8e6bbf", "#c0392b", "#2a9d9d", "#555555")
HELD = ("gauge", "datum", "earth")  # what only says where the map lies
MOST = 4_000  # dots of one source
WINDOWS = 40  # along the run, of each source
ENOUGH = 10.0  # degrees of freedom in a window


def section(run: Subject) -> Section:
    linear = run.linearized
    sources = np.array([each.partition("/")[0] for each in linear.ids.tolist()])
    stamps = np.array([_stamp(each) for each in linear.ids.tolist()], dtype=np.int64)
    seconds = (stamps - run.trajectory.stamps[0]) / SECOND
    named = [name for name in dict.fromkeys(sources.tolist()) if name not in HELD]
    traces, ratios = [], []
    for name, colour in zip(named, COLOURS * len(named), strict=False):
        here = np.flatnonzero(sources == name)
        some = here[:: -(-len(here) // MOST)]
        ratio = np.sqrt(linear.chi_squares[some] / linear.rows[some])
        label = {
            "text": linear.ids[some].tolist(),
            "hovertemplate": "%{text}<br>%{y:.2f} sigma<extra></extra>",
        }
        traces.append(dots(name, colour, seconds[some], ratio, opacity=0.6, **label))
        here = here[np.argsort(stamps[here], kind="stable")]
        ratios += _over_time(name, colour, seconds[here], linear.chi_squares[here], linear.free[here])
    figures = {
        "residuals": figure(
            traces, "time along the run (s)", "residual (standard deviations, rms over the axes)"
        )
    }
    figures["residuals"]["layout"]["yaxis"]["rangemode"] = "tozero"
    body = said(
        "A source whose noise is stated truly has a ratio of 1: its chi-square is as large as the degrees of freedom that the others leave to check it. "
        "Above the bounds it is worse than it says (or disturbed), below it is better. Weights of robust kernels are included."
    )
    head = ("source", "axis", "factors", "chi-square", "expected", "ratio", "95 % bounds", "verdict")
    rows = [row for name, told in run.summary.get("consistency", {}).items() for row in _rows(name, told)]
    body += table(head, rows) + drawn("residuals")
    if ratios:
        figures["ratios"] = figure(ratios, "time along the run (s)", "chi-square / expected")
        figures["ratios"]["layout"]["yaxis"]["type"] = "log"
        body += said("The same ratio over time (NIS), each window with its 95 % bounds, dotted.") + drawn(
            "ratios"
        )
    return Section("Residuals", body, figures)


def _over_time(
    name: str, colour: str, seconds: Array, squares: Array, free: Array
) -> list[Mapping[str, Any]]:
    """Ratios in windows of as many degrees of freedom each, and their bounds. All in order of time."""
    total = float(free.sum())
    count = min(WINDOWS, int(total / ENOUGH))
    if count < 2:
        return []
    ends = np.searchsorted(np.cumsum(free), total * np.arange(1, count + 1) / count * (1 - 1e-12)) + 1
    starts = np.concatenate([[0], ends[:-1]])
    full = ends > starts
    starts = starts[full]
    left = np.add.reduceat(free, starts)
    ratio, middle = (
        np.add.reduceat(squares, starts) / left,
        np.add.reduceat(seconds, starts) / np.diff([*starts, len(free)]),
    )
    spread = 1.96 * np.sqrt(2 / left)
    thin = {
        "showlegend": False,
        "line": {"color": colour, "width": 0.8, "dash": "dot"},
        "hoverinfo": "skip",
        "legendgroup": name,
    }
    bounds = [line(name, colour, middle, each) | thin for each in (1 + spread, np.maximum(1 - spread, 0.01))]
    return [line(name, colour, middle, ratio, legendgroup=name), *bounds]


def _rows(name: str, told: Mapping[str, Any]) -> Iterator[tuple[object, ...]]:
    """Of a source, then of each of its axes that is off."""
    verdict = "consistent" if "ratio" in told else "nothing else measures the same"
    if "ratio" in told and not told["bounds_95"][0] <= told["ratio"] <= told["bounds_95"][1]:
        verdict = "worse than it says" if told["ratio"] > 1 else "better than it says"
    yield name, "all", told["factors"], *_numbers(told), verdict
    for axis, ratio in told["axes"].items():
        if "ratio" in ratio:
            yield "", axis, "", *_numbers(ratio), ratio.get("advice", "")


def _numbers(told: Mapping[str, Any]) -> tuple[str, ...]:
    if "ratio" not in told:
        return f"{told['chi_square']:.4g}", f"{told['expected']:.3g}", "", ""
    low, high = told["bounds_95"]
    return (
        f"{told['chi_square']:.4g}",
        f"{told['expected']:.4g}",
        f"{told['ratio']:.3f}",
        f"{low:.3f} to {high:.3f}",
    )


def _stamp(identifier: str) -> int:
    return parse_stamp(identifier.split("/")[1])
