"""How far an estimate is from the truth: absolute and relative pose errors, computed by evo (an extra).

evo (github.com/MichaelGrupp/evo) is what the field compares with, so its numbers are taken and not imitated. Errors follow
Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; alignment is Umeyama's (PAMI 1991).
"""

from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..core.errors import BadFile, MissingExtra
from ..core.geometry import seven_of_matrix
from ..core.measurement import SECOND
from ..core.trajectory import Trajectory

Alignment = Literal["none", "origin", "se2", "se3", "sim3"]
Statistics = dict[str, float]  # rmse, mean, median, std, min, max, sse


@dataclass(frozen=True, slots=True)
class How:
    """align: origin: the first poses coincide; se2: both are laid flat first. delta: m of path between the two poses
    of a relative error. max_difference, offset: s; the offset is added to the truth's stamps.

    interpolate: the denser of the two is taken at the stamps of the other, instead of its nearest pose. by_order:
    pose n belongs to pose n, for files without stamps.
    """

    align: Alignment = "se3"
    delta: float = 1.0
    max_difference: float = 0.01
    offset: float = 0.0
    interpolate: bool = False
    by_order: bool = False


@dataclass(frozen=True, slots=True)
class Errors:
    """Positions in m, rotations in degrees. rpe: None where no two poses are `delta` apart. scale: of the alignment."""

    poses: int
    scale: float
    ate: Statistics
    ate_rotation: Statistics
    rpe: Statistics | None
    rpe_rotation: Statistics | None
    delta: float

    def numbers(self) -> dict[str, float | None]:
        """The few that tables show: root mean squares; per metre of path."""
        rpe, turned = self.rpe, self.rpe_rotation
        return {
            "ate": self.ate["rmse"],
            "ate_rotation": self.ate_rotation["rmse"],
            "rpe": rpe["rmse"] / self.delta if rpe else None,
            "rpe_rotation": turned["rmse"] / self.delta if turned else None,
        }


def evaluate(estimate: Trajectory, truth: Trajectory, how: How = How()) -> Errors:
    """MissingExtra without evo; BadFile when the two have no moment in common, or cannot be aligned."""
    evo = _evo()
    pair = _together(_for_evo(estimate), _for_evo(truth), how)
    theirs, ours = pair
    if how.align == "se2":
        for each in pair:
            each.project(evo.Plane.XY)
    scale = 1.0
    try:
        if how.align == "origin":
            ours.align_origin(theirs)
        elif how.align != "none":
            *_, scale = ours.align(theirs, correct_scale=how.align == "sim3")
    except evo.GeometryException as error:
        raise BadFile(
            f"the trajectories cannot be aligned ({error}): positions on one line leave a turn open; use --align origin"
        ) from None
    ate, turned = (_absolute(pair, relation) for relation in ("translation_part", "rotation_angle_deg"))
    rpe, twisted = (
        _relative(pair, relation, how.delta) for relation in ("translation_part", "rotation_angle_deg")
    )
    return Errors(ours.num_poses, float(scale), ate, turned, rpe, twisted, how.delta)


def laid_over(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """The truth, moved as a whole so that it fits the estimate best (SE(3)). Errors as `evaluate`."""
    theirs, ours = _together(_for_evo(estimate), _for_evo(truth), How(interpolate=True))
    try:
        rotation, translation, _ = ours.align(theirs)
    except _evo().GeometryException as error:
        raise BadFile(f"the truth cannot be laid over the estimate: {error}") from None
    estimate_T_truth = np.eye(4)
    estimate_T_truth[:3, :3], estimate_T_truth[:3, 3] = rotation.T, -rotation.T @ translation
    return Trajectory(truth.stamps, seven_of_matrix(estimate_T_truth @ truth.poses))


@dataclass(frozen=True, slots=True)
class _Evo:
    metrics: Any
    sync: Any
    PoseTrajectory3D: Any
    Plane: Any
    GeometryException: Any
    FilterException: Any


def _evo() -> _Evo:
    try:
        from evo.core import filters, geometry, metrics, sync, trajectory
    except ImportError:
        raise MissingExtra(
            "comparing with a truth needs evo, which is not installed: pip install 'slam_backend[eval]'"
        ) from None
    return _Evo(
        metrics, sync, trajectory.PoseTrajectory3D, trajectory.Plane,
        geometry.GeometryException, filters.FilterException,
    )  # fmt: skip


def _for_evo(trajectory: Trajectory) -> Any:
    quaternions = trajectory.sevens[:, [6, 3, 4, 5]]
    seconds = np.array(
        [stamp / SECOND for stamp in trajectory.stamps.tolist()]
    )  # Python's own division rounds once
    return _evo().PoseTrajectory3D(trajectory.sevens[:, :3], quaternions, seconds)


def _together(ours: Any, theirs: Any, how: How) -> tuple[Any, Any]:
    """(truth, estimate), pose for pose."""
    if how.by_order:
        if ours.num_poses != theirs.num_poses:
            raise BadFile(
                f"a file without stamps is compared pose by pose, and there are {ours.num_poses} against {theirs.num_poses} "
                "of the truth: use files with stamps"
            )
        return theirs, ours
    sync = _evo().sync
    method = sync.SyncMethod.interpolation if how.interpolate else sync.SyncMethod.nearest_time
    try:
        theirs, ours = sync.associate_trajectories(
            theirs, ours, sync_method=method, max_diff=how.max_difference, offset_2=-how.offset
        )
    except sync.SyncException:
        spans = " and ".join(f"{t.timestamps[0]:.3f} to {t.timestamps[-1]:.3f} s" for t in (ours, theirs))
        raise BadFile(
            f"estimate and truth have no moment in common within {how.max_difference} s: {spans}; "
            "see --offset, --max-difference"
        ) from None
    if ours.num_poses < 3:
        raise BadFile(
            f"estimate and truth have only {ours.num_poses} moments in common; see --max-difference"
        )
    return theirs, ours


def _absolute(pair: tuple[Any, Any], relation: str) -> Statistics:
    metrics = _evo().metrics
    return _statistics(metrics.APE(metrics.PoseRelation[relation]), pair)


def _relative(pair: tuple[Any, Any], relation: str, delta: float) -> Statistics | None:
    evo = _evo()
    metrics = evo.metrics
    try:
        return _statistics(metrics.RPE(metrics.PoseRelation[relation], delta, metrics.Unit.meters), pair)
    except evo.FilterException:
        return None


def _statistics(metric: Any, pair: tuple[Any, Any]) -> Statistics:
    metric.process_data(deepcopy(pair))
    return {name: float(value) for name, value in metric.get_all_statistics().items()}
