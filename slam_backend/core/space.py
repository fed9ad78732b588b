"""SE(2) or SE(3): the one place that knows the dimension.

gtsam.Pose2 and gtsam.Pose3 share their methods (compose, between, AdjointMap, ...), so everything that only
composes poses is written once. A `Space` adds what differs: how ROS's seven numbers become a pose, which block of
a 6x6 covariance counts, and which native factor serves. Tangents are at the child, in GTSAM's order:
x y yaw in 2-D, rotation before translation in 3-D.
"""

from collections.abc import Sequence
from math import atan2, cos, sin, sqrt
from typing import Any, Protocol

import gtsam
import numpy as np

from .geometry import covariance_from_ros, covariance_to_ros, seven_of_matrix
from .graph import Pose
from .measurement import Array

ZENITH = 1e-3  # least change of direction per radian of azimuth, which has no effect straight up


class Space(Protocol):
    name: str
    dimension: int  # of a pose's tangent
    used: tuple[int, ...]  # the axes of ROS's x y z roll pitch yaw that count
    point_dimension: int
    translation: slice  # of a pose's tangent
    exact: bool  # a pose is the same to the last bit as the one that is made of its numbers
    identity: Pose
    between: Any  # factor classes
    prior: Any

    def pose(self, seven: Sequence[float]) -> Pose: ...

    def from_extrinsics(self, six: Sequence[float]) -> Pose: ...

    def rigid(self, rotation: Array, translation: Array) -> Pose:
        """From a rotation matrix and a vector of this space's points."""
        ...

    def seven(self, pose: Pose) -> tuple[float, ...]: ...

    def numbers(self, pose: Pose) -> tuple[float, ...]:
        """What `pose_of_numbers` takes back: the smallest exact form for storage."""
        ...

    def pose_of_numbers(self, numbers: Sequence[float]) -> Pose: ...

    def covariance(self, ros: Array, pose: Pose) -> Array:
        """(6, 6) in ROS order, of `pose`, to the tangent of its child."""
        ...

    def covariance_to_ros(self, covariance: Array, pose: Pose) -> Array:
        """The inverse of `covariance`: (6, 6), zeros on axes that the space lacks."""
        ...

    def twist_covariance(self, ros: Array) -> Array:
        """(6, 6) in ROS order and child axes to the order of the tangent."""
        ...

    def information(self, information: Array) -> Array:
        """3x3 (x y yaw) or 6x6 (GTSAM order) as a graph file states it, in this space's dimension."""
        ...

    def diagonal(self, variance_rotation: float, variance_translation: float) -> Array: ...

    def flat(self, covariance: Array, variance_rotation: float, variance_translation: float) -> Array:
        """With these variances, and no correlations, on the axes that a plane lacks."""
        ...

    def size(self, pose: Pose) -> tuple[float, float]:
        """Length of the translation (m) and angle of the rotation (rad)."""
        ...

    def logmap(self, pose: Pose) -> Array: ...

    def expmap(self, tangent: Array) -> Pose: ...

    def observe(self, pose: int, point: int, value: Array, noise: Any) -> gtsam.NonlinearFactor:
        """Bearing and range of a point in the pose's frame, `value` in this space's dimension."""
        ...

    def to_polar(self, value: Array, covariance: Array) -> tuple[Array, Array]:
        """A point and its covariance as the value and covariance that `observe` takes (first order)."""
        ...

    def to_cartesian(self, value: Array, covariance: Array) -> tuple[Array, Array]:
        """The inverse of `to_polar`, from a covariance of azimuth, [elevation,] range."""
        ...

    def direction(self, azimuth: float, elevation: float) -> Array:
        """Unit vector; a plane ignores the second argument."""
        ...

    def bearing_noise(self, value: Array, covariance: Array) -> Array:
        """A covariance of azimuth, [elevation, range] at the tangent of the native factor."""
        ...

    def observe_bearing(self, pose: int, point: int, value: Array, noise: Any) -> gtsam.NonlinearFactor: ...

    def observe_range(
        self, pose: int, point: int, value: float, noise: Any, sensor: Pose
    ) -> gtsam.NonlinearFactor:
        """Distance of a point from a sensor that sits at `pose_T_sensor`."""
        ...

    def distance(self, pose: int, other: int, value: float, noise: Any) -> gtsam.NonlinearFactor:
        """Between the origins of two poses."""
        ...

    def estimate(self, solver: Any, key: int) -> Pose: ...

    def estimate_point(self, solver: Any, key: int) -> Array: ...

    def pose_in(self, values: gtsam.Values, key: int) -> Pose: ...

    def point_in(self, values: gtsam.Values, key: int) -> Array: ...

    def sevens(self, values: gtsam.Values, keys: Sequence[int]) -> Array: ...

    def sevens_of(self, numbers: Array) -> Array:
        """Rows of `numbers` to (N, 7)."""
        ...


def interpolate(space: Space, start: Pose, end: Pose, ratio: float) -> Pose:
    """The pose at `ratio` of the way, along the constant twist from start to end."""
    return start.compose(space.expmap(ratio * space.logmap(start.between(end))))


class Planar:
    name = "2d"
    dimension = 3
    used = (0, 1, 5)
    point_dimension = 2
    translation = slice(0, 2)
    exact = False  # gtsam keeps cosine and sine of the angle
    identity = gtsam.Pose2()
    between = gtsam.BetweenFactorPose2
    prior = gtsam.PriorFactorPose2

    def pose(self, seven: Sequence[float]) -> Pose:
        x, y, _, qx, qy, qz, qw = seven
        return gtsam.Pose2(x, y, atan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz))

    def from_extrinsics(self, six: Sequence[float]) -> Pose:
        return gtsam.Pose2(six[0], six[1], six[5])

    def rigid(self, rotation: Array, translation: Array) -> Pose:
        return gtsam.Pose2(gtsam.Rot2.fromCosSin(rotation[0, 0], rotation[1, 0]), translation)

    def seven(self, pose: Pose) -> tuple[float, ...]:
        half = pose.theta() / 2
        return (pose.x(), pose.y(), 0.0, 0.0, 0.0, sin(half), cos(half))

    def numbers(self, pose: Pose) -> tuple[float, ...]:
        return (pose.x(), pose.y(), pose.theta())

    def pose_of_numbers(self, numbers: Sequence[float]) -> Pose:
        return gtsam.Pose2(*numbers)

    def covariance(self, ros: Array, pose: Pose) -> Array:
        block = ros.reshape(6, 6)[np.ix_(self.used, self.used)]
        c, s = cos(pose.theta()), sin(pose.theta())
        to_child = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(to_child @ block @ to_child.T)

    def covariance_to_ros(self, covariance: Array, pose: Pose) -> Array:
        c, s = cos(pose.theta()), sin(pose.theta())
        to_parent = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        ros = np.zeros((6, 6))
        ros[np.ix_(self.used, self.used)] = to_parent @ covariance @ to_parent.T
        return ros

    def twist_covariance(self, ros: Array) -> Array:
        return np.asarray(ros.reshape(6, 6)[np.ix_(self.used, self.used)])

    def information(self, information: Array) -> Array:
        if information.shape == (3, 3):
            return information
        axes = [3, 4, 2]  # x y yaw in GTSAM's order of six
        return np.asarray(np.linalg.inv(np.linalg.inv(information)[np.ix_(axes, axes)]))

    def diagonal(self, variance_rotation: float, variance_translation: float) -> Array:
        found = np.zeros((3, 3))
        found[0, 0] = found[1, 1] = variance_translation
        found[2, 2] = variance_rotation
        return found

    def flat(self, covariance: Array, variance_rotation: float, variance_translation: float) -> Array:  # noqa: ARG002
        return covariance

    def size(self, pose: Pose) -> tuple[float, float]:
        return sqrt(pose.x() ** 2 + pose.y() ** 2), abs(pose.theta())

    def logmap(self, pose: Pose) -> Array:
        return np.asarray(gtsam.Pose2.Logmap(pose))

    def expmap(self, tangent: Array) -> Pose:
        return gtsam.Pose2.Expmap(tangent)

    def observe(self, pose: int, point: int, value: Array, noise: Any) -> gtsam.NonlinearFactor:
        return gtsam.BearingRangeFactor2D(pose, point, gtsam.Rot2(value[0]), value[1], noise)

    def observe_bearing(self, pose: int, point: int, value: Array, noise: Any) -> gtsam.NonlinearFactor:
        return gtsam.BearingFactor2D(pose, point, gtsam.Rot2(value[0]), noise)

    def observe_range(
        self, pose: int, point: int, value: float, noise: Any, sensor: Pose
    ) -> gtsam.NonlinearFactor:
        if sensor is self.identity:
            return gtsam.RangeFactor2D(pose, point, value, noise)
        return gtsam.RangeFactorWithTransform2D(pose, point, value, noise, sensor)

    def distance(self, pose: int, other: int, value: float, noise: Any) -> gtsam.NonlinearFactor:
        return gtsam.RangeFactorPose2(pose, other, value, noise)

    def to_polar(self, value: Array, covariance: Array) -> tuple[Array, Array]:
        x, y = float(value[0]), float(value[1])
        square = x * x + y * y
        r = sqrt(square)
        jacobian = np.array([[-y / square, x / square], [x / r, y / r]])
        return np.array([atan2(y, x), r]), jacobian @ covariance @ jacobian.T

    def to_cartesian(self, value: Array, covariance: Array) -> tuple[Array, Array]:
        c, s, r = cos(value[0]), sin(value[0]), float(value[1])
        jacobian = np.array([[-r * s, c], [r * c, s]])
        return np.array([r * c, r * s]), jacobian @ covariance @ jacobian.T

    def direction(self, azimuth: float, elevation: float) -> Array:  # noqa: ARG002  # a plane has no elevation
        return np.array([cos(azimuth), sin(azimuth)])

    def bearing_noise(self, value: Array, covariance: Array) -> Array:  # noqa: ARG002  # an angle is its own tangent
        return covariance

    def estimate(self, solver: Any, key: int) -> Pose:
        return solver.calculateEstimatePose2(key)

    def estimate_point(self, solver: Any, key: int) -> Array:
        return np.asarray(solver.calculateEstimatePoint2(key))

    def pose_in(self, values: gtsam.Values, key: int) -> Pose:
        return values.atPose2(key)

    def point_in(self, values: gtsam.Values, key: int) -> Array:
        return np.asarray(values.atPoint2(key))

    def sevens(self, values: gtsam.Values, keys: Sequence[int]) -> Array:
        return self.sevens_of(np.array([self.numbers(values.atPose2(key)) for key in keys]).reshape(-1, 3))

    def sevens_of(self, numbers: Array) -> Array:
        sevens = np.zeros((len(numbers), 7))
        sevens[:, :2] = numbers[:, :2]
        sevens[:, 5], sevens[:, 6] = np.sin(numbers[:, 2] / 2), np.cos(numbers[:, 2] / 2)
        return sevens


class Spatial:
    name = "3d"
    dimension = 6
    used = (0, 1, 2, 3, 4, 5)
    point_dimension = 3
    translation = slice(3, 6)
    exact = True
    identity = gtsam.Pose3()
    between = gtsam.BetweenFactorPose3
    prior = gtsam.PriorFactorPose3

    def pose(self, seven: Sequence[float]) -> Pose:
        x, y, z, qx, qy, qz, qw = seven
        n = sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
        return gtsam.Pose3(gtsam.Rot3.Quaternion(qw / n, qx / n, qy / n, qz / n), np.array((x, y, z)))

    def from_extrinsics(self, six: Sequence[float]) -> Pose:
        x, y, z, roll, pitch, yaw = six
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array((x, y, z)))

    def rigid(self, rotation: Array, translation: Array) -> Pose:
        return gtsam.Pose3(gtsam.Rot3(rotation), translation)

    def seven(self, pose: Pose) -> tuple[float, ...]:
        q = pose.rotation().toQuaternion()
        return (*pose.translation().tolist(), q.x(), q.y(), q.z(), q.w())

    def numbers(self, pose: Pose) -> tuple[float, ...]:
        first, second, third, _ = pose.matrix().tolist()
        return (*first, *second, *third)  # a quaternion would not give the same bits back

    def pose_of_numbers(self, numbers: Sequence[float]) -> Pose:
        a, b, c, x, d, e, f, y, g, h, i, z = numbers
        return gtsam.Pose3(gtsam.Rot3(a, b, c, d, e, f, g, h, i), np.array((x, y, z)))

    def covariance(self, ros: Array, pose: Pose) -> Array:
        return covariance_from_ros(ros.reshape(6, 6), pose.rotation().matrix())

    def covariance_to_ros(self, covariance: Array, pose: Pose) -> Array:
        return covariance_to_ros(covariance, pose.rotation().matrix())

    def twist_covariance(self, ros: Array) -> Array:
        return np.roll(ros.reshape(6, 6), (3, 3), axis=(0, 1))

    def information(self, information: Array) -> Array:
        if information.shape == (6, 6):
            return information
        # A planar measurement says nothing new about height, roll and pitch: held near zero, 1 mm and 1 mrad.
        full = np.eye(6) * 1e6
        axes = [3, 4, 2]
        full[np.ix_(axes, axes)] = information
        return full

    def diagonal(self, variance_rotation: float, variance_translation: float) -> Array:
        found = np.zeros((6, 6))
        found[0, 0] = found[1, 1] = found[2, 2] = variance_rotation
        found[3, 3] = found[4, 4] = found[5, 5] = variance_translation
        return found

    def flat(self, covariance: Array, variance_rotation: float, variance_translation: float) -> Array:
        flat = np.diag((variance_rotation, variance_rotation, 0, 0, 0, variance_translation))
        axes = np.ix_((2, 3, 4), (2, 3, 4))  # yaw x y in GTSAM's order of six
        flat[axes] = covariance[axes]
        return flat

    def size(self, pose: Pose) -> tuple[float, float]:
        x, y, z = pose.x(), pose.y(), pose.z()
        a, b, c, _, _, _ = gtsam.Pose3.Logmap(pose).tolist()
        return sqrt(x * x + y * y + z * z), sqrt(a * a + b * b + c * c)

    def logmap(self, pose: Pose) -> Array:
        return np.asarray(gtsam.Pose3.Logmap(pose))

    def expmap(self, tangent: Array) -> Pose:
        return gtsam.Pose3.Expmap(tangent)

    def observe(self, pose: int, point: int, value: Array, noise: Any) -> gtsam.NonlinearFactor:
        bearing = gtsam.Unit3(self.direction(value[0], value[1]))
        return gtsam.BearingRangeFactor3D(pose, point, bearing, value[2], noise)

    def observe_bearing(self, pose: int, point: int, value: Array, noise: Any) -> gtsam.NonlinearFactor:
        return gtsam.BearingFactor3D(pose, point, gtsam.Unit3(self.direction(value[0], value[1])), noise)

    def observe_range(
        self, pose: int, point: int, value: float, noise: Any, sensor: Pose
    ) -> gtsam.NonlinearFactor:
        if sensor is self.identity:
            return gtsam.RangeFactor3D(pose, point, value, noise)
        return gtsam.RangeFactorWithTransform3D(pose, point, value, noise, sensor)

    def distance(self, pose: int, other: int, value: float, noise: Any) -> gtsam.NonlinearFactor:
        return gtsam.RangeFactorPose3(pose, other, value, noise)

    def to_polar(self, value: Array, covariance: Array) -> tuple[Array, Array]:
        """The covariance of the bearing is in the basis of the Unit3 that `observe` makes."""
        x, y, z = (float(v) for v in value)
        r = sqrt(x * x + y * y + z * z)
        polar = np.array([atan2(y, x), atan2(z, sqrt(x * x + y * y)), r])
        # Rounding can decide which basis a direction has: this is the very vector that `observe` uses.
        basis = gtsam.Unit3(self.direction(polar[0], polar[1])).basis()
        jacobian = np.vstack([basis.T / r, np.array([[x, y, z]]) / r])
        return polar, jacobian @ covariance @ jacobian.T

    def to_cartesian(self, value: Array, covariance: Array) -> tuple[Array, Array]:
        direction = self.direction(value[0], value[1])
        jacobian = np.column_stack([self._turns(value) * value[2], direction])
        return direction * value[2], jacobian @ covariance @ jacobian.T

    def bearing_noise(self, value: Array, covariance: Array) -> Array:
        """In the basis of the Unit3 that `observe` makes."""
        basis = gtsam.Unit3(self.direction(value[0], value[1])).basis()
        jacobian = np.eye(len(covariance))
        jacobian[:2, :2] = basis.T @ self._turns(value)
        return np.asarray(jacobian @ covariance @ jacobian.T)

    def _turns(self, value: Array) -> Array:
        """(3, 2) derivative of the direction by azimuth and elevation; a covariance must stay definite at the zenith."""
        a, e = float(value[0]), float(value[1])
        level = cos(e) if abs(cos(e)) > ZENITH else ZENITH
        return np.array(
            [[-level * sin(a), -sin(e) * cos(a)], [level * cos(a), -sin(e) * sin(a)], [0.0, cos(e)]]
        )

    def direction(self, azimuth: float, elevation: float) -> Array:
        c = cos(elevation)
        return np.array([c * cos(azimuth), c * sin(azimuth), sin(elevation)])

    def estimate(self, solver: Any, key: int) -> Pose:
        return solver.calculateEstimatePose3(key)

    def estimate_point(self, solver: Any, key: int) -> Array:
        return np.asarray(solver.calculateEstimatePoint3(key))

    def pose_in(self, values: gtsam.Values, key: int) -> Pose:
        return values.atPose3(key)

    def point_in(self, values: gtsam.Values, key: int) -> Array:
        return np.asarray(values.atPoint3(key))

    def sevens(self, values: gtsam.Values, keys: Sequence[int]) -> Array:
        if not keys:
            return np.zeros((0, 7))
        return seven_of_matrix(np.stack([values.atPose3(key).matrix() for key in keys]))

    def sevens_of(self, numbers: Array) -> Array:
        return seven_of_matrix(numbers.reshape(-1, 3, 4))


SPACES: dict[str, Space] = {"2d": Planar(), "3d": Spatial()}  # type: ignore[dict-item]
