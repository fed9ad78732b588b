"""Simulated worlds: where the robot truly goes, and where the landmarks truly are."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numpy as np
from numpy.random import Generator

from ..core.measurement import Array

STEP = 0.5  # m between two poses
RADIUS = 2.0  # m, of every turn of a planar robot
BLOCK, BLOCKS = 10.0, 8  # m; blocks along each side of the city
AISLE, AISLES = 30.0, 6  # m; aisles of the warehouse, 2 RADIUS apart
HELIX_RADIUS, HELIX_RISE = 10.0, 1.0  # m; m per turn

Segment = tuple[float, float]  # m of path, radians turned on it
Extrinsics = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A world without noise.

    path: (poses, generator) -> (poses - 1, 6) steps, each the tangent w, v of one pose in the one before.
    place: (truth (N, 4, 4), count, generator) -> (count, 3) landmarks in the world, whose origin is the first pose.
    """

    description: str
    space: Literal["2d", "3d"]
    path: Callable[[int, Generator], Array]
    place: Callable[[Array, int, Generator], Array]
    landmarks: int = 0
    camera: Extrinsics | None = None  # None: landmarks are seen all around, from the base
    eye: Extrinsics | None = None  # of a camera that tracks features, its z ahead; None: there is none


def exp_of(tangents: Array) -> Array:
    """(..., 6) rotation w and translation v, in GTSAM's order, to (..., 4, 4): the exponential of SE(3)."""
    w, v = tangents[..., :3], tangents[..., 3:]
    square = (w * w).sum(axis=-1)[..., None, None]
    angle = np.sqrt(square)
    small = angle < 1e-4  # there the series are exact to double precision
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    cross = np.zeros((*w.shape[:-1], 3, 3))
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    cross = cross - np.swapaxes(cross, -1, -2)
    twice = cross @ cross
    pose = np.zeros((*w.shape[:-1], 4, 4))
    pose[..., :3, :3] = np.eye(3) + a * cross + b * twice
    pose[..., :3, 3] = ((np.eye(3) + b * cross + c * twice) @ v[..., None])[..., 0]
    pose[..., 3, 3] = 1
    return pose


def chain(steps: Array) -> Array:
    """(N - 1, 4, 4) steps to the (N, 4, 4) poses that they lead to from the origin."""
    poses = np.empty((len(steps) + 1, 4, 4))
    poses[0] = np.eye(4)
    for k, step in enumerate(steps):
        np.matmul(poses[k], step, out=poses[k + 1])
    return poses


def _planar(drive: Callable[[Generator], Iterator[Segment]]) -> Callable[[int, Generator], Array]:
    """Endless segments, each cut into equal steps of about STEP so that closed routes close exactly."""

    def path(poses: int, rng: Generator) -> Array:
        def steps() -> Iterator[Segment]:
            for length, angle in drive(rng):
                count = max(1, round(length / STEP))
                yield from [(length / count, angle / count)] * count

        tangents = np.zeros((poses - 1, 6))
        tangents[:, [3, 2]] = list(islice(steps(), poses - 1))
        return tangents

    return path


def _square(_: Generator) -> Iterator[Segment]:
    while True:
        yield from [(20 - 2 * RADIUS, 0.0), _turn(1)]


def _corridor(_: Generator) -> Iterator[Segment]:
    while True:
        yield STEP, 0.0


def _city(rng: Generator) -> Iterator[Segment]:
    """Along the streets of a square grid, left, right or straight on at every crossing, never back."""
    headings = ((1, 0), (0, 1), (-1, 0), (0, -1))
    x = y = BLOCKS // 2
    heading = 0
    while True:
        yield BLOCK - 2 * RADIUS, 0.0
        x, y = x + headings[heading][0], y + headings[heading][1]
        ways = [(turn, headings[(heading + turn) % 4]) for turn in (-1, 0, 1)]
        open_ways = [turn for turn, (dx, dy) in ways if 0 <= x + dx <= BLOCKS and 0 <= y + dy <= BLOCKS]
        turn = open_ways[rng.integers(len(open_ways))]
        heading = (heading + turn) % 4
        yield _turn(turn) if turn else (2 * RADIUS, 0.0)


def _lawnmower(_: Generator) -> Iterator[Segment]:
    """Lanes of 40 m, 2 RADIUS apart."""
    while True:
        for side in (1, -1):
            yield from [(40.0, 0.0), _turn(2 * side)]


def _warehouse(_: Generator) -> Iterator[Segment]:
    """Up and down the aisles, back to the start along their ends, and again."""
    while True:
        for aisle in range(AISLES - 1):
            yield from [(AISLE, 0.0), _turn(2 if aisle % 2 == 0 else -2)]
        across = 2 * RADIUS * (AISLES - 1) - 2 * RADIUS
        yield from [(AISLE, 0.0), _turn(1), (across, 0.0), _turn(1)]


def _turn(quarters: int) -> Segment:
    return abs(quarters) * np.pi / 2 * RADIUS, quarters * np.pi / 2


def _spiral(poses: int, _: Generator) -> Array:
    """A helix is the orbit of one screw: the same step again and again. x looks ahead along the climb."""
    around = 2 * np.pi * HELIX_RADIUS
    length = np.hypot(around, HELIX_RISE)
    turn = 2 * np.pi * STEP / length
    tangent = (turn * HELIX_RISE / length, 0.0, turn * around / length, STEP, 0.0, 0.0)
    return np.tile(np.array(tangent), (poses - 1, 1))


def _scattered(truth: Array, count: int, rng: Generator) -> Array:
    """Evenly over the box of the path and 5 m around it; on the ground where the path is flat."""
    margin = np.array([5.0, 5.0, 5.0 if np.ptp(truth[:, 2, 3]) > 0 else 0.0])
    low, high = truth[:, :3, 3].min(axis=0) - margin, truth[:, :3, 3].max(axis=0) + margin
    return np.asarray(rng.uniform(low, high, (count, 3)))


def _on_racks(_: Array, count: int, __: Generator) -> Array:
    """Tags 1 m above the ground, on the racks left and right of every aisle."""
    racks = AISLES + 1
    n = np.arange(count)
    along = -1 + (AISLE + 2) * (n // racks) / max(1, (count - 1) // racks)
    across = 2 * RADIUS * (n % racks) - RADIUS
    return np.stack([along, across, np.ones(count)], axis=1)


SCENARIOS: Mapping[str, Scenario] = {
    "square": Scenario("round a block of 20 m, again and again", "2d", _planar(_square), _scattered),
    "corridor": Scenario(
        "straight ahead: nothing is ever seen twice", "2d", _planar(_corridor), _scattered
    ),
    "city": Scenario(
        "random turns in a Manhattan grid of 8 x 8 blocks of 10 m; loops where it returns",
        "2d", _planar(_city), _scattered,
    ),
    "spiral": Scenario(
        "a helix in 3-D, 20 m across, rising 1 m a turn; loops to the turn below", "3d", _spiral, _scattered
    ),
    "flight": Scenario(
        "the same helix, past features that a camera tracks which looks ahead", "3d", _spiral, _scattered,
        eye=(0.1, 0.0, 0.0, -np.pi / 2, 0.0, -np.pi / 2),
    ),
    "lawnmower": Scenario(
        "lanes of 40 m, 4 m apart, among 200 landmarks; no loops", "2d", _planar(_lawnmower), _scattered, 200
    ),
    "warehouse": Scenario(
        "six aisles of 30 m, again and again, past 70 tags seen by a camera that looks ahead",
        "2d", _planar(_warehouse), _on_racks, 70, (0.3, 0.0, 0.5, 0.0, 0.0, 0.1),
    ),
}  # fmt: skip
