"""`slam-backend journal info|verify|export|compact PATH`: what a node's journal holds, and whether it is whole."""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .progress import progress

if TYPE_CHECKING:
    from ..io.restore import Examination

Answer = tuple[Mapping[str, Any], list[str], bool]  # for machines, for people, whether all is well


def command(
    action: Annotated[
        Literal["info", "verify", "export", "compact"],
        typer.Argument(
            help="info: sessions, topics, damage. verify: every checksum, the order, gaps. export: an ordinary bag. compact: less space."
        ),
    ],
    path: Annotated[Path, typer.Argument(metavar="PATH", help="A journal, or the data_dir that it lies in.")],
    out: Annotated[
        Path | None,
        typer.Argument(metavar="[OUT]", help="Of export: an .mcap file, or a folder for rosbag2 sqlite3."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Look at, check, copy or compact the journal of a node. Exit code 1 if verify finds damage."""
    if (out is not None) != (action == "export"):
        raise typer.BadParameter("export needs OUT, the others take none", param_hint="OUT")
    actions: Mapping[str, Callable[[], Answer]] = {
        "info": lambda: _info(_examined(path)),
        "verify": lambda: _verify(_examined(path)),
        "export": lambda: _export(_file(path), out or Path()),
        "compact": lambda: _compact(path),
    }
    data, lines, well = actions[action]()
    typer.echo(json.dumps(data) if as_json else "\n".join(lines))
    if not well:
        raise typer.Exit(1)


def _file(path: Path) -> Path:
    from ..io.journal import NAME

    return path / NAME if path.is_dir() else path


def _examined(path: Path) -> "Examination":
    from ..io.restore import examine

    with progress("read", None) as advance:
        return examine(_file(path), advance)


def _data(found: "Examination") -> dict[str, Any]:
    begin, end = found.span or (0, 0)
    return {
        "journal": str(found.path),
        "records": found.records,
        "topics": dict(sorted(found.topics.items())),
        "begin": begin,
        "end": end,
        "seconds": (end - begin) / 1e9,
        "events": [{"log_time": log_time, **event} for log_time, event in found.events],
        "torn": found.torn,
        "damage": list(found.damage),
    }


def _info(found: "Examination") -> Answer:
    data = _data(found)
    lines = [f"{found.path}: {found.records} records over {data['seconds']:.1f} s"]
    lines += [f"  {count:>9}  {topic}" for topic, count in data["topics"].items()]
    for event in data["events"]:
        after = (event["log_time"] - data["begin"]) / 1e9
        lines.append(f"  {after:>8.1f}s  {event['event']}{_said(event)}")
    return data, [*lines, *_troubles(found)], True


def _verify(found: "Examination") -> Answer:
    gaps = [event for _, event in found.events if event["event"] == "gap"]
    data = {**_data(found), "gaps": len(gaps), "whole": not found.damage}
    lines = [f"gap: {_said(event)}" for event in gaps] + _troubles(found)
    verdict = (
        "is damaged"
        if found.damage
        else "is whole: each record matches its checksum and follows the one before"
    )
    return data, [*lines, f"{found.path}: {found.records} records; it {verdict}"], not found.damage


def _said(event: Mapping[str, Any]) -> str:
    match event["event"]:
        case "begin" | "resume":
            return f"  slam_backend {event.get('versions', {}).get('slam_backend', '')}"
        case "config":
            return f"  {event.get('hash', '')[:16]}  {', '.join(event.get('config', {}).get('sources', []))}"
        case "gap":
            return f"  {event['lost'] or 'some'} records lost: {event['why']}"
    return ""


def _troubles(found: "Examination") -> list[str]:
    lines = [f"torn: {found.torn}"] if found.torn else []
    return lines + [f"damage: {line}" for line in found.damage]


def _export(path: Path, out: Path) -> Answer:
    from ..io.bags import open_bag, write_bag

    with open_bag(path) as bag:
        written = write_bag(out, bag.records(), bag.typestore)
        damage = bag.damage
    sys.stderr.write("".join(f"damage: {line}\n" for line in damage))
    data = {"journal": str(path), "bag": str(out), "records": written, "damage": damage}
    return data, [f"{out}: {written} records"], True


def _compact(path: Path) -> Answer:
    from ..io.compact import compact

    lines = list(compact(path))
    return {"done": lines}, lines, True
