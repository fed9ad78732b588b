"""The largest clique of a graph that grows by a vertex at a time; exact within a bound of work, greedy beyond it.

A new vertex v makes the largest clique one larger or leaves it: only a clique of the present size among the neighbours of
v needs to be looked for. The search colours what is left, since a clique has at most one vertex of each colour (Tomita
& Seki, 2003). Sets of vertices are the bits of integers.
"""

from collections.abc import Iterator


class LargestClique:
    def __init__(self, steps: int) -> None:
        """steps: vertices that the search for one new vertex may colour, which is where its time goes."""
        self._steps = steps
        self._beside: list[int] = []
        self.members: frozenset[int] = frozenset()
        self.exact = True  # no search has been given up

    def add(self, beside: int) -> int:
        """A vertex whose neighbours are the bits of `beside`; its number."""
        v = len(self._beside)
        self._beside.append(beside)
        for u in _bits(beside):
            self._beside[u] |= 1 << v
        mask = _mask(self.members)
        if mask & beside == mask:  # beside all of the members
            self.members |= {v}
            return v
        self._left = self._steps
        found = self._clique(beside, len(self.members))
        if self._left < 0:
            self.exact = False
        if found is not None:
            self.members = frozenset((*found, v))
        return v

    def neighbours(self, v: int) -> int:
        return self._beside[v]

    def _clique(self, among: int, size: int) -> tuple[int, ...] | None:
        """One of that size among the bits of `among`; None if there is none, or none was found in time."""
        if size == 0:
            return ()
        self._left -= among.bit_count()
        if self._left < 0:
            return None
        for v, colours in reversed(self._coloured(among)):
            if colours < size:
                return None  # what is left has too few colours
            found = self._clique(among & self._beside[v], size - 1)
            if found is not None:
                return (*found, v)
            if self._left < 0:
                return None
            among &= ~(1 << v)
        return None

    def _coloured(self, among: int) -> list[tuple[int, int]]:
        """Vertices by colour, each with the number of colours up to its own."""
        found: list[tuple[int, int]] = []
        colour = 0
        while among:
            colour += 1
            free = among
            while free:
                lowest = free & -free
                v = lowest.bit_length() - 1
                found.append((v, colour))
                among ^= lowest
                free &= ~(self._beside[v] | lowest)
        return found


def _bits(mask: int) -> Iterator[int]:
    while mask:
        lowest = mask & -mask
        yield lowest.bit_length() - 1
        mask ^= lowest


def _mask(members: frozenset[int]) -> int:
    return sum(1 << member for member in members)
