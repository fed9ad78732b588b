"""Proof by sampling, for everything that carries a covariance; and a drive that most tests of the whole core begin from."""

import numpy as np
import pytest

from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.relative import RelativePose

SIDE = 8  # keyframes of each side of the square


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
