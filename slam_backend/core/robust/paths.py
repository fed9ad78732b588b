"""What the graph says about the motion between any two of its poses, without asking the solver.

Joint covariances cost 13 ms a pair on a graph of 3,500 poses. Here motion factors make chains, on which the motion between
two poses and its covariance are the difference of two running sums; loops are links between points of chains. The
cheapest way from a to b goes along chains and over links (Dijkstra), priced by its variance. A walk over one way bounds the
covariance from above: what other ways know is left out.
"""

from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..graph import Delta, Factor, Motion, Pose, is_pose
from ..measurement import Array
from ..space import Space
from .usual import Usual

LEVER = 10.0  # m: how a variance of heading (rad^2) is weighed against one of position (m^2) in the price of a way
STEPS = 32  # links from which a search goes on; beyond, the best way found so far is taken
MEMORY = 4096  # ways remembered


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A way from a to b: `a_T_b`, and its covariance at the tangent of b by cause, so that one product moves all of it.

    parts: (3, d, d), of motion as stated; of that what is due to its noise of rotation alone; of the loops on the way.
    meters: of motion. via: ids of the loops, in order.
    """

    pose: Pose
    parts: Array
    meters: float
    via: tuple[str, ...] = ()

    @property
    def odometry(self) -> Array:
        part: Array = self.parts[0]
        return part

    @property
    def rotation(self) -> Array:
        part: Array = self.parts[1]
        return part

    @property
    def loops(self) -> Array:
        part: Array = self.parts[2]
        return part

    def covariance(self, scale: float, rotation: float = 1.0) -> Array:
        """With the odometry's covariance multiplied by `scale`, and its standard deviations of rotation by `rotation` besides."""
        return self.drifted(scale, rotation) + self.loops

    def drifted(self, scale: float, rotation: float = 1.0) -> Array:
        """The part of it that is the odometry's."""
        if rotation == 1.0:
            return scale * self.odometry
        return scale * (self.odometry + (rotation**2 - 1) * self.rotation)

    def then(self, other: "Path") -> "Path":
        adjoint = other.pose.inverse().AdjointMap()
        parts = adjoint @ self.parts @ adjoint.T + other.parts
        return Path(self.pose.compose(other.pose), parts, self.meters + other.meters, self.via + other.via)

    def inverse(self) -> "Path":
        """`b_T_a`, covariances at the tangent of a."""
        adjoint = self.pose.AdjointMap()
        return Path(self.pose.inverse(), adjoint @ self.parts @ adjoint.T, self.meters, self.via[::-1])


class Chain:
    """Poses one after the other along motion factors, in a frame of their own, with running sums."""

    def __init__(self, origin: Pose, nothing: Array) -> None:
        """nothing: parts of a path that does not move."""
        self.poses: list[Pose] = [origin]
        self.parts: list[Array] = [nothing]  # sum over the steps, each carried to the chain's origin
        self.meters = array("d", [0.0])
        self.price = array("d", [0.0])

    def stretch(self, a: int, b: int) -> Path:
        """From row a to row b, forwards or back."""
        back = self.poses[b].inverse()
        first, last = min(a, b), max(a, b)
        adjoint = back.AdjointMap()
        parts = adjoint @ (self.parts[last] - self.parts[first]) @ adjoint.T
        pose = self.poses[a].between(self.poses[b])
        return Path(pose, parts, self.meters[last] - self.meters[first])


class Point(NamedTuple):
    chain: int
    row: int


class Link(NamedTuple):
    """`a_T_b` between points of chains: a loop, or the motion with which a chain branches off another."""

    factor: Factor
    a: int  # keys
    b: int
    path: Path


class Paths:
    """The motion factors and loops that are in the graph, as ways. `scale`: of the odometry's covariance."""

    def __init__(self, space: Space, scale: float, factors: Mapping[str, Factor]) -> None:
        """factors: the solver's store, for who needs more than ways."""
        self.space, self.scale, self.factors = space, scale, factors
        self._turns = np.outer(*(np.diag(space.diagonal(1.0, 0.0)),) * 2)  # picks the block of rotation
        self._weights = np.diag(space.diagonal(LEVER**2, 1.0))
        self._nothing = np.zeros((3, space.dimension, space.dimension))
        self._fresh: list[Factor] = []  # booked, and not yet read
        self._chains: list[Chain] = []
        self._points: dict[int, Point] = {}
        self._links: dict[str, int] = {}  # id -> row below
        self._rows: list[Link | None] = []  # None: removed
        self._sides = Sides()
        self.ended = False  # the input: what is not decided now never will be
        self.entered: list[Factor] = []  # loops, in order, for who follows what changes
        self.left: list[Factor] = []
        self.usual = Usual(space.dimension)  # how large the statistics of accepted loops are
        self._memory: dict[tuple[int, int], Path | None] = {}  # cheapest, until a link enters or leaves

    def book(self, delta: Delta) -> None:
        """What has entered the graph, and what has left it."""
        self._fresh += [factor for factor in delta.add if factor.kind in ("gauge", "motion", "loop")]
        if delta.remove:
            self._read()
            for id_ in delta.remove:
                self._forget(id_)

    @property
    def loops(self) -> Collection[str]:
        """Ids of those in the graph, in the order in which they entered."""
        self._read()
        return self._links.keys()

    def place(self, key: int) -> tuple[int, float]:
        """The chain of a pose, and how many metres of motion lie between there and the chain's origin."""
        self._read()
        point = self._points[key]
        return point.chain, self._chains[point.chain].meters[point.row]

    def along(self, a: int, b: int) -> Path | None:
        """Between two keys by motion alone; None where they lie on different chains."""
        self._read()
        p, q = self._points.get(a), self._points.get(b)
        if p is None or q is None or p.chain != q.chain:
            return None
        return self._chains[p.chain].stretch(p.row, q.row)

    def from_origin(self, key: int) -> tuple[int, Path] | None:
        """The chain on which a key lies, and the motion from the chain's first pose; None for one that no motion reaches."""
        self._read()
        point = self._points.get(key)
        return None if point is None else (point.chain, self._chains[point.chain].stretch(0, point.row))

    def cheapest(self, ends: Sequence[int], without: Collection[str] = ()) -> Path | None:
        """Between two keys by motion and loops; None where nothing connects them. without: ids of loops not to be used."""
        self._read()
        a, b = ends
        if without:
            return self._found(a, b, without)
        if (a, b) not in self._memory:
            if len(self._memory) >= MEMORY:
                self._memory.clear()
            self._memory[a, b] = self._found(a, b, ())
        return self._memory[a, b]

    def _found(self, a: int, b: int, without: Collection[str]) -> Path | None:
        p, q = self._points.get(a), self._points.get(b)
        if p is None or q is None:
            return None
        path: Path | None = None
        here = a
        for side in self._sides.route(*self._priced(p), *self._priced(q), self._closed(without)):
            link = self._rows[side >> 1]
            assert link is not None
            entry, leap = (link.b, link.path.inverse()) if side & 1 else (link.a, link.path)
            path = _joined(path, self.along(here, entry)).then(leap)
            here = link.a if side & 1 else link.b
        last = self.along(here, b)
        return None if last is None else _joined(path, last)

    def path_of(self, factor: Factor) -> Path:
        """A relative measurement as a way of its own."""
        row = self._links.get(factor.id)
        if row is not None and (link := self._rows[row]) is not None and link.factor is factor:
            return link.path
        motion = motion_of(factor)
        parts = self._nothing.copy()
        parts[2] = motion.covariance
        return Path(motion.pose, parts, 0.0, (factor.id,))

    def _priced(self, point: Point) -> tuple[int, float]:
        return point.chain, self._chains[point.chain].price[point.row]

    def _closed(self, without: Collection[str]) -> list[int]:
        return [self._links[id_] for id_ in without if id_ in self._links]

    # -- reading what was booked -----------------------------------------------------------------

    def _read(self) -> None:
        if not self._fresh:
            return
        fresh, self._fresh = self._fresh, []
        for factor in fresh:
            if factor.kind == "motion":
                self._extend(factor)
            elif factor.kind == "loop" and all(map(is_pose, factor.keys)):
                self.entered.append(factor)
                self._connect(Link(factor, factor.keys[0], factor.keys[1], self.path_of(factor)))
            elif factor.kind == "gauge" and factor.keys[0] not in self._points:
                self._begin(factor.keys[0])

    def _begin(self, key: int) -> None:
        self._points[key] = Point(len(self._chains), 0)
        self._chains.append(Chain(self.space.identity, self._nothing))

    def _extend(self, factor: Factor) -> None:
        a, b = (key for key in factor.keys if is_pose(key))
        motion = motion_of(factor)
        if b in self._points:
            a, b, motion = b, a, motion.inverse()
        if a not in self._points:
            self._begin(a)
        point = self._points[a]
        chain = self._chains[point.chain]
        if b in self._points or point.row + 1 < len(chain.poses):  # a second motion, or a branch
            if b not in self._points:
                self._begin(b)
            self._memory.clear()
            path = Path(motion.pose, self._walked(motion), self.space.size(motion.pose)[0])
            self._connect(Link(factor, a, b, path))
            return
        self._points[b] = Point(point.chain, point.row + 1)
        pose = chain.poses[-1].compose(motion.pose)
        adjoint = pose.AdjointMap()
        chain.poses.append(pose)
        chain.parts.append(chain.parts[-1] + adjoint @ self._walked(motion) @ adjoint.T)
        chain.meters.append(chain.meters[-1] + self.space.size(motion.pose)[0])
        chain.price.append(chain.price[-1] + self.scale * float(self._weights @ np.diag(motion.covariance)))

    def _walked(self, motion: Motion) -> Array:
        """Parts of one motion factor."""
        parts = self._nothing.copy()
        parts[0], parts[1] = motion.covariance, motion.covariance * self._turns
        return parts

    def _connect(self, link: Link) -> None:
        p, q = self._points[link.a], self._points[link.b]
        if link.factor.kind == "loop":
            self._links[link.factor.id] = len(self._rows)
        self._rows.append(link)
        price = float(self._weights @ np.diag(link.path.covariance(self.scale)))
        self._sides.add(*self._priced(p), *self._priced(q), price)
        self._memory.clear()

    def _forget(self, id_: str) -> None:
        row = self._links.pop(id_, None)
        if row is not None:
            link = self._rows[row]
            assert link is not None
            self.left.append(link.factor)
            self._rows[row] = None
            self._sides.remove(row)
            self._memory.clear()


class Sides:
    """Both ends of every link in flat arrays, row 2k and 2k + 1 those of link k, so that a search step is a few array operations."""

    def __init__(self) -> None:
        self._count = 0
        self._chain = np.zeros(64, dtype=np.int64)
        self._price = np.zeros(64)  # of the way from the chain's origin
        self._own = np.zeros(64)  # of crossing the link; infinite: removed
        self._chains = 1  # that the links end on, at most

    def add(self, chain_a: int, price_a: float, chain_b: int, price_b: float, own: float) -> None:
        n = self._count
        if n + 2 > len(self._chain):
            self._chain, self._price, self._own = (
                np.concatenate([each, np.zeros_like(each)]) for each in (self._chain, self._price, self._own)
            )
        self._chain[n : n + 2] = chain_a, chain_b
        self._price[n : n + 2] = price_a, price_b
        self._own[n : n + 2] = own
        self._count += 2
        self._chains = max(self._chains, chain_a + 1, chain_b + 1)

    def remove(self, link: int) -> None:
        self._own[2 * link : 2 * link + 2] = np.inf

    def route(
        self, chain_a: int, price_a: float, chain_b: int, price_b: float, closed: Collection[int] = ()
    ) -> list[int]:
        """The sides through which the cheapest way from a to b enters links, in order; none: on foot, or not at all."""
        on_foot = abs(price_a - price_b) if chain_a == chain_b else np.inf
        n = self._count
        if not n:
            return []
        chain, price, own = self._chain[:n], self._price[:n], self._own[:n]
        if closed:
            own = own.copy()
            own[[2 * link + end for link in closed for end in (0, 1)]] = np.inf
        # what it costs to have crossed the link that begins at a side, and to go on to b from its other side
        crossed = self._walk(chain_a, price_a) + own
        to_b = self._walk(chain_b, price_b).reshape(-1, 2)[:, ::-1].ravel()
        whole = crossed + to_b  # of the best way that ends with this link
        before = np.full(n, -1)
        left = crossed.copy()
        best = min(on_foot, float(whole.min()))
        for _ in range(min(STEPS, n)):
            side = int(left.argmin())
            so_far = left[side]
            if not so_far < best:
                break
            left[side] = np.inf
            onward = self._walk(int(chain[side ^ 1]), price[side ^ 1])
            onward += own
            onward += so_far
            better = (onward < crossed).nonzero()[0]
            if len(better):
                onward = onward[better]
                crossed[better] = left[better] = onward
                onward += to_b[better]
                whole[better] = onward
                before[better] = side
                best = min(best, float(onward.min()))
        last = int(whole.argmin())
        if not whole[last] < on_foot:
            return []
        sides: list[int] = []
        while last >= 0:
            sides.append(last)
            last = int(before[last])
        return sides[::-1]

    def _walk(self, chain: int, price: float) -> Array:
        """On foot from a point of a chain to every side."""
        found = self._price[: self._count] - price
        np.abs(found, out=found)
        if chain or self._chains > 1:
            found[self._chain[: self._count] != chain] = np.inf
        return found


def _joined(path: Path | None, further: Path | None) -> Path:
    assert further is not None
    return further if path is None else path.then(further)


def motion_of(factor: Factor) -> Motion:
    """What a between factor measured, with the covariance of the noise inside a robust kernel."""
    if factor.motion is not None:
        return factor.motion
    noise = factor.factor.noiseModel()
    inner = noise.noise() if hasattr(noise, "noise") else noise
    return Motion(factor.factor.measured(), np.asarray(inner.covariance()))
