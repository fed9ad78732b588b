"""What differs between runs: numbers, settings, decisions that flipped, and where the trajectories part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..core.config import config_to
from ..core.errors import BadFile
from ..core.trajectory import Trajectory, shaped
from ..io.configfile import flat
from ..io.finished import FinishedRun
from .evaluate import How, evaluate

USUAL = How()
NUMBERS: Mapping[str, str] = {  # what --fail-if knows, and how tables head it
    "ate": "ATE (m)",
    "ate_rotation": "ATE (deg)",
    "rpe": "RPE (m/m)",
    "rpe_rotation": "RPE (deg/m)",
    "ate_online": "ATE online (m)",
    "keyframes": "keyframes",
    "landmarks": "landmarks",
    "factors": "factors",
    "loops_accepted": "loops accepted",
    "loops_refused": "loops refused",
    "cost": "cost",
    "solve_s": "solving (s)",
    "wall_s": "in all (s)",
    "update_p50": "update p50 (ms)",
    "update_p99": "update p99 (ms)",
    "memory_mb": "memory (MB)",
    "apart": "largest distance to the base (m)",
    "flips": "decisions flipped",
}


class Flip(NamedTuple):
    """A measurement of which two runs thought differently at the end; `-`: that run has no decision about it."""

    id: str
    base: str
    verdict: str
    rule: str  # by which this run decided, else that of the base
    detail: str


class Parting(NamedTuple):
    """The first moment (ns) at which two trajectories are farther apart than the threshold, and where (3,) the base was."""

    stamp: int
    place: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A run beside the base. settings: name -> (base, here). times: solving time over that of the base."""

    run: FinishedRun
    numbers: Mapping[str, float | None]
    identical: bool
    settings: Mapping[str, tuple[Any, Any]]
    flips: Sequence[Flip]
    parting: Parting | None
    times: float | None


def compare(
    runs: Sequence[FinishedRun], truth: Trajectory | None = None, how: How = USUAL, threshold: float = 0.1
) -> list[Compared]:
    """Each run beside the first, which is also beside itself. threshold: m."""
    base = runs[0]
    return [_beside(base, run, truth, how, threshold) for run in runs]


def _beside(
    base: FinishedRun, run: FinishedRun, truth: Trajectory | None, how: How, threshold: float
) -> Compared:
    distances = distances_to(base, run)
    flips = _flips(base, run)
    numbers = _numbers(run) | {"apart": float(np.nanmax(distances)), "flips": float(len(flips))}
    if truth is not None:
        numbers |= evaluate(run.trajectory, truth, how).numbers()
        numbers["ate_online"] = evaluate(run.online, truth, how).ate["rmse"]
    spent = _numbers(base)["solve_s"]
    return Compared(
        run,
        {name: numbers.get(name) for name in NUMBERS},
        run.summary["run_hash"] == base.summary["run_hash"],
        _settings(base, run),
        flips,
        _parting(base, run, distances, threshold),
        (numbers["solve_s"] or 0.0) / spent if spent else None,
    )


def distances_to(base: FinishedRun, run: FinishedRun) -> np.ndarray:
    """(N,) m from the base at each keyframe of a run; NaN where the base does not reach. BadFile if that is everywhere."""
    there = shaped(base.trajectory, base.odometry, run.trajectory.stamps)[:, :3]
    distances = np.linalg.norm(run.trajectory.sevens[:, :3] - there, axis=1)
    if np.isnan(distances).all():
        raise BadFile(
            f"{run.path} and {base.path} have no moment in common: they are not runs of the same drive"
        )
    return np.asarray(distances)


def _parting(base: FinishedRun, run: FinishedRun, distances: np.ndarray, threshold: float) -> Parting | None:
    with np.errstate(invalid="ignore"):
        beyond = np.flatnonzero(distances > threshold)
    if not beyond.size:
        return None
    stamp = int(run.trajectory.stamps[beyond[0]])
    return Parting(stamp, tuple(shaped(base.trajectory, base.odometry, [stamp])[0, :3].tolist()))


def _numbers(run: FinishedRun) -> dict[str, float | None]:
    told = run.summary
    try:
        counts, timing = told["counts"], told["timing"]
        return {
            **{name: float(counts[name]) for name in ("keyframes", "landmarks", "factors")},
            **{name: float(counts[name]) for name in ("loops_accepted", "loops_refused")},
            **{name: float(timing[name]) for name in ("solve_s", "wall_s")},
            **{f"update_{p}": float(timing["update_ms"][p]) for p in ("p50", "p99")},
            "cost": float(told["cost"]["final"]),
            "memory_mb": float(told["memory_mb"]),
        }
    except (KeyError, TypeError, ValueError) as error:
        raise BadFile(f"{run.path / 'summary.json'}: is damaged: {error} is missing or no number") from None


def _settings(base: FinishedRun, run: FinishedRun) -> dict[str, tuple[Any, Any]]:
    one, other = (dict(flat(config_to(each.config))) for each in (base, run))
    found = {name: (one.get(name), other.get(name)) for name in {**one, **other}}
    estimators = base.summary.get("estimator"), run.summary.get("estimator")
    return {name: pair for name, pair in {"estimator": estimators, **found}.items() if pair[0] != pair[1]}


def _flips(base: FinishedRun, run: FinishedRun) -> list[Flip]:
    """In the order in which the decisions stand."""
    one, other = ({line["id"]: line for line in each.decisions} for each in (base, run))
    found = []
    for id_ in {**one, **other}:
        before, after = one.get(id_), other.get(id_)
        was, here = (line["verdict"] if line else "-" for line in (before, after))
        if was != here:
            line = after or before or {}
            found.append(Flip(id_, was, here, f"{line['stage']}/{line['reason']}", line.get("detail", "")))
    return found
