"""What the back-end keeps beside the graph: one object for what makes it grow (`drive.py`), what asks the sensors (`sensing.py`) and
what reads (`reading.py`).
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from .apply import Applier
from .calibration import Calibration
from .coast import NOISE, coasts, earth_from
from .config import Config, OdometrySource
from .errors import BadConfig, SlamError
from .fixes import Fixes
from .graph import Decision, Estimate, Keyframe, Pose, landmark_key, tag_key
from .inertial import State, Stretch, imu_name
from .keyframes import Timeline, Track
from .mounts import Mounts
from .parts import Parts
from .sensors.imu import bias_key, velocity_key
from .sessions import Tracks
from .solvers import Solver
from .space import SPACES
from .waiting import Waiting

Reason = Literal["moved", "duplicate", "moving"]  # why a landmark is in quarantine

SECOND_PLACE = "~2"  # after the id of a landmark that is at two places, of the one that was seen later


class Twins(NamedTuple):
    """Of an id that is at two places: the landmarks there. since: the stamp from which on it is at the second; None where both are there."""

    names: tuple[str, str]
    since: int | None


class Books:
    """driver, imu: names of the source that drives the keyframes, and of the IMU; of the latter empty where there is none.

    origin: of east, north, up: latitude, longitude, altitude; None before the first fix. landmarks: name -> key. became: key of one that was found
    to be another -> that of the other. twins: ids that are at two places. suspended: landmarks in quarantine, by key.
    newest: the newest keyframe, and its pose by the odometry. stretch: what the IMU measured up to the keyframe that is being made.
    decisions: told with the next update.
    """

    def __init__(self, config: Config, solver: Solver) -> None:
        self.config, self.solver, self.space = config, solver, SPACES[config.space]
        if config.driver is None:
            raise BadConfig(
                "no source drives the keyframes: add one of kind odometry, imu, relative, gnss or pose"
            )
        self.driver, self.imu = config.driver, imu_name(config)
        driving = config.sources[self.driver]
        told = driving if isinstance(driving, OdometrySource) else OdometrySource()
        self.track = Track(self.space, NOISE if coasts(config) else told)
        self.tracks = Tracks(self.track)
        self.timeline, self.parts = Timeline(), Parts()
        self.mounts = Mounts(self.space, config.base_frame, config.extrinsics)
        self.fixes, self.earth = Fixes(), earth_from(config)
        self.origin: Sequence[float] | None = config.earth.origin
        self.landmarks: dict[str, int] = {}
        self.became: dict[int, int] = {}
        self.twins: dict[str, Twins] = {}
        self.suspended: dict[int, Reason] = {}
        self.waiting, self.calibration = Waiting(config), Calibration(config, self.space)
        self.waiting.late = self.calibration.late
        self.applier = Applier(solver, self.space, self.parts, self.waiting.wake)
        self.newest: tuple[Keyframe, Pose] | None = None
        self.stretch: Stretch | None = None
        self.decisions: list[Decision] = []
        self.revision = 0

    @property
    def estimate(self) -> Estimate:
        """What the solver believes now. SlamError before the first keyframe."""
        if self.applier.estimate is None:
            raise SlamError("there is no keyframe yet: no message of the driving source has been accepted")
        return self.applier.estimate

    def landmark(self, name: str) -> int:
        """The key of a landmark by its name, that of another if it has been found to be one with it; a new name gets a new key."""
        key = self.landmarks.setdefault(name, landmark_key(len(self.landmarks)))
        while key in self.became:
            key = self.became[key]
        return key

    def tag(self, name: str) -> int:
        """The same of one that is seen with its orientation."""
        return self.landmarks.setdefault(name, tag_key(len(self.landmarks)))

    def state(self, keyframe: Keyframe) -> State | None:
        """What is believed of a keyframe that has velocity and bias."""
        estimate, v, b = self.applier.estimate, velocity_key(keyframe), bias_key(keyframe)
        if estimate is None or not (estimate.knows(v) and estimate.knows(b)):
            return None
        return State(keyframe.stamp, estimate.pose(keyframe.pose), estimate.value(v), estimate.value(b))

    def take_decisions(self) -> tuple[Decision, ...]:
        """Those since the last update, the applier's among them."""
        taken = (*self.decisions, *self.applier.take_decisions())
        self.decisions = []
        return taken
