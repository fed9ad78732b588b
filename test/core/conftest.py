"""Proof by sampling, for everything that carries a covariance; and a drive that most tests of the whole core begin from."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pymap3d
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.graph import EARTH
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.gnss import Fix
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.space import SPACES
from slam_backend.core.trajectory import Trajectory
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import simulate

SIDE = 8  # keyframes of each side of the square
ORIGIN = (42.3758, -71.1474, 12.0)
ARM = (0.8, -0.3, 1.2)
YAW = 2.0  # rad, of the earth in the map
SIGMA = 0.3  # m, of a fix


class Walk:
    """A simulated drive among landmarks, and what comes of it when one of them is not where it was."""

    def __init__(self, scenario: str, seed: int, options: Options) -> None:
        self.drive = drive = simulate(scenario, seed, options)
        self.sightings = [m for m in drive.measurements if isinstance(m, LandmarkObservation)]
        self.most_seen = Counter(m.landmark for m in self.sightings).most_common(1)[0][0]
        self.poses = dict(
            zip(drive.stamps.tolist(), Trajectory(drive.stamps, drive.sevens).poses, strict=True)
        )

    def seen_at(self, sighting):
        """Where in the map."""
        pose = self.poses[sighting.stamp]
        return pose[:3, :3] @ sighting.value + pose[:3, 3]

    def told(self, displaced):
        """The drive, with the sightings of the landmark that is seen most often as `displaced` has them: which of them, the point seen
        -> the point told, or None.
        """
        count = 0
        for m in self.drive.measurements:
            if isinstance(m, LandmarkObservation) and m.landmark == self.most_seen:
                there = displaced(count, self.seen_at(m))
                count += 1
                if there is not None:
                    pose = self.poses[m.stamp]
                    yield replace(m, value=frozen((there - pose[:3, 3]) @ pose[:3, :3]))
            else:
                yield m

    def ran(self, items, **settings):
        """The back-end at the end, and all decisions. settings: beside those of the drive."""
        backend = Backend(config_from({**self.drive.settings, **settings}))
        decisions = [d for item in items for update in backend.add(item) for d in update.decisions]
        return backend, decisions + [d for update in backend.finish() for d in update.decisions]

    def error(self, backend) -> float:
        """Root mean square of the positions (m); both begin at the origin."""
        found = backend.snapshot().trajectory
        rows = np.searchsorted(self.drive.stamps, found.stamps)
        gaps = np.linalg.norm(found.sevens[:, :3] - self.drive.sevens[rows, :3], axis=1)
        return float(np.sqrt((gaps**2).mean()))


@pytest.fixture(scope="session")
def walk():
    return Walk


@pytest.fixture
def agree():
    """Assert that (N, d) zero-mean errors have the covariance stated: whitened by it they are standard normal.

    Each entry of the sample covariance and of the mean must lie within five standard deviations of its own.
    """

    def check(errors, covariance=None) -> None:
        errors = np.asarray(errors)
        count, dimension = errors.shape
        if covariance is not None:
            errors = np.linalg.solve(np.linalg.cholesky(covariance), errors.T).T
        sample = errors.T @ errors / count
        spread = np.sqrt((1 + np.eye(dimension)) / count)
        np.testing.assert_array_less(np.abs(sample - np.eye(dimension)), 5 * spread)
        np.testing.assert_array_less(np.abs(errors.mean(axis=0)), 5 / np.sqrt(count))

    return check


@pytest.fixture
def spread():
    """A random full covariance, every axis and correlation different: (rng, sigmas) -> (d, d)."""

    def make(rng, sigmas):
        size = len(sigmas)
        turn, _ = np.linalg.qr(rng.normal(size=(size, size)))
        correlation = turn @ np.diag(np.linspace(0.2, 1.8, size)) @ turn.T
        scale = np.sqrt(np.diag(correlation))
        return correlation / scale[:, None] / scale * np.outer(sigmas, sigmas)

    return make


def seven(x, y, yaw):
    return np.array([x, y, 0, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])


@pytest.fixture
def laps():
    """Two laps of a square, a metre and a second from one keyframe to the next; the odometry turns a little too far. In the
    second lap a loop at each corner closes back to the first.
    """
    pose, heading, seen, items = np.zeros(2), 0.0, {}, []
    for n in range(2 * 4 * SIDE):
        stamp, place = (n + 1) * SECOND, n % (4 * SIDE)
        if place in seen and place % SIDE == 0:
            items.append(loop(stamp, seen[place], stamp, (0.0, 0.0, 0.0)))
        items.append(
            OdometryPose(stamp, "odometry", "odom", "base", seven(*pose, heading), UNKNOWN, STILL, UNKNOWN)
        )
        seen.setdefault(place, stamp)
        pose = pose + np.array([np.cos(heading), np.sin(heading)])
        heading += (np.pi / 2 if n % SIDE == SIDE - 1 else 0) + 0.02
    return items


@pytest.fixture(name="loop")
def loop_fixture():
    """`loop(stamp, stamp_i, stamp_j, (x, y, yaw))`: a relative pose that is known at `stamp`."""
    return loop


def loop(stamp, stamp_i, stamp_j, motion):
    return RelativePose(stamp, "relative", stamp_i, stamp_j, "base", "base", seven(*motion), np.zeros(36))


@pytest.fixture
def road():
    """A robot with an antenna on a winding road, the yaw of its map unknown."""
    return SimpleNamespace(
        drive=drive, backend=on_earth, run=run_through, errors=errors, origin=ORIGIN, sigma=SIGMA
    )


def drive(space, seed=0, seconds=120):
    """Odometry along a winding road, once a second, and a fix with noise after each: (measurements, true poses on the earth)."""
    rng, space = np.random.default_rng(seed), SPACES[space]
    pose, odometry = space.identity, space.identity
    start = space.from_extrinsics((40.0, -25.0, 3.0, 0.0, 0.0, -YAW))  # earth_T_map
    items, truth = [], []
    arm = np.array(ARM[: space.point_dimension])
    for k in range(seconds):
        stamp = (k + 1) * SECOND
        seven = frozen(space.seven(odometry))
        items.append(OdometryPose(stamp, "wheels", "odom", "base", seven, UNKNOWN, STILL, UNKNOWN))
        truth.append(start.compose(pose))
        antenna = np.append(truth[-1].transformFrom(arm), np.zeros(3 - len(arm)))
        place = pymap3d.enu2geodetic(*(antenna + rng.normal(0, SIGMA, 3)), *ORIGIN)
        items.append(Fix(stamp, "gps", "antenna", frozen(place), frozen(np.eye(3) * SIGMA**2)))
        step = space.from_extrinsics((1.0, 0.0, 0.05 * np.sin(k / 9), 0.0, 0.0, 0.1 * np.sin(k / 10)))
        pose = pose.compose(step)
        noise = rng.normal(0, 1, space.dimension) * np.sqrt(np.diag(space.diagonal(0.01**2, 0.03**2)))
        odometry = odometry.compose(step).compose(space.expmap(noise))
    return items, truth


def on_earth(space, **more):
    sources = {"wheels": {"kind": "odometry"}, "gps": {"kind": "gnss"}, **more.pop("sources", {})}
    wheels = {"sigma_translation_per_meter": 0.03, "sigma_rotation_per_meter": 0.01}
    data = {"space": space, "sources": list(sources), **sources, "extrinsics": {"antenna": [*ARM, 0, 0, 0]}}
    return Backend(config_from({**data, "wheels": {**sources["wheels"], **wheels}, **more}))


def errors(found, truth) -> np.ndarray:
    """(N,) m between where the keyframes are believed to be on the earth, and where they are."""
    earth = found.estimate.pose(EARTH)
    return np.array(
        [
            np.linalg.norm(earth.between(found.estimate.pose(k.pose)).translation() - true.translation())
            for k, true in zip(found.timeline.keyframes, truth, strict=True)
        ]
    )


def run_through(found, items):
    decisions = [d for item in items for update in found.add(item) for d in update.decisions]
    decisions += [d for update in found.finish() for d in update.decisions]
    found.polish()
    return decisions
