"""Connected parts of the graph: each has one gauge, until an absolute pose or a joint to another part replaces it."""

from collections.abc import Mapping, Sequence


class Parts:
    def __init__(self) -> None:
        self._of: dict[int, int] = {}
        self._members: dict[int, list[int]] = {}
        self._gauges: dict[int, str] = {}
        self.home: int | None = None  # the part that is the map to others: it is not moved, whatever holds it

    def __len__(self) -> int:
        return len(self._members)

    @property
    def numbers(self) -> list[int]:
        return list(self._members)

    def of(self, key: int) -> int | None:
        """The part that a variable belongs to; None when it is not in the graph."""
        return self._of.get(key)

    def members(self, part: int) -> Sequence[int]:
        return self._members[part]

    def gauge(self, part: int) -> str | None:
        """Id of the factor that fixes the part in space; None when absolute measurements do."""
        return self._gauges.get(part)

    def is_loose(self, part: int) -> bool:
        """Whether the part may be moved as a whole: only its gauge holds it."""
        return part in self._gauges and part != self.home

    def restore(self, parts: Mapping[int, int], gauges: Mapping[int, str]) -> None:
        """Take over the parts of a saved map, by variable, and their gauges. The one that began first is the map."""
        for key, part in parts.items():
            self._of[key] = part
            self._members.setdefault(part, []).append(key)
        self._gauges |= gauges
        self.home = min(self._members)

    def all(self) -> Mapping[int, int]:
        """Variable -> its part."""
        return self._of

    def begin(self, key: int, gauge: str) -> None:
        """A new part with one variable, numbered by it: parts that begin earlier have smaller numbers."""
        self._of[key] = key
        self._members[key] = [key]
        self._gauges[key] = gauge

    def put(self, key: int, beside: int) -> None:
        """A new variable joins the part of one that is known."""
        part = self._of[beside]
        self._of[key] = part
        self._members[part].append(key)

    def drop(self, key: int) -> None:
        """Take back a variable that was put or begun last."""
        part = self._of.pop(key)
        self._members[part].remove(key)
        if not self._members[part]:
            del self._members[part]
            self._gauges.pop(part, None)

    def hold(self, part: int, gauge: str) -> None:
        """The part has this gauge now."""
        self._gauges[part] = gauge

    def release(self, part: int) -> None:
        """The part's gauge has been removed."""
        self._gauges.pop(part, None)

    def become(self, other: "Parts") -> None:
        """The parts of a graph that has been put together anew."""
        home = None if self.home is None else other.of(self.home)
        vars(self).update({**vars(other), "home": home})

    def merge(self, kept: int, gone: int) -> None:
        """The gauge of the part that is gone holds nothing any more."""
        for key in self._members[gone]:
            self._of[key] = kept
        self._members[kept] += self._members.pop(gone)
        self._gauges.pop(gone, None)
