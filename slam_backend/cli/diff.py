"""`slam-backend diff RUN --from T1 --to T2`: what moved in the map between two moments, and what came between them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ..core.difference import Difference, Event, Shift
    from ..io.finished import FinishedRun

SHOWN = 10  # events, by how far they moved the newest pose


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, as `replay` writes it.")],
    first: Annotated[str, typer.Option("--from", metavar="T1", help="<sec>.<nsec>, or k<keyframe index>.")],
    last: Annotated[
        str, typer.Option("--to", metavar="T2", help="The same; now: the last keyframe.")
    ] = "now",
    as_json: Annotated[bool, typer.Option("--json", help="One object, with every loop.")] = False,
) -> None:
    """Compare what a run believed at two moments: what moved, how far, and which factors came or went between them.

    A moment stands for all up to it and nothing later. Found by a replay of the run's inputs, which must be where they were.
    """
    from ..io.finished import FinishedRun

    finished = FinishedRun(run)
    stamps = [_stamp(option, text, finished) for option, text in (("--from", first), ("--to", last))]
    found = finished.between(*stamps)
    if as_json:
        typer.echo(json.dumps(_plain(found, *stamps)))
    else:
        for line in _lines(found):
            typer.echo(line)


def _stamp(option: str, text: str, finished: "FinishedRun") -> int:
    from ..core.query import believed_at, moment_of

    return believed_at(moment_of(option, text), finished)


def _plain(found: "Difference", first: int, last: int) -> dict[str, Any]:
    from ..core.measurement import format_stamp

    keyframes = zip(
        found.stamps.tolist(),
        found.indices.tolist(),
        found.meters.tolist(),
        found.radians.tolist(),
        strict=True,
    )
    return {
        "from": format_stamp(first),
        "to": format_stamp(last),
        "revisions": found.revisions,
        "keyframes": found.keyframes,
        "moved": [
            {"stamp": format_stamp(stamp), "index": index, "m": meters, "rad": radians}
            for stamp, index, meters, radians in keyframes
        ],
        "landmarks": dict(zip(found.names, found.landmarks.tolist(), strict=True)),
        "came": found.came,
        "events": [_event(event) for event in found.events],
        "went": found.went,
    }


def _event(event: "Event") -> dict[str, Any]:
    from ..core.measurement import format_stamp

    data: dict[str, Any] = {"id": event.id, "kind": event.kind}
    if event.stamps:
        data["a"], data["b"] = map(format_stamp, event.stamps)
    if event.jump:
        data |= {"jump_m": event.jump.meters, "jump_rad": event.jump.radians}
    return data


def _lines(found: "Difference") -> list[str]:
    import numpy as np

    from ..core.measurement import format_stamp

    before, after = found.keyframes
    lines = [
        f"{after - before} keyframes more, {before} before; revision {found.revisions[0]} to {found.revisions[1]}"
    ]
    if found.moved:
        far = int(np.argmax(found.meters))
        lines.append(
            f"{found.moved} of {len(found.stamps)} keyframes moved: {_far(found.meters)}; "
            f"farthest k{found.indices[far]} at {format_stamp(int(found.stamps[far]))}, "
            f"turned {np.degrees(found.radians[far]):.3f} deg"
        )
    else:
        lines.append(f"none of {len(found.stamps)} keyframes moved")
    if len(found.names):
        name = found.names[int(np.argmax(found.landmarks))]
        lines.append(f"{len(found.names)} landmarks moved: {_far(found.landmarks)}; farthest {name}")
    came = ", ".join(f"{count} {kind}" for kind, count in sorted(found.came.items())) or "none"
    lines.append(f"factors that came: {came}; went: {len(found.went)}")
    lines += [f"  removed {id_}" for id_ in found.went[:SHOWN]]
    events = sorted(found.events, key=lambda event: -event.jump.meters if event.jump else 0.0)
    lines += [f"  {event.kind} {event.id}{_jump(event.jump)}" for event in events[:SHOWN]]
    if len(events) > SHOWN:
        lines.append(f"  and {len(events) - SHOWN} more, see --json")
    return lines


def _far(meters: Any) -> str:
    import numpy as np

    return f"median {np.median(meters):.4f} m, at most {meters.max():.4f} m"


def _jump(jump: "Shift | None") -> str:
    return f": the newest pose jumped {jump.meters:.4f} m" if jump else ""
