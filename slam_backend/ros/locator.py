"""~/odometry: where the robot is in the map, at once, at the rate of the odometry or of an IMU; never waits for the solver."""

from ..core.config import Config
from ..core.measurement import ImuSample, StaticTransform
from ..core.sensors.odometry import OdometryPose
from .intake import Flowing
from .outputs import Outputs
from .pose import Odometer, composed
from .propagation import Propagator
from .state import State

DEFAULT_ODOM = Config().odom_frame


class Locator:
    """Publishes with these outputs, from the newest answer in `state`. Of one session: another configuration, another Locator."""

    def __init__(self, config: Config, state: State, outputs: Outputs) -> None:
        self._config, self._state, self._outputs = config, state, outputs
        self._odometer, self._propagator = Odometer(config), Propagator(config)

    def moved(self, told: Flowing) -> None:
        """The driving odometry or the IMU said something sound, or where that is mounted."""
        if isinstance(told, StaticTransform):
            self._propagator.mounted(told)
        elif isinstance(told, ImuSample):
            self._by_imu(told)
        else:
            self._by_odometry(told)

    def _by_imu(self, sample: ImuSample) -> None:
        update = self._state.update
        carried = self._propagator.carry(sample, update, self._state.covariance)
        if update is None or carried is None:
            return
        self._outputs.odometry(sample.stamp, carried.seven, carried.covariance, twist=carried.twist)
        if self._propagator.drives:
            self._outputs.map_to_odom(sample.stamp, composed(update.correction, update.origin))

    def _by_odometry(self, odometry: OdometryPose) -> None:
        """Where an IMU carries on from the newest keyframe, that tells ~/odometry."""
        self._propagator.named(odometry.child)
        if not self._odometer.goes_on(odometry.stamp):
            return
        pose = self._odometer.locate(odometry, self._state.update, self._state.covariance)
        if pose is None:
            return
        if odometry.frame not in ("", self._config.map_frame) and self._config.odom_frame == DEFAULT_ODOM:
            self._outputs.odom_frame = odometry.frame
        if not self._propagator.carries(odometry.stamp):
            self._outputs.odometry(
                odometry.stamp,
                pose.seven,
                pose.covariance,
                odometry.child,
                odometry.twist,
                odometry.twist_covariance,
            )
        self._outputs.map_to_odom(odometry.stamp, pose.correction)
