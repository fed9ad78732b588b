"""Wrong loops that a front-end could have proposed in a recorded drive: what a robust back-end must withstand.

Single ones say of two places that they are one, with a transform and a noise like those of the loops that were recorded.
Groups are several wrong loops that agree with each other to within their noise, because one stretch of the drive looks
like another (perceptual aliasing): the two stretches are chosen for their similar shape.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Self

import numpy as np

from ..core.config import Config
from ..core.graph import Decision, Pose
from ..core.measurement import Array, Measurement, frozen
from ..core.sensors.relative import RelativePose
from ..core.space import Space
from ..core.trajectory import Trajectory
from ..io.inputs import Inputs, Stream

FARTHER = (1.0, radians(10))  # m, rad: a loop that is off by less than both is not called wrong
APART = (
    10.0  # m of path between the two places at least: no detector proposes what the robot has only just seen
)
SPACING = 4.0  # m of path between two loops of a group
CANDIDATES = 20  # stretches, of which a group takes the two most alike
JITTER = (0.3, radians(3))  # m, rad: of the transform of a single one, so that no two are the same
DRAWS = 200  # for each wanted loop, before a drive is given up as too short


class Wrongs:
    """Draws wrong loops. reference: where the keyframes are; like: the loops that were recorded, at least one."""

    def __init__(self, reference: Trajectory, like: Sequence[RelativePose], space: Space, seed: int) -> None:
        self._stamps, self._like, self._space = reference.stamps, like, space
        self._poses = [space.pose(seven) for seven in reference.sevens.tolist()]
        steps = np.linalg.norm(np.diff(reference.sevens[:, :3], axis=0), axis=1)
        self._path = np.concatenate([[0.0], np.cumsum(steps)])
        self._draw = np.random.default_rng(seed)
        self._taken = {frozenset(each.ends) for each in like}

    def loops(self, count: int, size: int = 1) -> list[RelativePose]:
        """About `count` loops, ordered by stamp, in whole groups of `size`; fewer where the drive has no room for them."""
        made: list[RelativePose] = []
        groups = max(1, round(count / size)) if count else 0
        for _ in range(DRAWS * groups):
            if len(made) == groups * size:
                break
            group = self._single() if size == 1 else self._group(size)
            ends = {frozenset(each.ends) for each in group}
            if len(ends) == size and not ends & self._taken:
                self._taken |= ends
                made += group
        return sorted(made, key=lambda loop: loop.stamp)

    def _single(self) -> list[RelativePose]:
        like = self._some()
        a, b = self._draw.integers(len(self._poses), size=2).tolist()
        z = self._jittered(self._space.pose(like.pose.tolist()))
        return [self._loop(like, a, b, z)] if self._wrong(a, b, z) else []

    def _group(self, size: int) -> list[RelativePose]:
        like = self._some()
        a = self._stretch(size)
        others = [self._stretch(size) for _ in range(CANDIDATES)]
        found = [b for b in others if a and b and not set(a) & set(b)]
        if not found:
            return []
        b = min(found, key=lambda rows: self._unlike(a, rows))
        z = self._jittered(self._space.pose(like.pose.tolist()))
        claims = []
        for m, n in zip(a, b, strict=True):
            back = self._poses[m].between(self._poses[a[0]])
            exact = back.compose(z).compose(self._poses[b[0]].between(self._poses[n]))
            claims.append((m, n, self._noisy(exact, like)))
        wrong = all(self._wrong(*claim) for claim in claims)
        return [self._loop(like, *claim) for claim in claims] if wrong else []

    def _some(self) -> RelativePose:
        return self._like[int(self._draw.integers(len(self._like)))]

    def _stretch(self, size: int) -> list[int]:
        """Rows SPACING of path apart, from a random one on; none where the drive ends before."""
        first = int(self._draw.integers(len(self._path)))
        wanted = self._path[first] + SPACING * np.arange(size)
        rows = np.searchsorted(self._path, wanted)
        return rows.tolist() if wanted[-1] <= self._path[-1] and len(set(rows.tolist())) == size else []

    def _unlike(self, a: Sequence[int], b: Sequence[int]) -> float:
        """By how many metres two stretches differ at most, laid on top of each other at their starts."""

        def along(rows: Sequence[int]) -> list[Pose]:
            return [self._poses[rows[0]].between(self._poses[row]) for row in rows]

        return max(self._space.size(m.between(n))[0] for m, n in zip(along(a), along(b), strict=True))

    def _wrong(self, a: int, b: int, z: Pose) -> bool:
        if abs(self._path[a] - self._path[b]) < APART:
            return False
        meters, turned = self._space.size(z.between(self._poses[a].between(self._poses[b])))
        return meters > FARTHER[0] or turned > FARTHER[1]

    def _jittered(self, pose: Pose) -> Pose:
        meters, turned = JITTER
        sigmas = np.sqrt(np.diag(self._space.diagonal(turned**2, meters**2)))
        return pose.compose(self._space.expmap(sigmas * self._draw.normal(size=len(sigmas))))

    def _noisy(self, pose: Pose, like: RelativePose) -> Pose:
        """With an error as the recorded loop states it, so that a group agrees as well as true loops do."""
        covariance = (
            self._space.covariance(like.covariance, pose)
            if like.information is None
            else np.linalg.inv(self._space.information(like.information))
        )
        values, vectors = np.linalg.eigh(covariance)
        sigmas = np.sqrt(np.clip(values, 0.0, 1.0))
        return pose.compose(self._space.expmap(vectors @ (sigmas * self._draw.normal(size=len(sigmas)))))

    def _loop(self, like: RelativePose, a: int, b: int, z: Pose) -> RelativePose:
        """From row a to row b, the later end where the recorded loop has it, between frames of the base."""
        if (like.stamp_i > like.stamp_j) != (a > b):
            a, b, z = b, a, z.inverse()
        i, j = int(self._stamps[a]), int(self._stamps[b])
        seven: Array = frozen(self._space.seven(z))
        return replace(like, stamp=max(i, j), stamp_i=i, stamp_j=j, frame_i="", frame_j="", pose=seven)


class Injected:
    """Inputs with further loops in them, each delivered as soon as both its ends are there."""

    def __init__(self, inputs: Inputs, loops: Sequence[RelativePose]) -> None:
        self._inputs, self._loops = inputs, loops
        self.count = inputs.count + len(loops)
        self.read = 0
        self._given = 0

    @property
    def paths(self) -> Sequence[Path]:
        return self._inputs.paths

    @property
    def damage(self) -> list[str]:
        return self._inputs.damage

    def stream(self, config: Config) -> Stream:
        for item in self._inputs.stream(config):
            if not isinstance(item, Decision) and item.source == config.driver:
                yield from self._due(item)
            self.read = self._inputs.read + self._given
            yield item
        yield from self._due(None)

    def _due(self, item: Measurement | None) -> Iterator[RelativePose]:
        while self._given < len(self._loops):
            loop = self._loops[self._given]
            if item is not None and loop.stamp >= item.stamp:
                return
            self._given += 1
            self.read = self._inputs.read + self._given
            yield loop

    def vertex(self, stamp: int) -> int | None:
        return self._inputs.vertex(stamp)

    def close(self) -> None:
        self._inputs.close()

    def __enter__(self) -> Self:
        self._inputs.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._inputs.__exit__(*error)


def wanted(share: float, offered: int) -> int:
    """How many wrong loops must join `offered` others so that they are that share (0 to below 1) of all."""
    return round(offered * share / (1 - share))
