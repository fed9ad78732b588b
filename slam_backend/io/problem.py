"""A pose graph file as a problem for the solvers: the factors that `replay` would make of it, and the values it states.

The measurements are those of a replay, through the same firewall and the same sensors. Only the keyframes are known
beforehand: the vertex of rank r is X(r), the landmark of rank l is L(l).
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from ..core.check import checked
from ..core.config import Config, KernelName, config_from
from ..core.context import Context
from ..core.graph import (
    Decision,
    Delta,
    Factor,
    Motion,
    Offer,
    Pose,
    identify,
    is_pose,
    keyframe,
    landmark_key,
)
from ..core.keyframes import Placed
from ..core.measurement import Measurement, frozen
from ..core.mounts import Mounts
from ..core.sensors import SENSORS
from ..core.space import SPACES, Space
from .formats.posegraph import PERIOD, PoseGraph, measurements, name_of
from .inputs import EDGES, LANDMARKS

LOOPS = "loops"  # the source of edges that are not odometry, apart because a robust kernel is meant for them alone


@dataclass(frozen=True, eq=False)
class Problem:
    """factors: `motion` between consecutive vertices, `loop`, `landmark`, `range` (between vertices), `pose` (priors) and `gauge`
    (vertices held).

    stated: vertices and landmarks where the file states them. decisions: what the firewall or a sensor refused, and why.
    left_out: what no solver here takes, in words.
    """

    graph: PoseGraph
    space: Space
    factors: tuple[Factor, ...]
    stated: gtsam.Values
    decisions: tuple[Decision, ...]
    left_out: tuple[str, ...]

    def name(self, key: int) -> str:
        """A variable by its id in the file."""
        rank = gtsam.Symbol(key).index()
        if is_pose(key):
            return name_of(int(self.graph.ids[rank]))
        return f"landmark {name_of(int(self.graph.landmarks[rank]))}"

    def solved(self, values: gtsam.Values) -> PoseGraph:
        """The graph with everything where the values have it; a vertex without a value is at the origin."""
        numbers = self.space.numbers if self.space.name == "2d" else self.space.seven
        vertices = [keyframe(rank, 0).pose for rank in range(len(self.graph.ids))]
        poses = [
            self.space.pose_in(values, key) if values.exists(key) else self.space.identity for key in vertices
        ]
        positions = self.graph.positions.copy()
        for rank in range(len(positions)):
            if values.exists(key := landmark_key(rank)):
                positions[rank] = self.space.point_in(values, key)
        states = np.array([numbers(pose) for pose in poses])
        return replace(self.graph, states=frozen(states), positions=frozen(positions))


def problem_of(graph: PoseGraph, kernel: KernelName = "none") -> Problem:
    """kernel: around the noise of every edge that is not odometry."""
    config = config_of(graph, kernel)
    space = SPACES[graph.space]
    context = _context(graph, space)
    delta = Delta()
    windows: dict[str, list[Offer]] = defaultdict(list)
    decisions: list[Decision] = []
    counts: dict[tuple[str, int], int] = defaultdict(int)
    odometry = odometry_edges(graph)
    for item in checked(stream(graph, odometry, apart=True), config):
        if isinstance(item, Decision):
            decisions.append(item)
            continue
        n = counts[item.source, item.stamp]
        counts[item.source, item.stamp] = n + 1
        windows[item.source].append(Offer(identify(item, n), item, motion=item.source == EDGES))
    for name, window in windows.items():
        source = config.sources[name]
        delta += SENSORS[source.kind].factors(window, None, keyframe(0, 0), context, source)
    beacons = len(graph.landmark_priors)
    left = (f"{beacons} priors of landmarks",) if beacons else ()
    beside = (*_ranges(graph, space), *_priors(graph, space), *_held(graph, space))
    return Problem(
        graph, space, (*delta.add, *beside), _stated(graph, space), (*decisions, *delta.decisions), left
    )


def config_of(graph: PoseGraph, kernel: KernelName = "none") -> Config:
    """The configuration with which `stream(..., apart=True)` can be replayed; a graph file is believed as it is."""
    sources = {EDGES: {"kind": "relative"}, LOOPS: {"kind": "relative", "kernel": kernel}}
    if graph.sees_landmarks:
        sources[LANDMARKS] = {"kind": "landmark"}
    return config_from({"space": graph.space, "robust": [], "sources": list(sources), **sources})


def odometry_edges(graph: PoseGraph) -> set[tuple[int, int]]:
    """(lower, higher) ranks of the edges that count as odometry: between consecutive vertices of one robot.

    A vertex that has no such edge back, and is not a robot's first, hangs on its first edge to an older one.
    """
    i, j = np.minimum(graph.edges.i, graph.edges.j), np.maximum(graph.edges.i, graph.edges.j)
    robot = graph.ids >> np.uint64(56)
    consecutive = (j - i == 1) & (robot[i] == robot[j])
    found = set(zip(i[consecutive].tolist(), j[consecutive].tolist(), strict=True))
    hanging = {higher for _, higher in found} | set(np.unique(robot, return_index=True)[1].tolist())
    for lower, higher in sorted(zip(i.tolist(), j.tolist(), strict=True), key=lambda ends: ends[1]):
        if higher not in hanging:
            hanging.add(higher)
            found.add((lower, higher))
    return found


def stream(graph: PoseGraph, odometry: set[tuple[int, int]], apart: bool) -> Iterator[Measurement]:
    """The graph as if live; apart: edges that are not odometry come from a source of their own."""
    for measurement in measurements(graph, EDGES, LANDMARKS):
        if apart and measurement.ends and _ranks(measurement.ends) not in odometry:
            yield replace(measurement, source=LOOPS)
        else:
            yield measurement


def _ranks(stamps: tuple[int, int]) -> tuple[int, int]:
    first, second = (stamp // PERIOD - 1 for stamp in stamps)
    return (first, second) if first < second else (second, first)


def _context(graph: PoseGraph, space: Space) -> Context:
    """Every vertex is a keyframe, every landmark is known and in one part with everything."""
    placed = {
        stamp: Placed(keyframe(rank, stamp), None) for rank, stamp in enumerate(graph.stamps_at().tolist())
    }
    ranks = {name_of(identifier): rank for rank, identifier in enumerate(graph.landmarks.tolist())}
    still = Motion(space.identity, np.zeros((space.dimension,) * 2))
    return Context(
        space, None, {}, Mounts(space, "", {}), placed.get, lambda _, __: still,
        lambda name: landmark_key(ranks[name]), lambda _: 0,
    )  # fmt: skip


def _ranges(graph: PoseGraph, space: Space) -> Iterator[Factor]:
    """Between vertices; those to landmarks come by way of their sensor."""
    ranges = graph.ranges
    for n in np.flatnonzero(~ranges.to_landmark).tolist():
        keys = keyframe(int(ranges.i[n]), 0).pose, keyframe(int(ranges.j[n]), 0).pose
        noise = gtsam.noiseModel.Isotropic.Variance(1, float(ranges.variances[n]))
        yield Factor(f"ranges/{n}", "range", space.distance(*keys, float(ranges.ranges[n]), noise), keys, 0)


def _priors(graph: PoseGraph, space: Space) -> Iterator[Factor]:
    for n, (rank, state, information) in enumerate(
        zip(graph.priors.i.tolist(), graph.priors.states.tolist(), graph.priors.information, strict=True)
    ):
        key = keyframe(rank, 0).pose
        noise = gtsam.noiseModel.Gaussian.Information(space.information(information))
        yield Factor(f"priors/{n}", "pose", space.prior(key, _pose(space, state), noise), (key,), 0)


def _held(graph: PoseGraph, space: Space) -> Iterator[Factor]:
    """FIX lines: the vertex does not move at all."""
    if graph.states is None:
        return
    for rank in graph.fixed.tolist():
        key = keyframe(rank, 0).pose
        prior = space.prior(
            key, _pose(space, graph.states[rank].tolist()), gtsam.noiseModel.Constrained.All(space.dimension)
        )
        yield Factor(f"fix/{rank}", "gauge", prior, (key,), 0)


def _stated(graph: PoseGraph, space: Space) -> gtsam.Values:
    values = gtsam.Values()
    for rank, state in enumerate(() if graph.states is None else graph.states.tolist()):
        values.insert(keyframe(rank, 0).pose, _pose(space, state))
    for rank, position in enumerate(graph.positions):
        if np.isfinite(position).all():
            values.insert(landmark_key(rank), position)
    return values


def _pose(space: Space, state: Sequence[float]) -> Pose:
    return space.pose_of_numbers(state) if space.name == "2d" else space.pose(state)
