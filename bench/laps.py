"""A planar robot that drives laps for as long as one likes: odometry at its rate, a loop to the lap before every ten seconds."""

from collections.abc import Iterator

import numpy as np

from slam_backend.core.config import Config, config_from
from slam_backend.core.measurement import SECOND, format_stamp
from slam_backend.io.encode import encode_odometry
from slam_backend.io.records import Record

ODOMETRY = "nav_msgs/msg/Odometry"
START = 1_700_000_000 * SECOND
RADIUS, SPEED = 20.0, 1.0  # m, m/s
LAP = 2 * np.pi * RADIUS / SPEED  # s
LOOP_EVERY = 10.0  # s
ZEROS = np.zeros(36)


def config() -> Config:
    return config_from(
        {
            "space": "2d",
            "sources": ["wheels", "loops"],
            "wheels": {"kind": "odometry", "topic": "/odom"},
            "loops": {"kind": "relative", "topic": "/loops"},
        }
    )


def laps(
    seconds: float, rate: float, seed: int = 0, parked: tuple[float, float] = (0.0, 0.0)
) -> Iterator[Record]:
    """rate: Hz of the odometry. parked: from when to when (s) the robot stands; no loops are found then."""
    rng = np.random.default_rng(seed)
    period = round(SECOND / rate)
    heading, position, driven, next_loop = 0.0, np.zeros(2), 0.0, LAP + LOOP_EVERY
    for n in range(round(seconds * rate)):
        stamp, moving = START + n * period, not parked[0] <= n / rate < parked[1]
        yield Record("/odom", ODOMETRY, stamp, _odometry(stamp, position, heading))
        if moving and driven >= next_loop:
            next_loop += LOOP_EVERY
            before = stamp - period * round(LAP * rate)
            if not parked[0] - LAP <= n / rate < parked[1] + LAP:  # a lap ago it drove, too
                yield Record("/loops", ODOMETRY, stamp + 1, _loop(before, stamp, rng))
        if moving:
            step = SPEED / rate
            turn = step / RADIUS + rng.normal(0, 0.002 / np.sqrt(rate))
            position = position + (step + rng.normal(0, 0.005 / np.sqrt(rate))) * np.array(
                [np.cos(heading), np.sin(heading)]
            )
            heading += turn
            driven += 1 / rate


def _odometry(stamp: int, position: np.ndarray, heading: float) -> bytes:
    seven = (*position, 0, 0, 0, np.sin(heading / 2), np.cos(heading / 2))
    return encode_odometry(stamp, "odom", "base", seven, ZEROS, ZEROS[:6], ZEROS)


def _loop(before: int, stamp: int, rng: np.random.Generator) -> bytes:
    """The robot is where it was a lap ago, as far as the detector can tell."""
    x, y, angle = rng.normal(0, (0.02, 0.02, 0.005))
    seven = (x, y, 0, 0, 0, np.sin(angle / 2), np.cos(angle / 2))
    frames = f"base@{format_stamp(before)}", f"base@{format_stamp(stamp)}"
    noise = np.diag([0.02**2] * 3 + [0.005**2] * 3)
    return encode_odometry(stamp, *frames, seven, noise, ZEROS[:6], ZEROS)
