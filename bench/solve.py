"""Time to the optimum of public pose graphs, initialization included, against bare gtsam, g2o and Ceres in the same run."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from math import nan
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, NamedTuple

import gtsam
import numpy as np

from bench.table import Row
from slam_backend.core.graph import keyframe
from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.initialize import cost_of, initialize
from slam_backend.io.formats import read_graph
from slam_backend.io.problem import Problem, problem_of

DATA = Path(__file__).parents[2] / "shared/data"
REFERENCE = {  # chi2/2 at the optimum; the source is the data's README
    "pgo_sesync/tinyGrid3D": 9.313909,
    "pgo_sesync/smallGrid3D": 517.9253,
    "pgo_sesync/sphere2500": 675.7007,
    "pgo_sesync/parking-garage": 0.634189,
    "pgo_sesync/CSAIL": 20.27544,
    "pgo_sesync/intel": 22.50212,
    "pgo_sesync/MIT": 20.60347,
    "pgo_sesync/city10000": 255.9937,
    "pgo_carlone2d/M3500": 68.95744,
    "pgo_carlone2d/M3500a": 456.0958,
    "pgo_carlone2d/M3500b": 1027.689,
    "pgo_carlone2d/M3500c": 2054.111,
    "pgo_carlone2d/INTEL": 107.92,
    "pgo_glc/duderstadt": 151.5016,
}
REACHED, SLOWER, LONGEST = 1.0005, 1.2, 15  # cost over the reference, time over bare gtsam's, seconds
COUNTS = 0.005  # s; below, a millisecond of Python's own decides, which nobody waits for
NOT_ASKED = {"pgo_carlone2d/M3500c"}  # a valley in which Levenberg-Marquardt stops at 1.0001
RUNS = 7

TITLE = "Pose graphs: cost and time to the optimum"
EXPLANATION = (
    "CPU seconds from factors to the optimum, initialization included, `auto` and Levenberg-Marquardt; one warm-up, then medians of "
    "alternating runs. Bare gtsam: one call of its Levenberg-Marquardt with default parameters from each of its own initializations "
    "(the file's vertices, InitializePose3, lago on a twin with diagonal noise); the fastest that reaches the optimum is the "
    f"baseline where it takes more than {COUNTS * 1e3:.0f} ms. g2o and Ceres: their Python wheels (`pip install g2o-python pyceres`; the first needs numpy < 2), one "
    "run of the optimization alone from the file's vertices; Ceres has no pose-graph factors in its wheel, its residuals run in Python."
)


class Run(NamedTuple):
    seconds: float
    cost: float


def ours(problem: Problem) -> Run:
    begin = process_time()
    start = initialize(problem.factors, problem.stated)
    solution = solve(problem.factors, start)
    return Run(process_time() - begin, solution.cost)


def bare(problem: Problem, init: str) -> Run:
    """gtsam as its examples have it: the graph, a prior on the first pose, an initialization, one call."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in problem.factors:
        graph.add(factor.factor)
    space, first = problem.space, keyframe(0, 0).pose
    begin = process_time()
    noise = gtsam.noiseModel.Isotropic.Sigma(space.dimension, 1e-3)
    origin = space.pose_in(problem.stated, first) if problem.stated.exists(first) else space.identity
    graph.add(space.prior(first, origin, noise))
    values = START[init](problem, graph)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    seconds = process_time() - begin
    return Run(seconds, cost_of(problem.factors, found))


def _lago(problem: Problem, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """It refuses full covariances: a twin with the diagonals."""
    twin = gtsam.NonlinearFactorGraph()
    for factor in (graph.at(n) for n in range(graph.size())):
        noise = gtsam.noiseModel.Diagonal.Precisions(np.diag(factor.noiseModel().information()))
        if isinstance(factor, problem.space.between):
            twin.add(problem.space.between(*factor.keys(), factor.measured(), noise))
        else:
            twin.add(problem.space.prior(*factor.keys(), factor.prior(), noise))
    return gtsam.lago.initialize(twin)


def _file(problem: Problem, _: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """The vertices become Values anew, as `readG2o` would make them while it reads: not counted against either side."""
    return problem.stated


START: dict[str, Callable[[Problem, gtsam.NonlinearFactorGraph], gtsam.Values]] = {
    "file": _file,
    "InitializePose3": lambda _, graph: gtsam.InitializePose3.initialize(graph),
    "lago": _lago,
}


def inits(problem: Problem) -> Iterator[str]:
    if problem.graph.states is not None:
        yield "file"
    yield "InitializePose3" if problem.space.name == "3d" else "lago"


def rival(name: str, path: Path) -> dict[str, Any]:
    """What bench/rivals.py prints, or in one word why it does not."""
    if name == "ceres" and not planar_and_small(path):
        return {"why": "its residuals run in Python: only small planar graphs"}
    command = [sys.executable, "-m", "bench.rivals", name, str(path)]
    try:
        ran = subprocess.run(
            command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[1], check=False
        )
    except subprocess.TimeoutExpired:
        return {"why": "more than 120 s"}
    if ran.returncode < 0:
        return {"why": f"its wheel crashes here (signal {-ran.returncode}; g2o-python needs numpy < 2)"}
    return json.loads(ran.stdout) if ran.returncode == 0 else {"why": ran.stderr.strip().splitlines()[-1]}


def planar_and_small(path: Path) -> bool:
    graph = read_graph(path)
    return graph.space == "2d" and len(graph.edges) < 6000


def measure_one(name: str, runs: int) -> dict[str, Any]:
    """Costs over the reference, medians of CPU seconds, and the ratio to the best of bare gtsam that reaches the optimum."""
    path, reference = DATA / f"{name}.g2o", REFERENCE[name]
    problem = problem_of(read_graph(path))
    own: list[Run] = []
    theirs: dict[str, list[Run]] = {init: [bare(problem, init)] for init in inits(problem)}  # also warms up
    reaching = [init for init, (run,) in theirs.items() if run.cost <= REACHED * reference]
    for _ in range(runs):
        own.append(ours(problem))
        for init in reaching:
            theirs[init].append(bare(problem, init))
    seconds = median(run.seconds for run in own)
    times = {init: median(run.seconds for run in done[1:] or done) for init, done in theirs.items()}
    best = min((times[init] for init in reaching), default=None)
    return {
        "cost_ratio": max(run.cost for run in own) / reference,
        "cost": own[-1].cost,
        "seconds": seconds,
        "bare_best": best,
        "time_ratio": None if best is None else seconds / best,
        "bare": {
            init: {"seconds": times[init], "cost_ratio": done[0].cost / reference}
            for init, done in theirs.items()
        },
        **{other: rival(other, path) for other in ("g2o", "ceres")},
    }


def measure(runs: int = RUNS) -> dict[str, dict[str, Any]]:
    """By graph; empty without the data."""
    return {name: measure_one(name, runs) for name in REFERENCE if (DATA / f"{name}.g2o").is_file()}


def rows() -> list[Row]:
    found: list[Row] = []
    for name, graph in measure().items():
        short, seconds, ratio = name.partition("/")[2], graph["seconds"], graph["time_ratio"]
        promised = "" if name in NOT_ASKED else f"<= {REACHED}"
        found.append(
            Row(
                f"{short}: cost over the reference",
                f"{graph['cost']:.7g}",
                f"{REFERENCE[name]:.7g}",
                graph["cost_ratio"],
                promised,
            )
        )
        theirs = ", ".join(
            _said(init, run["seconds"], run["cost_ratio"]) for init, run in graph["bare"].items()
        )
        if ratio is None:
            found.append(
                Row(
                    f"{short}: seconds, where bare gtsam ends elsewhere",
                    f"{seconds:.3f} s",
                    theirs,
                    seconds,
                    f"<= {LONGEST}",
                )
            )
        else:
            bound = f"<= {SLOWER}" if graph["bare_best"] > COUNTS else ""
            found.append(Row(f"{short}: time over bare gtsam's", f"{seconds:.4f} s", theirs, ratio, bound))
        found += [
            _against(other, short, seconds, graph[other], REFERENCE[name]) for other in ("g2o", "ceres")
        ]
    return found


def _against(other: str, short: str, seconds: float, run: dict[str, Any], reference: float) -> Row:
    if "why" in run:
        return Row(f"{short}: {other}", "", run["why"], nan)
    ended = run["cost"] / reference
    baseline = _said(other, run["seconds"], ended)
    ratio = seconds / run["seconds"] if ended <= REACHED else nan
    return Row(f"{short}: time over that of {other}", f"{seconds:.4f} s", baseline, ratio)


def _said(name: str, seconds: float, cost_ratio: float) -> str:
    ended = "" if cost_ratio <= REACHED else f", ends at {cost_ratio:.4g} of the reference"
    return f"{name} {seconds:.4f} s{ended}"


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
