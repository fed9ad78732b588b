"""A drive twice around a block, true loops from round to round, and wrong ones; on data that is always there."""

from dataclasses import dataclass

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.space import SPACES

ROUND = 60  # keyframes
SIGMA = 0.02
FIRST = 1000  # s: stamp of keyframe 0


def vertex(stamp: int) -> int:
    return stamp // SECOND - FIRST


@dataclass
class Ended:
    """What a run over a drive ended with."""

    backend: Backend
    decisions: list[Decision]

    @property
    def kept(self) -> set[tuple[int, int]]:
        """Ends (keyframes) of the loops in the graph."""
        loops = [f for f in self.backend.solver.factors.values() if f.kind == "loop"]
        return {tuple(map(vertex, loop.stamps)) for loop in loops}

    @property
    def last(self) -> dict[tuple[int, int], Decision]:
        """The last decision about each loop."""
        return {tuple(map(vertex, d.ends)): d for d in self.decisions if d.ends}


class Drive:
    """Edges between keyframes, one a second; the first edge to a keyframe is its motion."""

    def __init__(self, dimension: str, odometry: float = 1.0, seed: int = 1) -> None:
        """odometry: how much larger its errors are than stated."""
        self.space = SPACES[dimension]
        self._rng = np.random.default_rng(seed)
        step = self.space.from_extrinsics((1.0, 0.0, 0.0, 0.0, 0.0, 2 * np.pi / ROUND))
        self.truth = [self.space.identity]
        for _ in range(2 * ROUND):
            self.truth.append(self.truth[-1].compose(step))
        self.motion = [self._edge(k, k + 1, self._noisy(step, odometry)) for k in range(2 * ROUND)]

    def true(self, first: int, count: int, every: int = 3) -> list[RelativePose]:
        pairs = [(k + ROUND, k) for k in range(first, first + every * count, every)]
        return [self._edge(i, j, self._noisy(self.truth[i].between(self.truth[j]))) for i, j in pairs]

    def wrong(self, *pairs: tuple[int, int]) -> list[RelativePose]:
        """Each says that its two keyframes are at the same place, more or less, and differently each."""
        return [
            self._edge(i, j, self.space.expmap(self._rng.normal(0, 0.5, self.space.dimension)))
            for i, j in pairs
        ]

    def backend(self, **settings: object) -> Backend:
        config = {
            "space": self.space.name,
            "sources": ["edges"],
            "edges": {"kind": "relative"},
            "gate": {"odometry_scale": 3.0},  # the noise is as stated
            **settings,
        }
        return Backend(config_from(config))

    def run(self, loops: list[RelativePose], **settings: object) -> Ended:
        edges = sorted([*self.motion, *loops], key=lambda e: (e.stamp, abs(e.stamp_i - e.stamp_j) > SECOND))
        backend = self.backend(**settings)
        updates = [update for edge in edges for update in backend.add(edge)] + backend.finish()
        return Ended(backend, [d for update in updates for d in update.decisions])

    def _noisy(self, pose: object, scale: float = 1.0) -> object:
        return pose.compose(self.space.expmap(self._rng.normal(0, scale * SIGMA, self.space.dimension)))

    def _edge(self, i: int, j: int, pose: object) -> RelativePose:
        information = frozen(np.eye(self.space.dimension) / SIGMA**2)
        stamps = (FIRST + i) * SECOND, (FIRST + j) * SECOND
        seven, unstated = frozen(self.space.seven(pose)), frozen(np.zeros(36))
        return RelativePose(max(stamps), "edges", *stamps, "", "", seven, unstated, information)


def vertices(loop: RelativePose | Decision) -> tuple[int, ...]:
    """Its two keyframes."""
    return tuple(map(vertex, loop.ends or ()))


def ends(loops: list[RelativePose]) -> set[tuple[int, int]]:
    return {vertices(loop) for loop in loops}


@pytest.fixture(params=["2d", "3d"])
def drive(request) -> Drive:
    return Drive(request.param)
