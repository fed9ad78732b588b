"""What was decided about the loops of a run, read from its decisions."""

from collections.abc import Mapping
from typing import Any

from ...core.measurement import parse_stamp
from .subject import Subject

ENTERED = frozenset({"admit/unjudged"})  # rules by which a loop simply came in
Loop = tuple[Mapping[str, Any], tuple[int, int]]


def loops_of(run: Subject) -> list[Loop]:
    """What holds of each relative measurement, and the stamps (ns) of its two ends."""
    last = {each["id"]: each for each in run.decisions if "a" in each}
    return [(each, (parse_stamp(each["a"]), parse_stamp(each["b"]))) for each in last.values()]


def entered(run: Subject) -> dict[str, int]:
    """The stamp (ns) of the keyframe with which each loop came in: those of the history."""
    history = run.history
    if history is None:
        return {}
    return dict(zip(history["loop_ids"].tolist(), history["loop_stamps"].tolist(), strict=True))


def sentence(decision: Mapping[str, Any]) -> str:
    compared = ""
    if decision.get("statistic") is not None and decision.get("threshold") is not None:
        compared = f" ({decision['statistic']:.4g} against {decision['threshold']:.4g})"
    rule = f"{decision['stage']}/{decision['reason']}"
    return f"{decision['id']}: {decision['verdict']} by {rule}{compared}. {decision.get('detail', '')}"
