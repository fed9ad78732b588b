"""What each loop did: how far it moved the map, where along the path, and how badly it fits at the end."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...core.measurement import SECOND
from ..colours import LOOP, SMOOTHED
from .page import Section, dots, drawn, figure, said, table
from .subject import Subject
from .verdicts import loops_of, sentence

MOST = 20  # rows
FITS = "chi-square at the end"


def section(run: Subject) -> Section | None:
    loops = {decision["id"]: decision for decision, _ in loops_of(run)}
    if not loops:
        return None
    verdicts = sorted({str(each["verdict"]) for each in loops.values()})
    counts = [(verdict, sum(each["verdict"] == verdict for each in loops.values())) for verdict in verdicts]
    body = table(("verdict", "loops"), counts)
    history = run.history
    if history is None or not len(history["loop_ids"]):
        return Section("What each loop did", body + _refused(loops))
    seconds = (history["loop_stamps"] - run.trajectory.stamps[0]) / SECOND
    ids = history["loop_ids"].tolist()
    named = {"text": ids, "hovertemplate": "%{text}<br>%{y:.3g} m<extra></extra>"}
    drawing = figure(
        [
            dots("the newest pose moved (drift removed)", SMOOTHED, seconds, history["loop_newest"], **named),
            dots("the farthest-moved pose", LOOP, seconds, history["loop_largest"], **named),
        ],
        "time along the run (s)",
        "moved (m)",
    )
    drawing["layout"]["yaxis"]["rangemode"] = "tozero"
    squares = dict(zip(run.linearized.ids.tolist(), run.linearized.chi_squares.tolist(), strict=True))
    order = np.argsort(-history["loop_largest"], kind="stable")[:MOST].tolist()
    rows = [
        (
            ids[n], f"{seconds[n]:.1f}", f"{history['loop_newest'][n]:.3f}", f"{np.degrees(history['loop_turn'][n]):.2f}",
            f"{history['loop_largest'][n]:.3f}", f"{squares[ids[n]]:.2f}" if ids[n] in squares else "not in the graph",
        )
        for n in order
    ]  # fmt: skip
    head = ("loop", "came in at (s)", "newest pose moved (m)", "turned (deg)", "largest shift (m)", FITS)
    body += drawn("loops") + said(
        "The loops that moved most. Loops of one keyframe came in together and share their shift."
    )
    return Section("What each loop did", body + table(head, rows) + _refused(loops), {"loops": drawing})


def _refused(loops: Mapping[str, Mapping[str, Any]]) -> str:
    out = [each for each in loops.values() if each["verdict"] not in ("accepted", "restored")]
    if not out:
        return ""
    more = f"<p>and {len(out) - 200} more, in decisions.jsonl</p>" if len(out) > 200 else ""
    rows = [(sentence(each),) for each in out[:200]]
    return f"<details><summary>{len(out)} loops that are not in the graph</summary>{table(('why',), rows)}{more}</details>"
