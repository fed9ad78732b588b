"""The run directory: everything that a run leaves behind, as files of the field's own formats."""

import csv
import json
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..core.decisions import as_json
from ..core.errors import BadFile, SlamError
from ..core.graph import Decision
from ..core.space import Space
from ..core.variables import is_posed
from .configfile import write_yaml
from .earth import NAME as FIXES
from .earth import write_fixes
from .edits import NAME as EDITS
from .edits import write_edits
from .export import pose_graph
from .formats import trajectory as forms
from .formats import write_graph, write_trajectory
from .history import NAME as HISTORY
from .linearized import write_linearized
from .mapfile import NAME as MAP
from .mapfile import write_map
from .result import Result
from .states import NAME as STATES
from .states import write_states

FILES = ("summary.json", "config.yaml", "trajectory.tum", "odometry.tum", "online.tum", "landmarks.csv",
         "decisions.jsonl", "graph.g2o", "linearized.npz", MAP)  # fmt: skip
RESULT_BAG = "run.mcap"
ORIENTATION = ("qx", "qy", "qz", "qw")  # columns of landmarks.csv, where a landmark has one
INPUTS = "inputs"  # a folder of symbolic links
DRAWN = ("trajectory.png", "report.html", "unguarded.tum", HISTORY, RESULT_BAG)  # by the command line
MAYBE = (*DRAWN, FIXES, STATES)  # files that not every run has


def write_run(result: Result, out: Path | str) -> None:
    """Write the files of one run. An earlier run in the same directory is replaced; BadFile for anything else there."""
    out = Path(out)
    prepare(out)
    out.mkdir(parents=True, exist_ok=True)
    for stale in ("summary.json", *MAYBE):  # the summary comes last, and says that the run is whole
        (out / stale).unlink(missing_ok=True)
    for link in _links(out):
        link.unlink()
    snapshot = result.snapshot
    for name, trajectory in (
        ("trajectory", snapshot.trajectory),
        ("odometry", snapshot.odometry),
        ("online", result.run.online),
    ):
        write_trajectory(out / f"{name}.tum", forms.Trajectory(trajectory.stamps, trajectory.sevens))
    _write_landmarks(out / "landmarks.csv", result)
    _write_decisions(out / "decisions.jsonl", result)
    write_graph(out / "graph.g2o", pose_graph(result))
    landmarks = [result.run.backend.landmark(name) for name in snapshot.names]
    write_linearized(out / "linearized.npz", result.fit, snapshot.indices, landmarks)
    write_yaml(out / "config.yaml", result.run.config)
    write_edits(out / EDITS, result.run.edits)
    write_map(out / MAP, result.run.backend.saved(result.run.online, result.summary["run_hash"]))
    if (compared := result.run.backend.compared(snapshot)) is not None:
        write_fixes(out / FIXES, compared)
    if len(snapshot.states.stamps):
        write_states(out / STATES, snapshot.states)
    summary = json.dumps(result.summary, indent=1)
    (out / "summary.json").write_text(summary + "\n", encoding="utf-8")


def replace_run(out: Path, by: Path) -> None:
    """Put the files of one run in the place of another's, on the same disk. Its edits come first: with them and the summary, which
    comes last and names the inputs, a run that was broken off in between can be written again.
    """
    names = [name for name in (EDITS, *FILES, *MAYBE) if name != "summary.json"]
    for name in (*names, "summary.json"):
        if (by / name).exists():
            (by / name).replace(out / name)
        else:
            (out / name).unlink(missing_ok=True)


def prepare(out: Path) -> None:
    """See that a run can be written here, before the work is done; makes nothing. BadFile says why not."""
    if out.exists() and not out.is_dir():
        raise BadFile(f"{out}: is a file; name a directory for the run")
    there = next((folder for folder in (out, *out.parents) if folder.exists()), out)
    if not there.is_dir():
        raise BadFile(f"{out}: cannot be made: {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise BadFile(f"{out}: cannot be written: no permission in {there}")
    if out.is_dir() and not _is_run(out):
        raise BadFile(f"{out}: holds other files and no earlier run; name a new or empty directory")


def _is_run(out: Path) -> bool:
    """Whether a directory holds nothing but a run, whole or broken off."""
    known = {*FILES, *MAYBE, EDITS, *([INPUTS] if all(path.is_symlink() for path in _links(out)) else [])}
    if any(path.name not in known for path in out.iterdir()):
        return False
    try:
        return "run_hash" in json.loads((out / "summary.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return True  # broken off before its summary was written
    except (OSError, ValueError):
        return False


def _links(out: Path) -> list[Path]:
    """What is in the folder of links to the inputs."""
    folder = out / INPUTS
    return list(folder.iterdir()) if folder.is_dir() else []


def _write_decisions(path: Path, result: Result) -> None:
    vertex = result.run.inputs.vertex

    def line(decision: Decision) -> str:
        data = as_json(decision)
        if decision.ends and None not in (vertices := [vertex(stamp) for stamp in decision.ends]):
            data["vertices"] = vertices
        return json.dumps(data)

    path.write_text("".join(f"{line(decision)}\n" for decision in result.decisions), encoding="utf-8")


def _write_landmarks(path: Path, result: Result) -> None:
    """id, kind, position, upper triangle of its covariance (m^2), number of observations; and where one is a tag, between
    position and covariance, the orientation, empty for points.
    """
    backend, snapshot = result.run.backend, result.snapshot
    seen = Counter(factor.keys[-1] for factor in result.factors if factor.kind in ("landmark", "pixel"))
    turned = ORIENTATION if snapshot.orientations else ()
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(
            [
                "id",
                "kind",
                "x",
                "y",
                "z",
                *turned,
                *(f"cov_{a}{b}" for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")),
                "observations",
            ]
        )
        for name, point in zip(snapshot.names, snapshot.landmarks.tolist(), strict=True):
            key = backend.landmark(name)
            triangle = _covariance(result, key, backend.space)
            told = snapshot.orientations.get(name)
            quaternion = [""] * len(turned) if told is None else [repr(v) for v in told.tolist()]
            kind = "point" if told is None else "pose"
            out.writerow(
                [name, kind, *(repr(v) for v in point), *quaternion, *(repr(v) for v in triangle), seen[key]]
            )


def _covariance(result: Result, key: int, space: Space) -> Iterable[float]:
    full, estimate = np.zeros((3, 3)), result.run.backend.estimate
    try:
        found = estimate.covariance([key])
        if is_posed(key):
            full[:] = space.covariance_to_ros(found, estimate.pose(key))[:3, :3]
        else:
            full[: space.point_dimension, : space.point_dimension] = found
    except SlamError:
        full[:] = np.nan  # not determined: said, rather than a zero that looks certain
    return [float(value) for value in full[np.triu_indices(3)]]
