"""How long each update took, and what memory it cost."""

import numpy as np

from ...core.measurement import SECOND
from .page import Section, dots, drawn, figure, line, table
from .subject import Subject


def section(run: Subject) -> Section:
    timing = run.summary["timing"]
    update = timing["update_ms"]
    rows = [
        ("whole replay (s)", timing["wall_s"]), ("reading and checking (s)", timing["read_s"]), ("solving (s)", timing["solve_s"]),
        *((f"update {name} (ms)", update[name]) for name in ("p50", "p95", "p99", "max")),
        ("largest memory (MB)", run.summary["memory_mb"]),
    ]  # fmt: skip
    body = table(("", ""), rows)
    history = run.history
    if history is None or not len(history["stamps"]):
        return Section("Timing", body)
    seconds = (history["stamps"] - run.trajectory.stamps[0]) / SECOND
    times = figure(
        [dots("update", "#1f4e9c", seconds, history["ms"])],
        "time along the run (s)",
        "update (ms)",
        height=320,
    )
    times["layout"]["yaxis"]["type"] = "log" if np.ptp(np.log10(history["ms"].clip(1e-3))) > 2 else "linear"
    sizes = figure(
        [
            line("factors", "#3c9a5f", seconds, history["factors"]),
            line("keyframes", "#1f4e9c", seconds, history["keyframes"]),
            {**line("memory (MB)", "#d9822b", seconds, history["memory"]), "yaxis": "y2"},
        ],
        "time along the run (s)",
        "in the graph",
        height=320,
        yaxis2={"title": {"text": "memory (MB)"}, "overlaying": "y", "side": "right", "rangemode": "tozero"},
    )
    sizes["layout"]["margin"]["r"] = 64  # the axis on the right
    return Section("Timing", body + drawn("times") + drawn("sizes"), {"times": times, "sizes": sizes})
