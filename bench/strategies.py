"""What judges wrong loops: our stages as configured, and what one would write with gtsam alone."""

from collections.abc import Callable
from dataclasses import dataclass
from math import nan
from time import perf_counter, process_time
from typing import Any, NamedTuple

import gtsam
import numpy as np

from bench.loops import Case
from bench.overhead import bare_loop
from slam_backend.core.backend import Backend
from slam_backend.core.config import Config, KernelName, config_from
from slam_backend.core.graph import Decision, Delta, Estimate, Factor
from slam_backend.core.robust import ROBUST, Judged, Robust
from slam_backend.core.solvers.gauges import gauges, layout
from slam_backend.core.solvers.initialize import initialize
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.formats.posegraph import measurements
from slam_backend.io.problem import Problem, problem_of
from slam_backend.lab.tally import Tally

KEPT = 0.5  # weight of a loop from which a kernel has kept it


@dataclass(frozen=True)
class Found:
    """What a strategy did to a case. wrong: kept at the end; ever: kept at some moment (nan: not followed).

    prompt: share of the kept true loops that entered at arrival; slowest: keyframes of the slowest; unseen: share of the true loops
    of which it is said at the end that they have no witness. p50, p99: of a verdict, ms.
    """

    precision: float
    recall: float
    wrong: int
    ever: float
    prompt: float
    slowest: float
    ate: float
    seconds: float
    p50: float = nan
    p99: float = nan
    unseen: float = nan


class Timed:
    """A stage with a watch."""

    def __init__(self, stage: Robust, watch: list[float]) -> None:
        self._stage, self._watch = stage, watch
        self.kinds = stage.kinds

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:
        begin = perf_counter()
        try:
            return self._stage.admit(proposed, estimate)
        finally:
            self._watch.append(perf_counter() - begin)

    def review(self, estimate: Estimate) -> Judged:
        begin = perf_counter()
        try:
            return self._stage.review(estimate)
        finally:
            self._watch.append(perf_counter() - begin)


class Played(NamedTuple):
    """A run over a case as if live. seconds: CPU without reading and without the last polish. latencies: of verdicts, ms."""

    backend: Backend
    tally: Tally
    seconds: float
    latencies: list[float]


def played(case: Case, settings: dict[str, Any]) -> Played:
    """As `replay` does it."""
    sources = {"sources": ["edges"], "edges": {"kind": "relative"}}
    backend = Backend(config_from({"space": case.graph.space, **sources, **settings}))
    run = Played(backend, Tally(case.label), 0.0, [])
    watch: list[float] = []
    backend.jury.stages = [Timed(stage, watch) for stage in backend.jury.stages]
    seconds = 0.0
    for each in [*measurements(case.graph), None]:
        watch.clear()
        begin = process_time()
        updates = backend.finish() if each is None else backend.add(each)
        seconds += process_time() - begin
        for update in updates:
            run.tally.take(update.decisions, len(backend.timeline))
        if any(decision.ends for update in updates for decision in update.decisions):
            run.latencies.append(sum(watch) * 1e3)
    return run._replace(seconds=seconds)


def ours(case: Case, settings: dict[str, Any]) -> Found:
    backend, tally, seconds, latencies = played(case, settings)
    backend.polish()
    delays = tally.delays
    return Found(
        tally.precision, tally.recall, tally.wrong_kept, tally.wrong_ever,
        float((delays == 0).mean()) if len(delays) else nan, float(delays.max(initial=0)),
        case.ate(backend.snapshot().trajectory), seconds, *np.percentile(latencies or [nan], (50, 99)).tolist(),
        float(np.mean([loop.rule == "witness/no_witness" for loop in tally.loops.values() if loop.label == "true"] or [nan])),
    )  # fmt: skip


def bare_online(kernel: KernelName) -> Callable[[Case], Found]:
    """The loop over gtsam.ISAM2 that one would write, with a robust noise model around each loop."""

    def run(case: Case) -> Found:
        problem = problem_of(case.graph, kernel)
        batches: dict[int, list[Any]] = {}
        for factor in sorted(problem.factors, key=lambda f: (max(f.keys), f.kind != "motion", -min(f.keys))):
            batches.setdefault(max(factor.keys), []).append(factor.factor)
        spatial = problem.space.name == "3d"
        begin = process_time()
        try:
            isam = bare_loop(batches, spatial, qr=False)
        except RuntimeError:  # as on other public graphs: with QR from the start
            begin = process_time()
            isam = bare_loop(batches, spatial, qr=True)
        seconds = process_time() - begin
        return _weighed(case, problem, isam.calculateBestEstimate(), seconds)

    return run


def _weighed(case: Case, problem: Problem, values: gtsam.Values, seconds: float) -> Found:
    weights = {f.id: _weight(f, values) for f in problem.factors if f.kind == "loop"}
    return _judged(case, problem, values, {id_ for id_, weight in weights.items() if weight >= KEPT}, seconds)


def _weight(factor: Factor, values: gtsam.Values) -> float:
    noise = factor.factor.noiseModel()
    return float(
        noise.robust().weight(np.linalg.norm(noise.noise().whiten(factor.factor.unwhitenedError(values))))
    )


def bare_gnc(case: Case) -> Found:
    """gtsam.GncLMOptimizer on the whole graph, from odometry, odometry known to be right, otherwise as it comes."""
    problem = problem_of(case.graph)
    start = initialize(problem.factors, problem.stated, "odometry").values
    held = gauges(problem.factors, layout(problem.factors, start), start, problem.space)
    factors = [*problem.factors, *held]
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor.factor)
    begin = process_time()
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([n for n, factor in enumerate(factors) if factor.kind != "loop"])
    judge = gtsam.GncLMOptimizer(graph, start, params)
    values = judge.optimize()
    seconds = process_time() - begin
    weights = judge.getWeights()
    kept = {
        factor.id
        for factor, weight in zip(factors, weights, strict=True)
        if factor.kind == "loop" and weight >= KEPT
    }
    return _judged(case, problem, values, kept, seconds)


def _judged(case: Case, problem: Problem, values: gtsam.Values, kept: set[str], seconds: float) -> Found:
    tally = Tally(case.label)
    loops = [factor for factor in problem.factors if factor.kind == "loop" and factor.stamps]
    tally.take((_told(factor, factor.id in kept) for factor in loops), 0)
    solved = problem.solved(values)
    assert solved.poses is not None
    trajectory = Trajectory(solved.stamps_at(), solved.poses)
    return Found(
        tally.precision, tally.recall, tally.wrong_kept, nan, nan, nan, case.ate(trajectory), seconds
    )  # fmt: skip


def _told(factor: Factor, kept: bool) -> Decision:
    verdict = "accepted" if kept else "refused"
    return Decision(factor.stamp, factor.id, factor.source, verdict, "bench", "weight", ends=factor.stamps)


Strategy = Callable[[Case], Found]


def strategies() -> dict[str, Strategy]:
    """By name: the default, nothing, each single stage of the table; then gtsam alone."""
    default = Config().robust
    alone = [name for name in ROBUST if name not in default]
    named: dict[str, dict[str, Any]] = {
        "default": {},
        "none": {"robust": []},
        **{n: {"robust": [n]} for n in alone},
    }
    found: dict[str, Strategy] = {name: configured(settings) for name, settings in named.items()}
    return found | {
        "gtsam, Huber": bare_online("huber"),
        "gtsam, DCS": bare_online("dcs"),
        "gtsam, GncLMOptimizer": bare_gnc,
    }


def configured(settings: dict[str, Any]) -> Strategy:
    return lambda case: ours(case, settings)
