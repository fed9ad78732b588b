"""What a journal says about itself, in records of its own among the others: sessions and gaps, as JSON in std_msgs/msg/String.

begin   a session begins: versions, hash of the configuration
resume  the same session goes on in another process
config  the configuration that it works with from the start of the session on, as sources are found: the whole of it
gap     records that came and are not in the journal: how many, between which log times, why
end     the session has ended, and was saved; it will not be gone on with
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from ..core.graph import Decision
from .encode import encode_string
from .records import Record

TOPIC, TYPE = "/slam_backend/session", "std_msgs/msg/String"
Event = Mapping[str, Any]  # `event` is its name


def encoded(event: Event) -> bytes:
    return encode_string(json.dumps(event, sort_keys=True))


def event_of(data: bytes) -> Event:
    """data: CDR, as `encoded` makes it. ValueError if it is none."""
    event = json.loads(data[8:].rstrip(b"\0"))
    if isinstance(event, dict) and isinstance(event.get("event"), str):
        return event
    raise ValueError("not an event of a journal")


def decisions(message: Any, source: str) -> Iterator[Decision]:
    """A decoder as those of sensors are: a gap is confessed, whoever reads the journal."""
    event = json.loads(message.data)
    if event["event"] == "gap":
        after, until, lost, why = (event[key] for key in ("after", "until", "lost", "why"))
        detail = (
            f"{lost or 'some'} records that came between log times {after} and {until} ns are lost: {why}"
        )
        yield Decision(
            until, f"gap@{after}", source, "refused", "journal", "gap", detail, count=max(int(lost), 1)
        )


DECODERS: Mapping[str, Callable[[Any, str], Iterable[Decision]]] = {TYPE: decisions}


def gap(after: int, until: int, lost: int, why: str) -> Event:
    """after, until: ns, the log times of the records before and behind it. lost: how many; 0: not known."""
    return {"event": "gap", "after": after, "until": until, "lost": lost, "why": why}


def is_own(record: Record) -> bool:
    """Whether the journal speaks of itself, so that it was not heard."""
    return record.topic == TOPIC
