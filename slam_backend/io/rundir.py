"""The run directory: everything that a run leaves behind, as files of the field's own formats."""

import csv
import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..core.decisions import as_json
from ..core.errors import BadFile, SlamError
from ..core.graph import Decision
from ..core.space import Space
from .configfile import write_yaml
from .export import pose_graph
from .formats import write_graph, write_trajectory
from .formats.trajectory import Trajectory
from .replay import Result

FILES = ("summary.json", "config.yaml", "trajectory.tum", "odometry.tum", "online.tum", "landmarks.csv",
         "decisions.jsonl", "graph.g2o")  # fmt: skip


def write_run(result: Result, out: Path) -> None:
    """Write the files of one run. An earlier run in the same directory is replaced; BadFile for anything else there."""
    prepare(out)
    snapshot = result.snapshot
    for name, trajectory in (
        ("trajectory", snapshot.trajectory),
        ("odometry", snapshot.odometry),
        ("online", result.run.online),
    ):
        write_trajectory(out / f"{name}.tum", Trajectory(trajectory.stamps, trajectory.sevens))
    _write_landmarks(out / "landmarks.csv", result)
    _write_decisions(out / "decisions.jsonl", result)
    write_graph(out / "graph.g2o", pose_graph(result))
    write_yaml(out / "config.yaml", result.run.config)
    summary = json.dumps(result.summary, indent=1)
    (out / "summary.json").write_text(summary + "\n", encoding="utf-8")


def prepare(out: Path) -> None:
    """Make the directory, or see that it holds nothing but an earlier run."""
    if out.exists() and not out.is_dir():
        raise BadFile(f"{out}: is a file; name a directory for the run")
    if out.is_dir() and any(out.iterdir()) and not (out / "summary.json").exists():
        raise BadFile(f"{out}: holds other files and no earlier run; name a new or empty directory")
    out.mkdir(parents=True, exist_ok=True)


def _write_decisions(path: Path, result: Result) -> None:
    vertex = result.run.inputs.vertex

    def line(decision: Decision) -> str:
        data = as_json(decision)
        if decision.ends and None not in (vertices := [vertex(stamp) for stamp in decision.ends]):
            data["vertices"] = vertices
        return json.dumps(data)

    path.write_text("".join(f"{line(decision)}\n" for decision in result.decisions), encoding="utf-8")


def _write_landmarks(path: Path, result: Result) -> None:
    """id, kind, position, upper triangle of its covariance (m^2), number of observations."""
    backend, snapshot = result.run.backend, result.snapshot
    seen = Counter(factor.keys[-1] for factor in result.factors if factor.kind == "landmark")
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(
            [
                "id",
                "kind",
                "x",
                "y",
                "z",
                *(f"cov_{a}{b}" for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")),
                "observations",
            ]
        )
        for name, point in zip(snapshot.names, snapshot.landmarks.tolist(), strict=True):
            key = backend.landmark(name)
            triangle = _covariance(result, key, backend.space)
            out.writerow([name, "point", *(repr(v) for v in point), *(repr(v) for v in triangle), seen[key]])


def _covariance(result: Result, key: int, space: Space) -> Iterable[float]:
    full = np.zeros((3, 3))
    try:
        full[: space.point_dimension, : space.point_dimension] = result.run.backend.estimate.covariance([key])
    except SlamError:
        full[:] = np.nan  # not determined: said, rather than a zero that looks certain
    return [float(value) for value in full[np.triu_indices(3)]]
