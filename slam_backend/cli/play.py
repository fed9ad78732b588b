"""`slam-backend play BAG`: a bag's messages to real topics, for machines without `ros2 bag`."""

import json
import signal
import sys
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer

from ..core.errors import BadConfig, BadFile, MissingExtra
from .progress import progress

PARTING = 1.0  # s for acknowledgements after Ctrl-C


def command(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="rosbag1, rosbag2 folder, .db3 or .mcap.")],
    rate: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="R",
            help="Times the recorded speed; 0: 1,000 messages a second, whatever the log times.",
        ),
    ] = 1.0,
    topics: Annotated[
        list[str] | None,
        typer.Option(metavar="A,B", help="Only these of the bag's topics; may be repeated."),
    ] = None,
    clock: Annotated[
        bool, typer.Option("--clock", help="Publish /clock, for nodes with use_sim_time.")
    ] = False,
    wait: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="Longest wait for a subscriber on every topic.")
    ] = 10.0,
    depth: Annotated[
        int,
        typer.Option(min=500, help="Messages kept for subscribers that are behind; then the player waits."),
    ] = 2000,
    remap: Annotated[
        list[str] | None, typer.Option(metavar="A:=B", help="Play topic A of the bag to B; may be repeated.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was played as JSON.")] = False,
) -> None:
    """Publish a bag's messages, byte for byte, at the pace of their log times; Ctrl-C ends it at any time."""
    from ..io.bags import open_bag

    with open_bag(bag) as opened:
        filled = [name for name, topic in opened.topics.items() if topic.count]
        names = _renamed(_chosen(filled, topics), remap or ())
        try:
            from ..ros.player import Player
        except ImportError as error:
            raise MissingExtra(
                f"{error.name or error} is not installed: source a ROS 2 Jazzy install, or pip install 'slam_backend[ros]'"
            ) from None
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with Player(opened, names, depth, clock=clock) as player:
            if not player.count:
                raise BadFile(
                    f"{bag}: nothing to play: {'; '.join(player.skipped) or 'it holds no messages'}"
                )
            result = _play(player, rate, wait)
        _report(result, [*player.skipped, *opened.damage], as_json)
    if result["interrupted"]:
        raise typer.Exit(130)


def _chosen(there: Iterable[str], wanted: list[str] | None) -> list[str]:
    """The topics to play. BadConfig for one that the bag does not have."""
    known = list(there)
    names = [name for word in wanted or () for name in word.split(",") if name]
    for name in names:
        if name not in known:
            raise BadConfig(f"--topics {name}: the bag has no such topic{_instead(name, known)}")
    return names or known


def _renamed(topics: Iterable[str], remaps: Iterable[str]) -> Mapping[str, str]:
    """Name in the bag -> name to play to. BadConfig for a rule that is none, or names no topic that is played."""
    names = {topic: topic for topic in topics}
    for rule in remaps:
        old, arrow, new = rule.partition(":=")
        if not (old and arrow and new):
            raise BadConfig(f"--remap {rule}: write OLD:=NEW, for instance /odom:=/wheels/odom")
        if old not in names:
            raise BadConfig(f"--remap {rule}: no topic '{old}' is played{_instead(old, names)}")
        names[old] = new
    return names


def _instead(name: str, known: Iterable[str]) -> str:
    close = get_close_matches(name, list(known), n=1)
    return f"; did you mean '{close[0]}'?" if close else f"; there are {', '.join(known) or 'none'}"


def _play(player: Any, rate: float, wait: float) -> dict[str, Any]:
    """Play to the end or to Ctrl-C, and tell how it went. player: a ros.player.Player, which needs rclpy."""
    lonely: list[str] = []
    begin, interrupted, behind = monotonic(), False, []
    try:
        lonely = player.wait_for_receivers(wait)
        begin = monotonic()
        with progress("play", player.count) as advance:
            for _ in player.play(rate):
                advance(1)
        seconds = monotonic() - begin
        behind = player.finish()
    except KeyboardInterrupt:
        interrupted, seconds = True, monotonic() - begin
        behind = player.finish(PARTING)
    return {
        "played": dict(sorted(player.played.items())),
        "seconds": round(seconds, 3),
        "interrupted": interrupted,
        "without_subscriber": lonely,
        "not_acknowledged": behind,
    }


def _report(result: Mapping[str, Any], troubles: Iterable[str], as_json: bool) -> None:
    """How many were published per topic; trouble on stderr, a line each."""
    for line in troubles:
        sys.stderr.write(f"note: {line}\n")
    if result["without_subscriber"]:
        sys.stderr.write(
            f"note: nobody had subscribed to {', '.join(result['without_subscriber'])} at the start\n"
        )
    if result["not_acknowledged"]:
        sys.stderr.write(
            f"note: not acknowledged by all subscribers: {', '.join(result['not_acknowledged'])}\n"
        )
    if as_json:
        typer.echo(json.dumps(result))
        return
    for topic, count in result["played"].items():
        typer.echo(f"{topic}: {count}")
    total, how = sum(result["played"].values()), "interrupted after" if result["interrupted"] else "in"
    typer.echo(f"played {total} messages {how} {result['seconds']:.1f} s")
