"""Message types: ROS 2 Jazzy's, and those that a bag defines itself."""

from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from .storage.parts import Connection

_RULE = "=" * 80 + "\n"
_OWN = (
    "std_msgs/msg/Header"  # rosbag1's has a `seq` that the conversion to CDR drops: Jazzy's is right for both
)


def typestore_of(connections: Iterable[Connection]) -> Typestore:
    """Jazzy's types and the definitions of these connections; where they differ, the bag's hold.

    A definition that cannot be parsed is left out: messages of that type will be refused when decoded.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    foreign: dict[str, Any] = {}
    for connection in connections:
        for name, (constants, fields) in _parsed(connection).items():
            known = store.fielddefs.get(name)
            if name != _OWN and (known is None or _shape(known[1]) != _shape(fields)):
                foreign.setdefault(name, (constants, fields))
    for name in foreign:
        store.fielddefs.pop(name, None)
        store.types.pop(name, None)
    for name, definition in foreign.items():
        with suppress(TypesysError, SyntaxError, ValueError):  # a definition that makes no Python class
            store.register({name: definition})
    return store


def _shape(fields: Any) -> Any:  # rosbags' parse tree
    """Names without case: ROS 1 writes `CameraInfo.K` for what ROS 2 calls `k`; the bytes are the same."""
    return [(name.lower(), kind) for name, kind in fields if name != "structure_needs_at_least_one_member"]


def _parsed(connection: Connection) -> dict[str, Any]:
    try:
        return dict(_definitions(connection.schema, connection.type, connection.definition))
    except (TypesysError, ValueError, AssertionError, RecursionError):
        return {}


@cache
def _definitions(schema: str, name: str, text: str) -> dict[str, Any]:
    """The types in one definition: the message itself and all that it is made of."""
    if schema in {"ros2msg", "ros1msg"} and text:
        return dict(get_types_from_msg(text, name))
    types: dict[str, Any] = {}
    if schema in {"ros2idl", "omgidl"}:
        for idl in text.split(_RULE)[1:] if text.startswith(_RULE) else [text]:
            types.update(get_types_from_idl(idl.split("\n", 1)[1] if idl.startswith("IDL: ") else idl))
    return types
