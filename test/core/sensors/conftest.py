"""A robot on a known way: whatever a sensor makes of a true observation must fit the truth."""

from dataclasses import dataclass, field

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import OdometrySource
from slam_backend.core.context import Context
from slam_backend.core.graph import Offer, keyframe, landmark_key
from slam_backend.core.keyframes import Timeline, Track
from slam_backend.core.measurement import SECOND
from slam_backend.core.mounts import Mounts
from slam_backend.core.space import SPACES

KEYFRAMES = (2, 6, 11)  # s
STEP = SECOND // 4
LANDMARKS = {"oak": (6.0, 2.0, 1.5), "elm": (-3.0, 7.0, -2.0)}
MOUNTS = {"mast": (0.4, -0.3, 0.2, 0.1, -0.2, 0.9)}
NOISE = OdometrySource(
    noise="twist", sigma_translation_floor=1e-4, sigma_rotation_floor=1e-4, sigma_translation_per_meter=0.0
)


@dataclass
class World:
    """Odometry is true here: poses of the track are poses in the map. Keyframes 0, 1, 2 stand at 2, 6 and 11 s."""

    space: object
    covariance: np.ndarray  # of each step of the odometry
    known: set = field(default_factory=lambda: set(LANDMARKS))
    parts: dict = field(default_factory=dict)  # key -> part, where it is not 0
    placed: dict = field(default_factory=dict)

    def __post_init__(self):
        self.track, self.timeline = Track(self.space, NOISE), Timeline()
        self.mounts = Mounts(self.space, "base_link", MOUNTS)
        size = self.space.dimension
        twist = np.array([0.3, 0.02, 0.06]) if size == 3 else np.array([0.03, -0.05, 0.06, 0.3, 0.02, 0.04])
        pose = self.space.from_extrinsics((1.0, -2.0, 0.5, 0.2, -0.1, 0.7))
        for n in range(4 * 13):
            self.track.add(n * STEP, pose, self.covariance)
            self.track.protect()
            pose = pose.compose(self.space.expmap(twist))
        for index, seconds in enumerate(KEYFRAMES):
            self.timeline.add(keyframe(index, seconds * SECOND))
        self.points = {landmark_key(n): self.point(name) for n, name in enumerate(LANDMARKS)}

    def point(self, name) -> np.ndarray:
        return np.array(LANDMARKS[name][: self.space.point_dimension])

    def pose(self, key):
        return self.track.pose(self.timeline.keyframes[gtsam.symbolIndex(key)].stamp)

    def place(self, stamp):
        if stamp not in self.placed:
            self.placed[stamp] = self.timeline.place(stamp, self.track, self.space)
        return self.placed[stamp]

    def motion(self, stamp):
        """From the nearest keyframe to a stamp; None at a keyframe."""
        return self.place(stamp).motion

    def key(self, name) -> int:
        return landmark_key([*LANDMARKS, name].index(name))

    def component(self, key):
        if key in self.points and not any(self.key(name) == key for name in self.known):
            return None
        return self.parts.get(key, 0)

    def context(self) -> Context:
        estimate = _Truth(self)
        return Context(
            self.space, estimate, {}, self.mounts, self.place, self.track.motion, self.key, self.component
        )

    def values(self) -> gtsam.Values:
        values = gtsam.Values()
        for each in self.timeline.keyframes:
            values.insert(each.pose, self.track.pose(each.stamp))
        for key, point in self.points.items():
            values.insert(key, point)
        return values

    def wrongly(self, rng, stamp):
        """A true pose at a stamp, where the odometry since the keyframe was wrong by as much as it says."""
        motion = self.motion(stamp)
        if motion is None:
            return self.track.pose(stamp)
        error = rng.multivariate_normal(np.zeros(self.space.dimension), motion.covariance)
        keyframe_pose = self.track.pose(self.place(stamp).keyframe.stamp)
        return keyframe_pose.compose(motion.pose).compose(self.space.expmap(error))


@dataclass
class _Truth:
    world: World

    def pose(self, key):
        return self.world.pose(key)

    def point(self, key):
        return self.world.points[key]


@pytest.fixture(params=["2d", "3d"])
def world(request, spread) -> World:
    space = SPACES[request.param]
    sigmas = [2e-3, 1e-3, 1e-3] if request.param == "2d" else [1e-3, 5e-4, 8e-4, 2e-3, 1e-3, 3e-3]
    return World(space, spread(np.random.default_rng(99), sigmas))


@pytest.fixture
def offered():
    """Wrap measurements as a window."""
    return lambda *measurements: [Offer(f"{m.source}/{m.stamp}/{n}", m) for n, m in enumerate(measurements)]
