"""What a person asks of a running back-end. A record of the stream like any other, so that its replay does the same.

In a journal it is a std_msgs/msg/String on TOPIC that holds one JSON object:

    {"version": 1, "id": "5f0c…", "action": "optimize", "arguments": {}}

Its place is its order of arrival, so its stamp says nothing. What came of it is the Decision `command/<id>`.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .errors import BadMessage
from .measurement import Decoder, Measurement, Message

TOPIC = "/slam_backend/command"
TYPE = "std_msgs/msg/String"
VERSION = 1
LOAD = "load"  # the action that begins a session in a saved map; arguments: `run` beside the journal, and its `run_hash`
FIELDS: Mapping[str, type] = {"version": int, "id": str, "action": str, "arguments": dict}


@dataclass(frozen=True, slots=True, eq=False)
class Command(Measurement):
    """arguments: plain data, read by the action itself (see editor.py)."""

    id: str
    action: str
    arguments: Mapping[str, Any]


def command(id_: str, action: str, arguments: Mapping[str, Any]) -> Command:
    return Command(0, "command", id_, action, arguments)


def text_of(asked: Command) -> str:
    """The JSON of a record."""
    fields = {"version": VERSION, "id": asked.id, "action": asked.action, "arguments": asked.arguments}
    return json.dumps(fields)


def parse(text: str) -> Command:
    """The inverse of `text_of`; BadMessage says what is wrong."""
    try:
        fields = json.loads(text)
    except ValueError as error:
        raise BadMessage(f"a command that is no JSON: {error}") from None
    if not isinstance(fields, dict):
        raise BadMessage("a command that is no JSON object")
    if fields.get("version") != VERSION:
        raise BadMessage(f"a command of version {fields.get('version')!r}; known is {VERSION}")
    for name, type_ in FIELDS.items():
        if not isinstance(fields.get(name), type_):
            raise BadMessage(f"a command whose '{name}' is {fields.get(name)!r}, no {type_.__name__}")
    return command(fields["id"], fields["action"], fields["arguments"])


def decode(message: Message, source: str) -> Command:  # noqa: ARG001  # one signature for all decoders
    """std_msgs/msg/String."""
    return parse(message.data)


DECODERS: Mapping[str, Decoder] = {TYPE: decode}
