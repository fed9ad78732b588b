"""A graph put together anew from its factors: which parts it has, what holds each of them, where to start.

Parts that a change tears apart stay where they are, the later one with a gauge of its own. Parts that it joins are moved onto
each other first, as when they were joined for the first time (see apply.py).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam

from .apply import shift_of
from .graph import Factor, is_pose
from .growth import gauge
from .parts import Parts
from .space import Space
from .variables import moved, pose_beside, value_in

Sighted = Mapping[
    int, tuple[int, Any]
]  # variable -> the first pose that it was tied to, and the value from there


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """factors: gauges first. values: of every variable that they touch, and of no other."""

    factors: tuple[Factor, ...]
    values: gtsam.Values
    parts: Parts


def assembled(
    space: Space,
    kept: Sequence[Factor],
    fresh: Sequence[Factor],
    gauges: Iterable[Factor],
    before: gtsam.Values,
    sighted: Sighted,
    stamp_of: Callable[[int], int],
) -> Assembly:
    """kept: in the graph before and after. fresh: new to it. gauges: those so far. before: what was believed, every pose included."""
    builder = _Builder(space, before)
    for factor in kept:
        builder.tie(factor)
    for factor in fresh:
        builder.align(factor)
        builder.tie(factor)
    builder.place(sighted)
    return Assembly((*builder.held(gauges, stamp_of), *kept, *fresh), builder.values, builder.parts)


class _Builder:
    def __init__(self, space: Space, before: gtsam.Values) -> None:
        self._space, self._before = space, before
        self.values, self.parts = gtsam.Values(), Parts()
        self._anchored: set[int] = set()  # parts that absolute poses or the earth hold
        for key in sorted(before.keys()):
            if is_pose(key):
                self.parts.begin(key, "")
                self.values.insert(key, space.pose_in(before, key))

    def tie(self, factor: Factor) -> None:
        """Its variables belong together."""
        first = pose_beside(factor.keys[0])
        for key in factor.keys:
            if key == first:
                continue
            if self.parts.of(key) is None:
                self.parts.put(key, first)
                if self._before.exists(key):
                    self.values.insert(key, value_in(self._space, self._before, key))
                continue
            kept, gone = sorted((self._part(first), self._part(key)))
            if kept != gone:
                self.parts.merge(kept, gone)
                if gone in self._anchored:
                    self._anchored.remove(gone)
                    self._anchored.add(kept)
        if factor.kind in ("pose", "datum"):
            self._anchored.add(self._part(first))

    def align(self, factor: Factor) -> None:
        """Where the factor connects what floats, move that so that the factor's error is zero."""
        if not all(map(is_pose, factor.keys)):
            return
        loose = {self._part(key) for key in factor.keys} - self._anchored
        if not loose or (factor.kind != "pose" and len({self._part(key) for key in factor.keys}) < 2):
            return
        part, poses = max(loose), [self._space.pose_in(self.values, key) for key in factor.keys]
        shift = shift_of(factor, poses, last=self._part(factor.keys[-1]) == part)
        for key in self.parts.members(part):
            if self.values.exists(key):
                self.values.update(key, moved(shift, key, value_in(self._space, self.values, key)))

    def place(self, sighted: Sighted) -> None:
        """Variables that are back: where they were seen first."""
        for part in self.parts.numbers:
            for key in self.parts.members(part):
                if not self.values.exists(key):
                    pose, seen = sighted[key]
                    self.values.insert(key, moved(self._space.pose_in(self.values, pose), key, seen))

    def held(self, gauges: Iterable[Factor], stamp_of: Callable[[int], int]) -> list[Factor]:
        """A gauge for each part that floats: its earliest so far, or a new one at its first pose."""
        known = {factor.keys[0]: factor for factor in gauges}
        found = []
        for part in self.parts.numbers:
            if part in self._anchored:
                self.parts.release(part)
                continue
            key = min((key for key in self.parts.members(part) if key in known), default=None)
            pose = self._space.pose_in(self.values, part)
            found.append(gauge(self._space, part, stamp_of(part), pose) if key is None else known[key])
            self.parts.hold(part, found[-1].id)
        return found

    def _part(self, key: int) -> int:
        part = self.parts.of(key)
        assert part is not None
        return part
