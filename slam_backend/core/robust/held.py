"""Loops by the places of their ends, which of them agree, and the cliques among them.

Two loops agree when the cycle a1 -> a2 => b2 -> b1 <= a1, over odometry at both ends, closes: the pairwise consistency of PCM
(Mangelson et al., ICRA 2018). A clique is a set of loops of which every two agree. Odometry between two poses never changes,
so neither does whether two loops agree.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from ..config import Config
from ..graph import Factor
from .accord import Accord, Ruler
from .paths import Path, Paths

LOOKS = 24  # nearest loops that a clique is searched among


class Held:
    """Loops by id, in the order in which they came."""

    def __init__(self, paths: Paths, config: Config) -> None:
        self._paths, self._config = paths, config.witness
        self._ruler = Ruler(paths.space, config.gate, paths.usual)
        self._loops: dict[str, Factor] = {}
        self._rows: dict[str, int] = {}
        self._ids: list[str] = []
        self._chains = np.zeros((64, 2), dtype=np.int64)
        self._meters = np.full((64, 2), np.nan)  # NaN: gone
        self._agreed: dict[str, dict[str, Accord | None]] = {}

    def __len__(self) -> int:
        return len(self._loops)

    def __contains__(self, id_: object) -> bool:
        return id_ in self._loops

    def __iter__(self) -> Iterator[Factor]:
        return iter(tuple(self._loops.values()))

    def __getitem__(self, id_: str) -> Factor:
        return self._loops[id_]

    @property
    def oldest(self) -> Factor:
        return next(iter(self._loops.values()))

    def add(self, loop: Factor) -> None:
        if loop.id in self._loops:
            return
        row = len(self._ids)
        if row == len(self._meters):
            self._compact()
            row = len(self._ids)
        (chain_a, meters_a), (chain_b, meters_b) = (self._paths.place(key) for key in loop.keys)
        self._chains[row], self._meters[row] = (chain_a, chain_b), (meters_a, meters_b)
        self._ids.append(loop.id)
        self._loops[loop.id], self._rows[loop.id] = loop, row
        self._agreed[loop.id] = {}

    def drop(self, id_: str) -> None:
        if id_ in self._loops:
            del self._loops[id_], self._agreed[id_]
            self._meters[self._rows.pop(id_)] = np.nan

    def beside(self, loop: Factor) -> list[Factor]:
        """The others whose ends lie within reach of its ends, the nearest first."""
        (chain_a, meters_a), (chain_b, meters_b) = (self._paths.place(key) for key in loop.keys)
        n = len(self._ids)
        chains, meters = self._chains[:n], self._meters[:n]
        distance = np.full(n, np.inf)
        for first, second in ((0, 1), (1, 0)):
            same = (chains[:, first] == chain_a) & (chains[:, second] == chain_b)
            between = np.abs(meters[:, first] - meters_a) + np.abs(meters[:, second] - meters_b)
            distance = np.fmin(distance, np.where(same, between, np.inf))
        rows = np.flatnonzero(distance <= self._config.reach)
        rows = rows[np.argsort(distance[rows], kind="stable")]
        return [self._loops[self._ids[row]] for row in rows.tolist() if self._ids[row] != loop.id]

    def agree(self, one: Factor, other: Factor) -> Accord | None:
        """What the cycle through both says; None if they are the same evidence, or too far apart to tell."""
        first, second = min(one.id, other.id), max(one.id, other.id)
        known = self._agreed[first]
        if second not in known:
            known[second] = self.accord(one, other)
        return known[second]

    def accord(self, one: Factor, other: Factor) -> Accord | None:
        """The same of loops that need not be held."""
        cycle = self._around(one, other)
        return None if cycle is None else self._ruler.compare(self._paths.path_of(one), cycle)

    def _around(self, one: Factor, other: Factor) -> Path | None:
        """From a to b of one loop by way of the other, whichever way round is shorter."""
        (a, b), (c, d) = one.keys, other.keys
        places = {key: self._paths.place(key) for key in (a, b, c, d)}
        ways = []
        for first, second in ((c, d), (d, c)):
            (p, at_a), (q, at_first), (r, at_second), (s, at_b) = (
                places[key] for key in (a, first, second, b)
            )
            if (p, r) == (q, s):
                ways.append((abs(at_a - at_first) + abs(at_second - at_b), first, second))
        if not ways:
            return None
        meters, first, second = min(ways, key=lambda way: way[0])
        if not self._config.apart <= meters <= self._config.reach:
            return None
        leap = self._paths.path_of(other)
        out, back = self._paths.along(a, first), self._paths.along(second, b)
        assert out is not None
        assert back is not None
        return out.then(leap if first == c else leap.inverse()).then(back)

    def clique(self, loop: Factor, size: int, sure: float = np.inf) -> tuple[Factor, ...]:
        """One of that size with the loop in it; else the largest that was found. sure: largest of an agreement that counts (m)."""
        limit = self._ruler.threshold

        def agree(one: Factor, other: Factor) -> bool:
            found = self.agree(one, other)
            return found is not None and found.possible and found.statistic <= limit and found.sure <= sure

        def grown(clique: tuple[Factor, ...], others: Sequence[Factor]) -> tuple[Factor, ...]:
            best = clique
            for n, other in enumerate(others):
                if len(best) >= size:
                    break
                best = max(
                    best, grown((*clique, other), [f for f in others[n + 1 :] if agree(other, f)]), key=len
                )
            return best

        best: tuple[Factor, ...] = (loop,)
        friends: list[Factor] = []
        for near in self.beside(loop)[:LOOKS]:
            if agree(loop, near):
                best = max(best, grown((loop, near), [f for f in friends if agree(near, f)]), key=len)
                if len(best) >= size:
                    break
                friends.append(near)
        return best

    def against(self, loop: Factor) -> list[str]:
        """Those nearby that contradict it."""
        found = ((near.id, self.agree(loop, near)) for near in self.beside(loop)[:LOOKS])
        return [id_ for id_, accord in found if accord is not None and not accord]

    def _compact(self) -> None:
        """Room for more: rows that are gone are given up."""
        kept = [self._rows[id_] for id_ in self._loops]
        size = max(64, 2 * len(kept))
        chains, meters = np.zeros((size, 2), dtype=np.int64), np.full((size, 2), np.nan)
        chains[: len(kept)], meters[: len(kept)] = self._chains[kept], self._meters[kept]
        self._chains, self._meters = chains, meters
        self._ids = list(self._loops)
        self._rows = {id_: n for n, id_ in enumerate(self._ids)}
