"""`slam-backend doctor INPUT...`: what the firewall makes of a recording, topic by topic, and what to mend."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ..io.doctor import Checkup, Finding, Topic

HEAD = ("topic", "type", "used as", "messages", "Hz", "gaps", "refused", "QoS", "verdict")
VERDICT = {None: "ok", "note": "ok", "warn": "look", "error": "SERIOUS"}


def command(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUT...", help="Bags (rosbag1, rosbag2 folder, .db3, .mcap), or one pose graph."
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option(metavar="F", help="YAML. Without it, sources are found by the types of the topics."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Judge a recording by the rules of the live node. Exit code 1 when something is serious.

    The rules, what they compare and what to do about them: docs/firewall.md.
    """
    from ..io.configfile import blaming, load_config
    from ..io.doctor import examine

    with blaming(config):
        checkup = examine(inputs, load_config(config) if config else None)
    typer.echo(json.dumps(_plain(checkup)) if as_json else "\n".join(_lines(checkup)))
    if checkup.serious:
        raise typer.Exit(1)


def _plain(checkup: "Checkup") -> dict[str, object]:
    return {
        "input": checkup.paths,
        "serious": checkup.serious,
        "space": checkup.space,
        "findings": [finding._asdict() for finding in checkup.findings],
        "notes": checkup.notes,
        "topics": [
            {
                "topic": topic.name,
                "type": topic.type,
                "used_as": topic.use,
                "messages": topic.messages,
                "measurements": topic.measurements,
                "rate_hz": topic.rate,
                "gaps": topic.gaps,
                "longest_gap_s": topic.longest_gap,
                "refused": topic.refused,
                "noted": topic.noted,
                "qos": topic.qos,
                "verdict": topic.severity or "ok",
                "findings": [finding._asdict() for finding in topic.findings],
            }
            for topic in checkup.topics
        ],
    }


def _lines(checkup: "Checkup") -> list[str]:
    rows = [HEAD, *map(_row, checkup.topics)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
    for topic in checkup.topics:
        told = topic.findings if topic.use else topic.findings[1:]  # why it is not used stands in the table
        lines += [_said(finding, f"{topic.name}: ") for finding in told]
    lines += [_said(finding, "") for finding in checkup.findings]
    lines += [f"note: {note}" for note in checkup.notes]
    where = ", ".join(checkup.paths)
    bad = [topic.name for topic in checkup.topics if topic.severity == "error"]
    what = f"serious: {', '.join(bad) or 'the recording itself'}" if checkup.serious else "nothing serious"
    return [*lines, f"{where}: {what}"]


def _row(topic: "Topic") -> tuple[str, ...]:
    refused = sum(topic.refused.values())
    gaps = f"{topic.gaps} ({topic.longest_gap:.1f} s)" if topic.gaps else "-"
    rate = "-" if topic.rate is None else f"{topic.rate:.1f}"
    use = topic.use or f"- ({topic.findings[0].what})"
    verdict = VERDICT[topic.severity] if topic.use or topic.severity != "note" else "-"
    return (
        topic.name, topic.type, use, str(topic.messages), rate, gaps, str(refused or "-"), topic.qos or "-", verdict,
    )  # fmt: skip


def _said(finding: "Finding", who: str) -> str:
    advice = f": {finding.advice}" if finding.advice else ""
    return f"{'SERIOUS' if finding.severity == 'error' else finding.severity}: {who}{finding.what}{advice}"
