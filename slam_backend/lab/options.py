"""What a simulated drive is like: how long, how good the sensors are, what the channel does to messages."""

from dataclasses import dataclass, fields
from typing import Literal, get_args

from ..core.errors import BadConfig

Form = Literal["position", "bearing_range", "bearing", "range"]
FORMS: tuple[str, ...] = get_args(Form)
POSITIVE = (
    "loop_sigma_translation", "loop_sigma_rotation", "landmark_sigma", "landmark_sigma_bearing", "range_scale",
    "gyroscope_density", "gyroscope_walk", "gyroscope_bias",
    "accelerometer_density", "accelerometer_walk", "accelerometer_bias", "gnss_sigma", "pixel_sigma",
)  # fmt: skip
_FRACTIONS = (
    "feature_loss",
    "wrong_feature_rate",
    "loop_rate",
    "wrong_loop_rate",
    "dropout",
    "late",
    "duplicated",
)


@dataclass(frozen=True, slots=True)
class Options:
    """Metres, radians, seconds; fractions lie in 0 to 1.

    Odometry drifts as `core.config.OdometrySource` describes: variances grow with path and with rotation.
    """

    poses: int = 5000  # odometry messages, and poses of the ground truth
    period: float = 0.1  # s between two odometry messages
    sigma_translation_per_meter: float = 0.03  # m after 1 m of path
    sigma_translation_per_radian: float = 0.02  # m after 1 rad turned
    sigma_rotation_per_meter: float = 0.004  # rad after 1 m of path
    sigma_rotation_per_radian: float = 0.02  # rad after 1 rad turned
    loop_rate: float = 0.1  # fraction of the returns to a place that are noticed
    loop_range: float = 2.0  # m: how near counts as the same place
    loop_sigma_translation: float = 0.05  # m
    loop_sigma_rotation: float = 0.01  # rad
    loop_delay: float = 0.2  # s from the newer of the two moments to the message
    wrong_loop_rate: float = 0.0  # fraction of the loops that join two different places
    landmarks: int | None = None  # how many there are; None: as many as the scenario has
    landmark_range: float = 8.0  # m: how far they are seen
    landmark_form: Form = "position"  # what is told of one: position, bearing_range, bearing or range
    landmark_sigma: float = 0.1  # m, on each axis, or of the range
    landmark_sigma_bearing: float = 0.01  # rad
    range_scale: float = 1.0  # how many times too long the ranges are
    imu_rate: float = 0.0  # samples per second of an IMU at the base; 0: it has none
    gyroscope_density: float = 5e-4  # rad/s/sqrt(Hz), white noise
    gyroscope_walk: float = 2e-5  # rad/s^2/sqrt(Hz), of its bias
    gyroscope_bias: float = 5e-3  # rad/s, standard deviation when switched on
    accelerometer_density: float = 5e-3  # m/s^2/sqrt(Hz), white noise
    accelerometer_walk: float = 5e-4  # m/s^3/sqrt(Hz), of its bias
    accelerometer_bias: float = 0.05  # m/s^2, standard deviation when switched on
    gnss_every: int = 0  # odometry messages from one fix to the next; 0: there is no receiver
    gnss_sigma: float = 0.5  # m, on each axis
    gnss_yaw: float = 2.0  # rad: of the map in east, north, up, which nobody knows
    gnss_arm: float = 0.5  # m: how far before, beside and above the base the antenna is
    gnss_outage_start: float = 0.0  # s after the start: there is no fix from here ...
    gnss_outage: float = 0.0  # ... for this many seconds
    features: float = 8.0  # per m of path, where the scenario has a camera that tracks them
    feature_range: float = 20.0  # m: how far they are seen
    feature_loss: float = 0.02  # fraction of their sightings that are missing; what comes back has another id
    wrong_feature_rate: float = 0.0  # fraction of their sightings that are of something else
    pixel_sigma: float = 1.0  # pixels
    stereo_baseline: float = 0.0  # m to the right camera; 0: there is none
    dropout: float = 0.0  # fraction of the messages that never arrive
    silence_start: float = 0.0  # s after the start: nothing that is stamped from here ...
    silence: float = 0.0  # ... for this many seconds arrives
    late: float = 0.0  # fraction of the messages that arrive late ...
    late_delay: float = 1.0  # ... by this many seconds
    duplicated: float = 0.0  # fraction of the messages that arrive twice

    def __post_init__(self) -> None:
        """BadConfig names the option that makes no sense."""
        if self.landmark_form not in FORMS:
            raise BadConfig(f"landmark_form: is one of {', '.join(FORMS)} (it says {self.landmark_form})")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, str):
                continue
            if value is not None and not 0 <= value < float("inf"):
                raise BadConfig(f"{field.name}: must be finite and not negative (it says {value})")
            if field.name in _FRACTIONS and value > 1:
                raise BadConfig(f"{field.name}: is a fraction and must not exceed 1 (it says {value})")
        if self.poses < 2:
            raise BadConfig(f"poses: a drive needs at least 2 (it says {self.poses})")
        if 0 < self.imu_rate < 1 / self.period:
            raise BadConfig(
                f"imu_rate: must be at least that of the poses, {1 / self.period:g} Hz (it says {self.imu_rate})"
            )
        if self.period < 1e-6:
            raise BadConfig(f"period: must be at least 1e-6 s (it says {self.period})")
        for name in POSITIVE:
            if getattr(self, name) == 0:
                raise BadConfig(f"{name}: must be greater than 0")
