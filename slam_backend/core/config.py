"""Every setting, once: type, default, range, unit and a sentence. YAML, `--help` and docs are derived from here.

In YAML the sources are named in a list and described at the top level, so that the same file serves the node:

    space: 2d
    sources: [wheels, trees]
    wheels: {kind: odometry, topic: /odom}
    trees: {kind: landmark, topic: /trees, kernel: cauchy}
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic.fields import FieldInfo

from .errors import BadConfig

LIVE: dict[str, Any] = {"live": True}  # settings that a running node takes; all others are read-only there

MOST_TOLD = 3  # mistakes in one line

KernelName = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs"]
StageName = Literal["gate", "witness", "pcm", "gnc", "switchable", "max_mixture", "rrr"]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Keyframes(Section):
    """When a pose variable is made: as soon as one of these is reached."""

    distance: float = Field(0.5, gt=0, le=1000, description="metres travelled since the last keyframe")
    angle: float = Field(0.2, gt=0, le=6.3, description="radians turned since the last keyframe")
    time: float | None = Field(
        None, gt=0, description="seconds since the last keyframe; none: never for time alone"
    )
    every: bool = Field(False, description="a keyframe at every message of the driving source")


class Settle(Section):
    """Measurements are put in the order of their stamps before they are used."""

    lag: float = Field(
        0.2, ge=0, le=60, description="seconds that a measurement waits for others with older stamps"
    )
    ahead: float = Field(
        600.0,
        gt=0,
        le=1e9,
        description="seconds by which stamps may be ahead of the driving source; beyond, clocks differ: refused",
    )


class Isam2(Section):
    """Incremental smoothing (Kaess et al., IJRR 2012)."""

    relinearize_threshold: float = Field(
        0.1, gt=0, description="change of a variable (m, rad) that relinearizes it"
    )
    relinearize_skip: int = Field(
        10, ge=1, le=1_000_000, description="updates between two looks at that threshold"
    )
    wildfire_threshold: float = Field(
        1e-4, ge=0, description="change (m, rad) below which an update is not carried on to older variables"
    )
    extra_updates: int = Field(
        2,
        ge=0,
        le=20,
        description="largest number of further updates after a loop, until nothing relinearizes",
    )
    factorization: Literal["auto", "cholesky", "qr"] = Field(
        default="auto", description="auto: Cholesky, and QR for the rest of the run once Cholesky has failed"
    )


class Journaling(Section):
    """The node's journal. A record is acknowledged, and applied, once it has been written and synced to the disk."""

    commit: Literal["group", "full"] = Field(
        default="group",
        description="what shares one sync (fsync) to the disk. group: all records that come within commit_delay; "
        "full: nothing, each record is synced by itself and at once",
    )
    commit_delay: float = Field(
        0.05,
        ge=0,
        le=10,
        description="seconds that a record waits for others to be synced with; what power loss can take at most",
    )
    resume: Literal["unfinished", "always", "never"] = Field(
        default="unfinished",
        description="when a start goes on with the session in data_dir. unfinished: when its process did not end it "
        "(kill, power loss); always: after a regular end, too; never: the journal is set aside",
    )


class Gate(Section):
    """Refuses a loop that contradicts the cheapest path between its ends, through odometry and accepted loops."""

    odometry_scale: float = Field(
        10.0,
        gt=0,
        le=10_000,
        description="what the odometry's covariance is multiplied by: stated noise leaves out bias and correlation in time",
    )
    probability: float = Field(
        0.999, gt=0, lt=1, description="with which a true loop passes, if all noise is as stated and scaled"
    )
    drift: float = Field(
        0.1,
        gt=0,
        le=10,
        description="m of drift per m of path that odometry never exceeds, whatever its covariance; twice that, in rad, of heading",
    )


class Witness(Section):
    """Keeps a far loop on probation until others agree with it over short odometry (PCM: Mangelson et al., ICRA 2018)."""

    others: int = Field(
        2, ge=1, le=20, description="loops that must agree with a far one, and with each other"
    )
    near: float = Field(
        2.0,
        ge=0,
        le=1e6,
        description="m: a loop needs no witness where odometry and accepted loops already say to within this where it ends",
    )
    reach: float = Field(
        50.0, gt=0, le=1e6, description="m of odometry, both ends together, over which two loops are compared"
    )
    apart: float = Field(
        1.0,
        ge=0,
        le=1e6,
        description="m of odometry, both ends together, below which two loops are the same evidence",
    )
    lone: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="a far loop enters without witnesses if it lies within this probability of where it is expected; 0: never",
    )
    held: int = Field(
        2000, ge=1, le=1_000_000, description="loops kept on probation; the oldest of more is refused"
    )


class Pcm(Section):
    """Pairwise consistency maximization: the largest set of loops that agree (Mangelson et al., ICRA 2018)."""

    probability: float = Field(
        0.99, gt=0, lt=1, description="with which two true loops agree, if all noise is as stated and scaled"
    )
    smallest: int = Field(2, ge=1, le=100, description="loops that the set must have at least")
    steps: int = Field(
        20_000,
        ge=1,
        le=100_000_000,
        description="loops looked at in the search for one new loop; beyond, it is not exact",
    )


class Gnc(Section):
    """Graduated non-convexity, aside (Yang et al., RA-L 2020)."""

    every: int = Field(200, ge=1, le=1_000_000, description="keyframes from one judgment to the next")
    lag: int = Field(
        50, ge=1, le=1_000_000, description="keyframes from the begin of a judgment to its landing"
    )


class Switchable(Section):
    """Switchable constraints in closed form (Sünderhauf & Protzel, IROS 2012; Agarwal et al., ICRA 2013)."""

    phi: float = Field(
        1.0,
        gt=0,
        le=1e6,
        description="what it costs to switch a loop off; a chi-square up to this is left alone by dcs",
    )
    form: Literal["dcs", "exact"] = Field(
        default="dcs", description="dcs: dynamic covariance scaling; exact: the quadratic prior of the paper"
    )


class MaxMixture(Section):
    """Each loop as it is or a null hypothesis, whichever is likelier (Olson & Agarwal, IJRR 2013)."""

    weight: float = Field(0.01, gt=0, lt=1, description="of the null hypothesis")
    scale: float = Field(1e-12, gt=0, lt=1, description="of the information, in the null hypothesis")


class Rrr(Section):
    """Clusters of loops that agree within and between, aside (Latif et al., IJRR 2013)."""

    gap: float = Field(
        10.0, ge=0, le=1e6, description="m of odometry between neighbours in a cluster, at each end"
    )
    every: int = Field(500, ge=1, le=1_000_000, description="keyframes from one judgment to the next")
    lag: int = Field(
        50, ge=1, le=1_000_000, description="keyframes from the begin of a judgment to its landing"
    )


class Floor(Section):
    """Where a robot on a floor is in space 3d. Off as it stands: each number that is given adds a prior to every keyframe."""

    z: float | None = Field(None, gt=0, le=1e6, description="m around 0: height of the base in the map")
    tilt: float | None = Field(
        None,
        gt=0,
        le=3.2,
        description="rad by which the base's z leans from the map's, each way (roll and pitch)",
    )


class Quarantine(Section):
    """Landmarks that moved, move, or exist twice are taken out, by the history of their residuals."""

    sightings: int = Field(
        5,
        ge=2,
        le=30,
        description="of the last 30 that do not fit, where other landmarks do, before a landmark is suspected",
    )
    probability: float = Field(
        0.999,
        gt=0,
        lt=1,
        description="with which a sighting fits, if noise is as stated (or as usual, if that is more)",
    )


class PathOutput(Section):
    """The node's ~/path: for eyes; complete trajectories go on ~/trajectory."""

    poses: int = Field(10_000, ge=1, description="newest keyframes in it", json_schema_extra=LIVE)
    rate: float = Field(1.0, gt=0, le=50, description="Hz at most", json_schema_extra=LIVE)


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
    calibrate: tuple[Literal["distance_scale", "turn_scale"], ...] = Field(
        (), description="constants that are estimated with the map; of the one that drives"
    )
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
    calibrate: tuple[Literal["range_scale", "time_offset", "mount", "translation", "rotation"], ...] = Field(  # type: ignore[assignment]  # one more
        (),
        description="constants that are estimated with the map. range_scale; time_offset; translation, rotation, mount (both) of "
        "the sensor's frame",
    )
    sigma_position: float = Field(
        0.1, gt=0, le=1e6, description="m, for positions without noise of their own"
    )
    sigma_range: float = Field(0.1, gt=0, le=1e6, description="m, for ranges without noise of their own")
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


class Earth(Section):
    """Where the map lies on the earth, for sources of kind gnss: estimated, from what is known beforehand."""

    origin: tuple[float, float, float] | None = Field(
        None,
        description="latitude, longitude (degrees, WGS-84) and altitude (m) of the origin of east, north, up; none: the first fix",
    )
    yaw: float | None = Field(
        None,
        ge=-6.3,
        le=6.3,
        description="rad from east to the map's x axis, counter-clockwise; none: found from the path",
    )
    sigma_yaw: float = Field(0.05, gt=0, le=3.2, description="rad, of that yaw where it is given")
    sigma_level: float = Field(
        0.1, gt=0, le=3.2, description="rad by which the map's z may lean from the vertical (3d)"
    )
    baseline: float = Field(
        5.0, gt=0, le=1e6, description="m that the fixes must reach over before a yaw is looked for"
    )
    yaw_within: float = Field(
        0.2,
        gt=0,
        le=1.5,
        description="rad to which two fixes that far apart must tell the yaw before it is looked for",
    )

    @field_validator("origin")
    @classmethod
    def _on_earth(cls, origin: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if origin is not None and not (abs(origin[0]) < 90 and abs(origin[1]) <= 180):
            raise ValueError("latitude lies within 90 degrees, longitude within 180")
        return origin


class Config(Section):
    """The whole configuration; `Config()` works for one odometry topic and standard loop closures."""

    space: Literal["2d", "3d"] = Field("3d", description="2d: x, y and yaw are estimated; 3d: all six")
    base_frame: str = Field("", description="name of the robot's frame; empty: that of the driving source")
    keyframes: Keyframes = Keyframes()
    settle: Settle = Settle()
    isam2: Isam2 = Isam2()
    gate: Gate = Gate()
    witness: Witness = Witness()
    pcm: Pcm = Pcm()
    gnc: Gnc = Gnc()
    switchable: Switchable = Switchable()
    max_mixture: MaxMixture = MaxMixture()
    rrr: Rrr = Rrr()
    robust: tuple[StageName, ...] = Field(
        ("gate", "witness"),
        description="what judges loops before they enter the graph, in this order; empty: nothing does",
    )
    map_frame: str = Field(
        "map", description="name of the frame of the optimized trajectory, in what the node publishes"
    )
    odom_frame: str = Field("odom", description="name of the odometry's frame, in what the node publishes")
    data_dir: str = Field(
        "", description="where the node keeps its journal and saved runs; empty: ~/.ros/slam_backend/<node>"
    )
    autostart: bool = Field(default=True, description="the node configures and activates itself")
    on_clock_jump: Literal["reset", "ignore"] = Field(
        default="ignore",
        description="when stamps of the driving source jump back (a looped bag): start anew, or refuse them",
    )
    journal: Journaling = Journaling()
    floor: Floor = Floor()
    quarantine: Quarantine = Quarantine()
    path: PathOutput = PathOutput()
    earth: Earth = Earth()
    extrinsics: Mapping[str, tuple[float, float, float, float, float, float]] = Field(
        default_factory=dict,
        description="frame: x, y, z (m), roll, pitch, yaw (rad) of that sensor in the base",
    )
    sources: Mapping[str, AnySource] = Field(
        default_factory=dict, description="the inputs by name; empty: found by the types of the topics"
    )

    @model_validator(mode="after")
    def _something_drives(self) -> "Config":
        for name in self.sources:
            if not name or "/" in name or "@" in name:
                raise ValueError(f"source name '{name}' must not be empty or contain '/' or '@'")
            if name in Config.model_fields or name in ("gauge", "datum", "command", "floor"):
                raise ValueError(f"a source cannot be called '{name}': that name has a meaning of its own")
        if len(set(self.robust)) < len(self.robust):
            raise ValueError(f"'robust' names '{max(self.robust, key=self.robust.count)}' twice")
        if self.space == "2d" and (self.floor.z or self.floor.tilt):
            raise ValueError("'floor' needs space: 3d; in 2d nothing leaves the plane")
        flat = [
            name for name, source in self.sources.items() if self.space == "2d" and source.kind == "pixels"
        ]
        if flat:
            raise ValueError(
                f"source '{flat[0]}': pixels need space 3d: where a feature is seen depends on height, roll and pitch"
            )
        if self.sources and self.driver is None:
            raise ValueError("no source drives the keyframes: add one of kind odometry, imu or relative")
        imus = [name for name, source in self.sources.items() if source.kind == "imu"]
        if imus and self.space == "2d":
            raise ValueError(
                f"source '{imus[0]}': an IMU needs space: 3d, since in a plane nothing tells how gravity lies; "
                "a robot on a floor takes 3d, too"
            )
        if imus[1:]:
            raise ValueError(f"source '{imus[1]}': a second IMU; '{imus[0]}' is the one that is used")
        return self

    @property
    def driver(self) -> str | None:
        """The source that drives the keyframes: the first odometry, else the IMU, else the first relative."""
        for kind in ("odometry", "imu", "relative"):
            for name, source in self.sources.items():
                if source.kind == kind:
                    return name
        return None


def config_from(data: Mapping[str, Any], origin: str = "config") -> Config:
    """Build a Config from what a YAML file holds; BadConfig names `origin`, the setting and what to do.

    A file for the node (`<node>: {ros__parameters: {...}}`) is taken as well.
    """
    if (
        len(data) == 1
        and isinstance(inner := next(iter(data.values())), Mapping)
        and isinstance(inner.get("ros__parameters"), Mapping)
    ):
        data = inner["ros__parameters"]
    flat = dict(data)
    listed = flat.get("sources", [])
    if isinstance(listed, str):
        raise BadConfig(f"{origin}: 'sources' is a list of names: write sources: [{listed}]")
    if isinstance(listed, (list, tuple)):
        if wrong := [name for name in listed if not isinstance(name, str)]:
            raise BadConfig(
                f"{origin}: 'sources' is a list of names, each described below it; it holds {wrong[0]!r}"
            )
        if len(set(listed)) < len(listed):
            raise BadConfig(f"{origin}: 'sources' names {max(listed, key=listed.count)!r} twice")
        if missing := [name for name in listed if name not in flat]:
            described = [name for name in flat if name not in Config.model_fields and name not in listed]
            close = get_close_matches(missing[0], described, n=1)
            add = f"did you mean '{close[0]}'?" if close else f"add '{missing[0]}: {{kind: ...}}'"
            raise BadConfig(
                f"{origin}: source '{missing[0]}' is listed in 'sources' but not described: {add}"
            )
        flat["sources"] = {name: flat.pop(name) for name in listed}
    try:
        return Config.model_validate(flat)
    except ValidationError as error:
        raise BadConfig(f"{origin}: {_told(error, flat)}") from None


def config_to(config: Config) -> dict[str, Any]:
    """The effective configuration as YAML holds it; `config_from` gives the same Config back."""
    data = config.model_dump(mode="json")
    sources = data.pop("sources")
    return {**data, "sources": list(sources), **sources}


def words_of(field: FieldInfo) -> tuple[str, ...]:
    """The words that a setting may be; none for one that is not a choice."""
    parts = (field.annotation, *get_args(field.annotation))
    return tuple(dict.fromkeys(word for part in parts for word in get_args(part) if isinstance(word, str)))


def config_hash(config: Config) -> str:
    return hashlib.sha256(json.dumps(config_to(config), sort_keys=True).encode()).hexdigest()


def _told(error: ValidationError, data: Mapping[str, Any]) -> str:
    """The first few mistakes in one line."""
    errors = error.errors(include_url=False)
    sources = data.get("sources")
    names = list(sources) if isinstance(sources, Mapping) else []
    lines = [_one_told(each, names) for each in errors[:MOST_TOLD]]
    more = len(errors) - len(lines)
    return "; ".join(lines) + (f"; and {more} more" if more else "")


def _one_told(first: Any, names: Sequence[str]) -> str:
    """One mistake. names: of the sources."""
    parts = [str(part) for part in first["loc"]]
    if parts[:1] == ["sources"]:
        parts = [*parts[1:2], *parts[3:]]  # as in the file: without 'sources' and the kind
    where = ".".join(parts) or "the file"
    what = first["msg"].removeprefix("Value error, ")
    if first["type"] == "union_tag_invalid":
        what = f"there is no kind of source {first['ctx']['tag']!r}; known: {first['ctx']['expected_tags']}"
    if first["type"] == "union_tag_not_found":
        what = "is a source, and does not say its kind: add kind: odometry, relative, landmark, pose, gnss, imu or pixels"
    if first["type"] == "extra_forbidden":
        what = f"there is no such setting{_suggest(first['loc'], names)}"
    value = first.get("input")
    said = (
        f" (it says {value!r})"
        if isinstance(value, (str, int, float, bool)) and first["type"] != "extra_forbidden"
        else ""
    )
    return f"{where}: {what}{said}"


def _suggest(location: tuple[int | str, ...], names: Sequence[str]) -> str:
    """`; did you mean '...'?` for a misspelt key, from the settings of the section it stands in and, at the top, the sources."""
    *path, key = [str(part) for part in location]
    known: set[str] = {*Config.model_fields, *names}
    if path[:1] == ["sources"]:
        kinds: dict[str, type[Section]] = {
            "odometry": OdometrySource,
            "relative": RelativeSource,
            "landmark": LandmarkSource,
            "pose": PoseSource,
            "gnss": GnssSource,
            "imu": ImuSource,
            "pixels": PixelsSource,
        }
        known = set(kinds[path[-1]].model_fields) if path[-1] in kinds else set(kinds)
    elif path:
        section = Config.model_fields[path[0]].annotation
        known = set(getattr(section, "model_fields", {}))
    close = get_close_matches(key, known, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; known: {', '.join(sorted(known))}" if known else ""
