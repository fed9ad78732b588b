"""Pose graphs of which it is known which loops are wrong: real ones, masked ones, and public graphs with wrong ones added."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import module_from_spec, spec_from_file_location
from math import radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bench.simulated import ate
from slam_backend.core.geometry import inverse_of, matrix_of, quaternion_of, seven_of_matrix
from slam_backend.core.measurement import frozen
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.descent import Options
from slam_backend.core.solvers.initialize import initialize
from slam_backend.core.space import SPACES
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.formats import read_graph
from slam_backend.io.formats.posegraph import Edges, PoseGraph, measurements, states_of
from slam_backend.io.problem import Problem, odometry_edges, problem_of
from slam_backend.lab.tally import Label
from slam_backend.lab.wrong import Wrongs, wanted

DATA = Path(__file__).parents[1] / "../shared/data"
VO = DATA / "kitti_vo_loops"
NEAR = (10.0, radians(20))  # m, rad: a loop that is off by more than either is wrong
GRAPHS = {  # file, and how many of its last edges are wrong loops of its own, which are left out
    "intel": ("pgo_sesync/intel.g2o", 0),
    "M3500": ("pgo_carlone2d/M3500.g2o", 0),
    "ring": ("pgo_vertigo/ring/originalDataset/ring.g2o", 0),
    "newcollege": ("pgo_vertigo/newcollege/newcollege_short.g2o", 3),
}
Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]


@dataclass(frozen=True)
class Case:
    """graph: with all its loops. true, wrong: (M,) of its edges, loops that are; some are neither. truth: of the vertices."""

    name: str
    graph: PoseGraph
    true: Mask
    wrong: Mask
    truth: Trajectory

    @cached_property
    def clean(self) -> PoseGraph:
        """Exactly the true loops."""
        return replace(self.graph, edges=_only(self.graph.edges, ~self.loops | self.true))

    @cached_property
    def bare(self) -> PoseGraph:
        """Odometry alone."""
        return replace(self.graph, edges=_only(self.graph.edges, ~self.loops))

    @cached_property
    def honest(self) -> "Case":
        """With exactly the true loops."""
        kept = ~self.loops | self.true
        return Case(self.name, self.clean, self.true[kept], self.wrong[kept], self.truth)

    @cached_property
    def loops(self) -> Mask:
        return loops_of(self.graph)

    @cached_property
    def labels(self) -> dict[frozenset[int], Label]:
        """By the two stamps of a loop."""
        stamps, edges = self.graph.stamps_at(), self.graph.edges
        found: dict[frozenset[int], Label] = {}
        for n in np.flatnonzero(self.loops).tolist():
            ends = frozenset((int(stamps[edges.i[n]]), int(stamps[edges.j[n]])))
            found[ends] = "true" if self.true[n] else "wrong" if self.wrong[n] else "neither"
        return found

    def label(self, ends: tuple[int, int]) -> Label:
        return self.labels[frozenset(ends)]

    @property
    def counted(self) -> str:
        return f"{self.true.sum()} true, {self.wrong.sum()} wrong"

    def ate(self, trajectory: Trajectory) -> float:
        return ate(trajectory, self.truth)

    @cached_property
    def ate_clean(self) -> float:
        """Of the optimum with exactly the true loops."""
        return self.ate(_optimum(problem_of(self.clean)))

    @cached_property
    def ate_odometry(self) -> float:
        return self.ate(_optimum(problem_of(self.bare)))


def vo_loops(
    sequences: tuple[str, ...] = ("00", "05", "07"),
    alphas: tuple[str, ...] = ("0.05", "0.15", "0.40"),
    seeds: tuple[int | None, ...] = (None, 1, 2, 3),
) -> Iterator[Case]:
    """Real visual odometry with real bag-of-words loops; seed None: as the files are, else masked with that seed."""
    for sequence in sequences:
        for alpha in alphas:
            path = VO / sequence / f"kitti_{sequence}_alpha_{alpha}.g2o"
            if path.is_file():
                truth = _chained(read_graph(path.parent / f"kitti_{sequence}_GT.g2o"))
                for seed in seeds:
                    yield _vo_case(f"KITTI {sequence}, alpha {alpha}", path, truth, seed)


def _vo_case(name: str, path: Path, truth: Trajectory, seed: int | None) -> Case:
    """True is what the set names so; a masked loop that happens to fall near the truth is neither."""
    graph = read_graph(path) if seed is None else _masked(path, seed)
    named = {
        tuple(map(int, line.split()))
        for line in path.with_name(f"{path.stem}_GT_LC.txt").open()
        if line.strip()
    }
    edges = graph.edges
    true = np.array([pair in named for pair in zip(edges.i.tolist(), edges.j.tolist(), strict=True)])
    wrong = disagree(truth, edges, NEAR) & loops_of(graph) & ~true
    return Case(f"{name}, {'raw' if seed is None else f'masked {seed}'}", graph, true, wrong, truth)


def _masked(path: Path, seed: int) -> PoseGraph:
    """A copy that does not leak which loops are wrong, by the script that lies beside the data."""
    spec = spec_from_file_location("mask", VO / "mask.py")
    assert spec is not None
    assert spec.loader is not None
    module: Any = module_from_spec(spec)
    spec.loader.exec_module(module)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        module.mask(str(path), str(copy), seed)
        return read_graph(copy)


def injected(name: str, share: float, size: int = 1, seed: int = 1) -> Case | None:
    """A public graph with wrong loops that are `share` of all, in groups of `size`; None without the data.

    truth: the optimum of the graph as it is.
    """
    file, last = GRAPHS[name]
    path = DATA / file
    if not path.is_file():
        return None
    whole = read_graph(path)
    graph = replace(whole, edges=_only(whole.edges, np.arange(len(whole.edges)) < len(whole.edges) - last))
    truth, recorded = _optimum(problem_of(graph)), _recorded(graph, loops_of(graph))
    made = Wrongs(truth, recorded, SPACES[graph.space], seed).loops(wanted(share, len(recorded)), size)
    kind = "" if size == 1 else f" in groups of {size}"
    return _added(f"{name}, {share:.0%} wrong{kind}", graph, made, truth)


def aliased(
    sequence: str, groups: int, size: int, seed: int = 1
) -> tuple[Case, list[list[RelativePose]]] | None:
    """Real visual odometry and its true loops, with groups of wrong ones that agree with each other; None without the data."""
    case = next(vo_loops((sequence,), ("0.15",), (None,)), None)
    if case is None:
        return None
    graph = case.clean
    true = loops_of(graph)
    wrongs = Wrongs(case.truth, _recorded(graph, true), SPACES[graph.space], seed)
    made = [wrongs.loops(size, size) for _ in range(groups)]
    every = [loop for group in made for loop in group]
    return _added(f"KITTI {sequence}, {groups} groups of {size}", graph, every, case.truth), made


def _recorded(graph: PoseGraph, true: Mask) -> list[RelativePose]:
    """Those edges as the measurements that they are."""
    stamps, edges = graph.stamps_at(), graph.edges
    ends = {(int(stamps[i]), int(stamps[j])) for i, j in zip(edges.i[true], edges.j[true], strict=True)}
    return [each for each in measurements(graph) if isinstance(each, RelativePose) and each.ends in ends]


def _added(name: str, graph: PoseGraph, made: list[RelativePose], truth: Trajectory) -> Case:
    """A case of a graph whose loops are true, and of wrong ones after them."""
    true, more = loops_of(graph), np.zeros(len(made), dtype=np.bool_)
    wrong = np.concatenate([np.zeros_like(true), ~more])
    return Case(name, replace(graph, edges=_with(graph, made)), np.concatenate([true, more]), wrong, truth)


def loops_of(graph: PoseGraph) -> Mask:
    """(M,) which edges are not odometry; of several between the same two vertices only the first can be."""
    odometry, i, j = odometry_edges(graph), graph.edges.i.tolist(), graph.edges.j.tolist()
    return np.array([(min(pair), max(pair)) not in odometry for pair in zip(i, j, strict=True)])


def disagree(truth: Trajectory, edges: Edges, near: tuple[float, float]) -> Mask:
    """(M,) which edges are off by more than `near` (m, rad)."""
    poses = matrix_of(truth.sevens)
    off = inverse_of(inverse_of(poses[edges.i]) @ poses[edges.j]) @ matrix_of(edges.poses)
    meters = np.linalg.norm(off[:, :3, 3], axis=1)
    turned = 2 * np.arcsin(np.clip(np.linalg.norm(quaternion_of(off[:, :3, :3])[:, :3], axis=1), 0, 1))
    return np.asarray((meters > near[0]) | (turned > near[1]))


def _only(edges: Edges, which: Mask) -> Edges:
    return Edges(edges.i[which], edges.j[which], edges.states[which], edges.information[which])


def _with(graph: PoseGraph, loops: list[RelativePose]) -> Edges:
    """The edges of a graph and further ones after them."""
    edges, stamps = graph.edges, graph.stamps_at()
    ends = np.array([loop.ends for loop in loops], dtype=np.int64).reshape(-1, 2)
    i, j = (np.searchsorted(stamps, ends[:, k]) for k in (0, 1))
    sevens = np.array([loop.pose for loop in loops]).reshape(-1, 7)
    information = np.array([loop.information for loop in loops]).reshape(-1, *edges.information.shape[1:])
    return Edges(
        np.concatenate([edges.i, i]), np.concatenate([edges.j, j]),
        frozen(np.concatenate([edges.states, states_of(graph.space, sevens)])),
        frozen(np.concatenate([edges.information, information])),
    )  # fmt: skip


def _chained(graph: PoseGraph) -> Trajectory:
    """Where a graph's odometry leads from the origin."""
    poses = [np.eye(4)]
    for step in matrix_of(graph.edges.poses):
        poses.append(poses[-1] @ step)
    return Trajectory(graph.stamps_at(), seven_of_matrix(np.array(poses)))


def _optimum(problem: Problem) -> Trajectory:
    start = initialize(problem.factors, problem.stated)
    solved = problem.solved(solve(problem.factors, start, Options(polish=True)).values)
    assert solved.poses is not None
    return Trajectory(solved.stamps_at(), solved.poses)
