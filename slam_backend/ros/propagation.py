"""Where the robot is at the rate of its IMU: the newest keyframe's state, carried on by the samples since."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ..core.backend import Update
from ..core.config import Config
from ..core.graph import Motion, Pose
from ..core.inertial import Inertial, State, imu_of
from ..core.measurement import SECOND, Array, ImuSample, StaticTransform
from ..core.mounts import Mounts
from ..core.space import SPACES
from .pose import UNKNOWN

SILENT = SECOND // 5  # ns without a sample after which odometry tells again


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """`map_T_base`, its covariance (36, ROS order; UNKNOWN where it is not determined), and (6,) m/s and rad/s in the base."""

    seven: tuple[float, ...]
    covariance: Array
    twist: Array


class Propagator:
    """Of the configured IMU, in the order of its stamps. Without one it carries nothing."""

    def __init__(self, config: Config) -> None:
        source = imu_of(config)
        self._space, self.drives = SPACES[config.space], False
        self._mounts = Mounts(self._space, config.base_frame, config.extrinsics)
        self._inertial: Inertial | None = None
        if source is not None:
            name = next(name for name, each in config.sources.items() if each is source)
            self._inertial, self.drives = Inertial(name, source), name == config.driver
        self._told: Update | None = None
        self._newest = 0

    def carries(self, stamp: int) -> bool:
        """Whether it told where the robot was shortly before a stamp (ns)."""
        return self._told is not None and stamp - self._newest < SILENT

    def mounted(self, transform: StaticTransform) -> None:
        self._mounts.add(transform)

    def named(self, base: str) -> None:
        """The frame that the driving odometry tells the pose of."""
        self._mounts.name_base(base)

    def carry(
        self, sample: ImuSample, update: Update | None, covariance: Sequence[float] | None
    ) -> Carried | None:
        """None before the first keyframe that the IMU reaches, and for a sample that is old or from a frame nobody knows."""
        if self._inertial is None or sample.stamp <= self._newest:
            return None
        if self.drives:
            self._mounts.name_base(sample.frame)
        mount = self._mounts.get(sample.frame)
        if mount is None:
            return None
        self._newest = sample.stamp
        self._inertial.add(sample, None if mount is self._space.identity else mount)
        if update is not None and update is not self._told and update.state:
            self._told = update
            self._inertial.begin(self._state(update), update.keyframe.stamp)
        return self._carried(sample, mount, covariance) if self._told is not None else None

    def _state(self, update: Update) -> State:
        numbers = np.array(update.state)
        bias = gtsam.imuBias.ConstantBias(numbers[3:6], numbers[6:])
        return State(update.keyframe.stamp, self._space.pose(update.pose), numbers[:3], bias)

    def _carried(self, sample: ImuSample, mount: Pose, covariance: Sequence[float] | None) -> Carried:
        assert self._inertial is not None
        stretch = self._inertial.since(sample.stamp)
        start, end = stretch.start, stretch.end
        assert start is not None
        ros = UNKNOWN
        if covariance is not None:
            marginal = self._space.covariance(np.reshape(covariance, (6, 6)), start.pose)
            total = Motion(start.pose, marginal).then(stretch.motion)
            ros = self._space.covariance_to_ros(total.covariance, end.pose).reshape(36)
        rate = mount.rotation().rotate(sample.rate - end.bias.gyroscope())
        twist = np.concatenate([end.pose.rotation().unrotate(end.velocity), rate])
        return Carried(self._space.seven(end.pose), ros, twist)
