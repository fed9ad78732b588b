"""Connected parts of the graph: each has one gauge, until an absolute pose or a joint to another part replaces it."""

from collections.abc import Sequence


class Parts:
    def __init__(self) -> None:
        self._of: dict[int, int] = {}
        self._members: dict[int, list[int]] = {}
        self._gauges: dict[int, str] = {}

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
        vars(self).update(vars(other))

    def merge(self, kept: int, gone: int) -> None:
        for key in self._members[gone]:
            self._of[key] = kept
        self._members[kept] += self._members.pop(gone)
        self._gauges.pop(gone, None)
