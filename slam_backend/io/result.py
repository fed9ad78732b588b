"""The end of a run: estimate, decisions, and the numbers of summary.json."""

import platform
import resource
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam

from ..core.config import config_hash
from ..core.consistency import Consistency, Fit, blind_axes
from ..core.decisions import DecisionLog
from ..core.fingerprint import run_hash
from ..core.graph import HOLDING, Factor
from ..core.measurement import format_stamp
from ..core.solvers.batch import Solution
from ..core.trajectory import Snapshot, Trajectory
from .earth import on_earth

if TYPE_CHECKING:
    from .replay import Run

VERSIONS = ("slam_backend", "gtsam", "numpy", "rosbags")


@dataclass(frozen=True, eq=False)
class Result:
    """The end of a run: estimate, decisions, summary."""

    run: "Run"

    @cached_property
    def snapshot(self) -> Snapshot:
        return self.run.backend.snapshot()

    @property
    def trajectory(self) -> Trajectory:
        """map_T_base at every keyframe."""
        return self.snapshot.trajectory

    @property
    def decisions(self) -> DecisionLog:
        return self.run.decisions

    @property
    def factors(self) -> Sequence[Factor]:
        """Those kept, in the order in which they came."""
        return list(self.run.backend.solver.factors.values())

    @cached_property
    def values(self) -> gtsam.Values:
        return self.run.backend.estimate.values()

    @cached_property
    def fit(self) -> Fit:
        """The kept factors at the final estimate."""
        return Fit(self.factors, self.values)

    @cached_property
    def consistency(self) -> Mapping[str, Consistency]:
        """By source: whether its noise is what it says."""
        return self.fit.consistency(blind_axes(self.run.config))

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What summary.json holds."""
        run, loops = self.run, self.decisions.loops()
        return {
            "continued": None if run.continued is None else str(run.continued.absolute()),
            "sessions": [
                format_stamp(int(s)) for s in (*self.trajectory.stamps[:1], *self.trajectory.breaks)
            ],
            "input": [str(path.absolute()) for path in run.inputs.paths],
            "ended": run.ended,
            "run_hash": run_hash(self.factors, self.decisions, self.values, self.trajectory.sevens),
            "config_hash": config_hash(run.config),
            "seed": 0,
            "estimator": run.backend.solver.name,
            "counts": {
                "records": run.records,
                "measurements": run.measurements,
                "keyframes": len(self.trajectory),
                "landmarks": len(self.snapshot.names),
                "factors": len(self.factors),
                "parts": len(run.backend.parts),
                "loops_offered": sum(loops.values()),
                "loops_accepted": loops.get("accepted", 0) + loops.get("restored", 0),
                "loops_probation": loops.get("probation", 0),
                "loops_refused": loops.get("refused", 0) + loops.get("removed", 0),
            },
            "earth": on_earth(self),
            "edits": len(run.edits),
            "decisions": self.decisions.by_rule(),
            "cost": {
                "initial": cost(self.factors, run.backend.dead_reckoning()),
                "online": run.online_cost,
                "final": cost(self.factors, self.values),
            },
            "consistency": {source: each.as_json() for source, each in self.consistency.items()},
            "calibration": {
                source: {name: found._asdict() for name, found in constants.items()}
                for source, constants in run.backend.calibration.found.items()
            },
            "batch": None if run.batch is None else _told(run.batch),
            "timing": run.seconds.summary(),
            "memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
            "versions": versions(),
            "damage": run.inputs.damage,
            "notes": run.notes,
        }


def cost(factors: Iterable[Factor], values: gtsam.Values) -> float:
    """chi2/2, gauges left out."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        if factor.kind not in HOLDING:
            graph.add(factor.factor)
    return float(graph.error(values))


def _told(batch: Solution) -> dict[str, Any]:
    """How the final batch went."""
    steps = [step._asdict() for step in batch.iterations]
    return {"cost_initial": batch.cost_initial, "cost": batch.cost, "stop": batch.stop, "iterations": steps}


def versions() -> dict[str, str]:
    """Of what decides the bits of a result."""
    found = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpu": ",".join(_cpu_features()),
    }
    for name in VERSIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _cpu_features() -> list[str]:
    """Those on which glibc, OpenBLAS and numpy choose their code."""
    try:
        flags = next(
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags")
        )
    except (OSError, StopIteration):
        return []
    return [name for name in ("sse4_2", "avx", "fma", "avx2", "avx512f") if name in flags.split()]
