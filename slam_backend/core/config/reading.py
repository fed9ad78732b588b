"""From what a YAML file holds to a Config, with one line about each mistake; and back."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from ..errors import BadConfig
from .section import Section
from .sources import (
    GnssSource,
    ImuSource,
    LandmarkSource,
    OdometrySource,
    PixelsSource,
    PoseSource,
    RelativeSource,
)
from .whole import Config

MOST_TOLD = 3  # mistakes in one line


def config_from(data: Mapping[str, Any], origin: str = "config") -> Config:
    """Build a Config from what a YAML file holds; BadConfig names `origin`, the setting and what to do.

    A file for the node (`<node>: {ros__parameters: {...}}`) is taken as well.
    """
    if (
        len(data) == 1
        and isinstance(inner := next(iter(data.values())), Mapping)
        and isinstance(inner.get("ros__parameters"), Mapping)
    ):
        data = inner["ros__parameters"]
    flat = dict(data)
    listed = flat.get("sources", [])
    if isinstance(listed, str):
        raise BadConfig(f"{origin}: 'sources' is a list of names: write sources: [{listed}]")
    if isinstance(listed, (list, tuple)):
        if wrong := [name for name in listed if not isinstance(name, str)]:
            raise BadConfig(
                f"{origin}: 'sources' is a list of names, each described below it; it holds {wrong[0]!r}"
            )
        if len(set(listed)) < len(listed):
            raise BadConfig(f"{origin}: 'sources' names {max(listed, key=listed.count)!r} twice")
        if missing := [name for name in listed if name not in flat]:
            described = [name for name in flat if name not in Config.model_fields and name not in listed]
            close = get_close_matches(missing[0], described, n=1)
            add = f"did you mean '{close[0]}'?" if close else f"add '{missing[0]}: {{kind: ...}}'"
            raise BadConfig(
                f"{origin}: source '{missing[0]}' is listed in 'sources' but not described: {add}"
            )
        flat["sources"] = {name: flat.pop(name) for name in listed}
    try:
        return Config.model_validate(flat)
    except ValidationError as error:
        raise BadConfig(f"{origin}: {_told(error, flat)}") from None


def config_to(config: Config) -> dict[str, Any]:
    """The effective configuration as YAML holds it; `config_from` gives the same Config back."""
    data = config.model_dump(mode="json")
    sources = data.pop("sources")
    return {**data, "sources": list(sources), **sources}


def words_of(field: FieldInfo) -> tuple[str, ...]:
    """The words that a setting may be; none for one that is not a choice."""
    parts = (field.annotation, *get_args(field.annotation))
    return tuple(dict.fromkeys(word for part in parts for word in get_args(part) if isinstance(word, str)))


def config_hash(config: Config) -> str:
    return hashlib.sha256(json.dumps(config_to(config), sort_keys=True).encode()).hexdigest()


def _told(error: ValidationError, data: Mapping[str, Any]) -> str:
    """The first few mistakes in one line."""
    errors = error.errors(include_url=False)
    sources = data.get("sources")
    names = list(sources) if isinstance(sources, Mapping) else []
    lines = [_one_told(each, names) for each in errors[:MOST_TOLD]]
    more = len(errors) - len(lines)
    return "; ".join(lines) + (f"; and {more} more" if more else "")


def _one_told(first: Any, names: Sequence[str]) -> str:
    """One mistake. names: of the sources."""
    parts = [str(part) for part in first["loc"]]
    if parts[:1] == ["sources"]:
        parts = [*parts[1:2], *parts[3:]]  # as in the file: without 'sources' and the kind
    where = ".".join(parts) or "the file"
    what = first["msg"].removeprefix("Value error, ")
    if first["type"] == "union_tag_invalid":
        what = f"there is no kind of source {first['ctx']['tag']!r}; known: {first['ctx']['expected_tags']}"
    if first["type"] == "union_tag_not_found":
        what = "is a source, and does not say its kind: add kind: odometry, relative, landmark, pose, gnss, imu or pixels"
    if first["type"] == "extra_forbidden":
        what = f"there is no such setting{_suggest(first['loc'], names)}"
    value = first.get("input")
    said = (
        f" (it says {value!r})"
        if isinstance(value, (str, int, float, bool)) and first["type"] != "extra_forbidden"
        else ""
    )
    return f"{where}: {what}{said}"


def _suggest(location: tuple[int | str, ...], names: Sequence[str]) -> str:
    """`; did you mean '...'?` for a misspelt key, from the settings of the section it stands in and, at the top, the sources."""
    *path, key = [str(part) for part in location]
    known: set[str] = {*Config.model_fields, *names}
    if path[:1] == ["sources"]:
        kinds: dict[str, type[Section]] = {
            "odometry": OdometrySource,
            "relative": RelativeSource,
            "landmark": LandmarkSource,
            "pose": PoseSource,
            "gnss": GnssSource,
            "imu": ImuSource,
            "pixels": PixelsSource,
        }
        known = set(kinds[path[-1]].model_fields) if path[-1] in kinds else set(kinds)
    elif path:
        section = Config.model_fields[path[0]].annotation
        known = set(getattr(section, "model_fields", {}))
    close = get_close_matches(key, known, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; known: {', '.join(sorted(known))}" if known else ""
