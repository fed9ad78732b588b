"""The inputs: one section per kind of source."""

from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator

from .section import Section

KernelName = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs"]


class Source(Section):
    """What every source has."""

    topic: str = Field("", description="topic in the bag or on the network")

    @property
    def topics(self) -> tuple[str, ...]:
        """All that belong to the source."""
        return (self.topic,)


class Observing(Source):
    """A source whose measurements become one factor each."""

    kernel: KernelName = Field("none", description="robust kernel around the noise of each factor")
    kernel_width: float | None = Field(
        None, gt=0, description="the kernel's parameter, in standard deviations; none: its usual one"
    )
    keyframe: bool = Field(
        False,
        description="make a keyframe at the stamp of each measurement instead of composing motion into it",
    )


class Mounted(Observing):
    """A source whose sensor has a place on the robot and a clock, both of which may be a little wrong."""

    time_offset: float = Field(
        0.0, ge=-10, le=10, description="seconds that are added to the stamps of its messages"
    )
    calibrate: tuple[Literal["time_offset", "mount", "translation", "rotation"], ...] = Field(
        (),
        description="constants that are estimated with the map. time_offset; translation, rotation, mount (both) of the sensor's "
        "frame",
    )


class OdometrySource(Source):
    """Pose of the base, or of a sensor on it, in a drifting frame. The first odometry source drives the keyframes; others add edges
    between them.
    """

    kind: Literal["odometry"] = "odometry"
    noise: Literal["model", "twist", "pose"] = Field(
        "model",
        description="model: the sigmas below; twist: integrated twist covariance; pose: difference of pose covariances",
    )
    sigma_translation_per_meter: float = Field(
        0.05, ge=0, le=1e6, description="m after 1 m of path; grows with its square root"
    )
    sigma_translation_per_radian: float = Field(
        0.02, ge=0, le=1e6, description="m after 1 rad turned; grows with its square root"
    )
    sigma_rotation_per_meter: float = Field(
        0.01, ge=0, le=1e6, description="rad after 1 m of path; grows with its square root"
    )
    sigma_rotation_per_radian: float = Field(
        0.05, ge=0, le=1e6, description="rad after 1 rad turned; grows with its square root"
    )
    sigma_translation_floor: float = Field(
        0.002, gt=0, le=1e6, description="m, added to every edge between keyframes"
    )
    sigma_rotation_floor: float = Field(
        0.0005, gt=0, le=1e6, description="rad, added to every edge between keyframes"
    )
    planar: bool = Field(
        False,
        description="space 3d: only x, y and yaw of its motion are known (wheels); the rest is left to others",
    )
    distance_scale: float = Field(
        1.0, gt=0.1, lt=10, description="how many times too long its distances are; of the one that drives"
    )
    turn_scale: float = Field(
        1.0, gt=0.1, lt=10, description="how many times too large its turns are; of the one that drives"
    )
    distance_per_radian: float = Field(
        0.0,
        ge=-10,
        le=10,
        description="m that it tells too many for each rad turned, either way (wheels that slip or lag in turns); of the one that drives",
    )
    turn_per_meter: float = Field(
        0.0,
        ge=-10,
        le=10,
        description="rad that it turns too far to the left for each m ahead (unequal wheels); of the one that drives",
    )
    calibrate: tuple[
        Literal["distance_scale", "turn_scale", "distance_per_radian", "turn_per_meter"], ...
    ] = Field((), description="constants that are estimated with the map; of the one that drives")
    max_speed: float = Field(100.0, gt=0, description="m/s; a faster step is a teleport and is refused")
    sigma_acceleration: float = Field(
        1.0,
        gt=0,
        le=1e6,
        description="m/s^2 in 1 s, white: how far constant velocity is believed where the odometry has restarted",
    )
    sigma_angular_acceleration: float = Field(1.0, gt=0, le=1e6, description="rad/s^2 in 1 s, likewise")


class RelativeSource(Observing):
    """Pose of one moment in another: loop closures; motion too when there is no odometry source."""

    kind: Literal["relative"] = "relative"
    sigma_translation: float = Field(
        0.1, gt=0, le=1e6, description="m, where the message's covariance is zero"
    )
    sigma_rotation: float = Field(
        0.05, gt=0, le=1e6, description="rad, where the message's covariance is zero"
    )


class LandmarkSource(Mounted):
    """Observations of landmarks, with ids or without."""

    kind: Literal["landmark"] = "landmark"
    frame: str = Field(
        "",
        description="frame of the sensor, for messages that do not name it (sensor_msgs/Range); empty: the base",
    )
    range_scale: float = Field(
        1.0, gt=0.1, lt=10, description="how many times too long its ranges are; they are divided by it"
    )
    association: Literal["joint", "nearest"] = Field(
        default="joint",
        description="how a sighting without an id finds its landmark. joint: the largest set of pairs that are compatible together "
        "(JCBB: Neira & Tardos, 2001); nearest: the closest pairs, each by itself",
    )
    ignore_ids: bool = Field(
        default=False, description="ids in messages mean nothing: sightings are associated"
    )
    gate: float = Field(
        0.99,
        gt=0,
        lt=1,
        description="probability with which a true pair of sighting and landmark passes (chi-square)",
    )
    confirmations: int = Field(
        2, ge=1, le=100, description="sightings without an id that make a landmark; until then they wait"
    )
    search: float = Field(
        10.0,
        ge=0,
        le=1e6,
        description="m around a sighting in which its landmark is looked for, and by which a consensus of sightings may correct the "
        "pose where fewer than half find their landmark",
    )
    merge: int = Field(
        5,
        ge=0,
        le=100_000,
        description="scans that must have shown each of two landmarks without ids before they can be found to be one; 0: they never are",
    )
    calibrate: tuple[Literal["range_scale", "time_offset", "mount", "translation", "rotation"], ...] = Field(  # type: ignore[assignment]  # one more
        (),
        description="constants that are estimated with the map. range_scale; time_offset; translation, rotation, mount (both) of "
        "the sensor's frame",
    )
    sigma_position: float = Field(
        0.1, gt=0, le=1e6, description="m, for positions without noise of their own"
    )
    orientation: bool = Field(
        default=True,
        description="tags that are told with an orientation count with it; false: by their position alone. A small image tells the "
        "orientation badly, and of two ways at that",
    )
    sigma_rotation: float = Field(
        0.1, gt=0, le=1e6, description="rad, for the orientation of tags without noise of their own"
    )
    sigma_range: float = Field(0.1, gt=0, le=1e6, description="m, for ranges without noise of their own")
    sigma_range_per_meter: float = Field(
        0.0,
        ge=0,
        le=10,
        description="of the range, likewise: 0.02 for a sensor that is good to 2 %; variances add, with that of sigma_range",
    )
    sigma_bearing: float = Field(
        0.02, gt=0, le=1e6, description="rad, for bearings without noise of their own"
    )


class PoseSource(Mounted):
    """Absolute pose of the base in the map frame (a localizer, /initialpose)."""

    kind: Literal["pose"] = "pose"
    sigma_translation: float = Field(
        0.5, gt=0, le=1e6, description="m, where the message's covariance is zero"
    )
    sigma_rotation: float = Field(
        0.25, gt=0, le=1e6, description="rad, where the message's covariance is zero"
    )


class GnssSource(Mounted):
    """Positions on the earth. The lever arm is the mounting of the message's frame (extrinsics)."""

    kind: Literal["gnss"] = "gnss"
    sigma_horizontal: float = Field(
        2.5, gt=0, le=1e6, description="m east and north, where the message states no covariance"
    )
    sigma_vertical: float = Field(
        5.0, gt=0, le=1e6, description="m up, where the message states no covariance"
    )
    sigma_floor: float = Field(
        0.02, gt=0, le=1e6, description="m: no fix counts as more certain, whatever its message says"
    )
    probability: float = Field(
        0.999,
        gt=0,
        lt=1,
        description="with which a true fix passes, if all noise is as stated; others are doubted",
    )
    agreeing_for: float = Field(3.0, ge=0, le=3600, description="s over which these must reach at least")
    withhold: tuple[tuple[float, float], ...] = Field(
        (), description="spans [from, to] in s after its first fix, whose fixes are kept back as a truth"
    )
    withhold_every: int | None = Field(
        None, ge=2, description="every so many fixes one is kept back as a truth; none: all are used"
    )
    agreeing: int = Field(
        5, ge=2, le=1000, description="doubted fixes in a row that must agree with each other to be believed"
    )


class ImuNoise(NamedTuple):
    """White noise (density) and random walk of the bias (walk), as an Allan variance gives them; the bias when switched on."""

    gyroscope_density: float
    gyroscope_walk: float
    accelerometer_density: float
    accelerometer_walk: float
    sigma_gyroscope_bias: float
    sigma_accelerometer_bias: float


# Several times what data sheets say: vibration, mounting and scale come on top, and an IMU that is believed too much fights the rest.
IMU_PRESETS: Mapping[str, ImuNoise] = {
    "consumer": ImuNoise(2e-3, 1e-4, 2e-2, 2e-3, 5e-2, 0.5),
    "industrial": ImuNoise(5e-4, 2e-5, 5e-3, 5e-4, 1e-2, 0.2),
    "tactical": ImuNoise(5e-5, 2e-6, 1e-3, 5e-5, 1e-3, 0.03),
}


class ImuSource(Source):
    """Angular rates and accelerations, preintegrated between keyframes; drives these where there is no odometry."""

    kind: Literal["imu"] = "imu"
    preset: Literal["consumer", "industrial", "tactical"] = Field(
        "industrial",
        description="noise for what is not set below. consumer: a phone's; industrial: a good MEMS; tactical: a fibre-optic gyroscope",
    )
    noise: Literal["preset", "message"] = Field(
        "preset",
        description="where densities that are not set below come from. message: its covariances, taken as those of one sample",
    )
    gyroscope_density: float | None = Field(
        None, gt=0, le=10, description="rad/s/sqrt(Hz): white noise; of an Allan deviation, its value at 1 s"
    )
    gyroscope_walk: float | None = Field(
        None,
        gt=0,
        le=10,
        description="rad/s^2/sqrt(Hz): random walk of the bias; of an Allan deviation, the rising line's value at 3 s",
    )
    accelerometer_density: float | None = Field(
        None, gt=0, le=100, description="m/s^2/sqrt(Hz): white noise; of an Allan deviation, its value at 1 s"
    )
    accelerometer_walk: float | None = Field(
        None,
        gt=0,
        le=100,
        description="m/s^3/sqrt(Hz): random walk of the bias; of an Allan deviation, the rising line's value at 3 s",
    )
    sigma_gyroscope_bias: float | None = Field(
        None, gt=0, le=10, description="rad/s: how large the bias may be when the IMU is switched on"
    )
    sigma_accelerometer_bias: float | None = Field(
        None, gt=0, le=100, description="m/s^2: how large the bias may be when the IMU is switched on"
    )
    gravity: float = Field(9.81, gt=0, le=100, description="m/s^2: its magnitude where the robot drives")
    max_rate: float | None = Field(
        None, gt=0, description="rad/s: end of the gyroscope's range; a sample there is saturated"
    )
    max_acceleration: float | None = Field(
        None, gt=0, description="m/s^2: end of the accelerometer's range; a sample there is saturated"
    )
    max_gap: float = Field(
        0.25, gt=0, le=60, description="seconds without a sample that are bridged; a longer silence is a gap"
    )
    start: Literal["auto", "rest", "motion"] = Field(
        "auto",
        description="rest: the robot stands still at first, so its gyroscope tells its bias; auto: by the looks of the first samples",
    )
    start_time: float = Field(
        1.0,
        gt=0,
        le=600,
        description="seconds of samples that tell gravity, and whether the robot stands still",
    )
    sigma_velocity: float = Field(
        10.0, gt=0, le=1e4, description="m/s: how fast the robot may be where nothing else tells"
    )
    keyframe_time: float = Field(
        1.0, gt=0, le=60, description="seconds between keyframes at most, where the IMU drives them"
    )

    @property
    def stated(self) -> ImuNoise:
        """The settings, and the preset for what is not set."""
        given = {name: getattr(self, name) for name in ImuNoise._fields}
        preset = IMU_PRESETS[self.preset]
        return preset._replace(**{name: value for name, value in given.items() if value is not None})


class Camera(Section):
    """Of a camera whose CameraInfo is not on a topic: all four of fx, fy, cx and cy; a baseline alone goes with a topic, too."""

    fx: float | None = Field(None, gt=0, le=1e6, description="focal length, pixels")
    fy: float | None = Field(None, gt=0, le=1e6, description="focal length, pixels")
    cx: float | None = Field(None, ge=-1e6, le=1e6, description="principal point, pixels from the left")
    cy: float | None = Field(None, ge=-1e6, le=1e6, description="principal point, pixels from the top")
    distortion: tuple[float, ...] = Field(
        (),
        max_length=8,
        description="of raw images: k1 k2 p1 p2 k3 (plumb_bob) k4 k5 k6 (rational_polynomial); empty: none",
    )
    baseline: float | None = Field(
        None, gt=0, le=1e3, description="m from the left to the right camera, where pixels are stereo"
    )

    @model_validator(mode="after")
    def _whole(self) -> "Camera":
        given = [name for name in ("fx", "fy", "cx", "cy") if getattr(self, name) is not None]
        if 0 < len(given) < 4:
            raise ValueError(f"needs all of fx, fy, cx and cy, and has only {', '.join(given)}")
        return self


class PixelsSource(Observing):
    """Features tracked through the images of a camera: pixels with ids; needs space 3d. kernel: of points, not of short tracks."""

    kind: Literal["pixels"] = "pixels"
    info_topic: str = Field(
        "",
        description="topic of the CameraInfo; of the right camera where pixels are stereo: it has the baseline",
    )
    camera: Camera = Field(default_factory=Camera, description="stands above info_topic")
    image: Literal["rectified", "raw"] = Field(
        default="rectified",
        description="what the pixels were found in: rectified uses P, raw K and the distortion",
    )
    sigma: float = Field(1.0, gt=0, le=1e3, description="pixels, where the message states none")
    point_after: int = Field(
        4,
        ge=2,
        le=1000,
        description="sightings after which a track is a point of its own; before, a smart factor. Stereo: always from 2 on",
    )
    share: float = Field(
        0.2,
        gt=0,
        le=10,
        description="a point is placed when the standard deviation of its distance is below this part of it",
    )
    probability: float = Field(
        0.9999,
        gt=0,
        le=1,
        description="with which a true sighting is taken, if all noise is as stated; 1: all are",
    )
    forget: int = Field(
        10,
        ge=1,
        le=10_000,
        description="frames unseen after which a track has ended: its id is another feature then",
    )

    @property
    def topics(self) -> tuple[str, ...]:
        return (self.topic, self.info_topic) if self.info_topic else (self.topic,)


AnySource = Annotated[
    OdometrySource | RelativeSource | LandmarkSource | PoseSource | GnssSource | ImuSource | PixelsSource,
    Field(discriminator="kind"),
]
