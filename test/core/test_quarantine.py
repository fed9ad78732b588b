"""Landmarks that do not stand still are found out, taken out with the reason, and do not bend the map."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.measurement import Measurement, frozen
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.trajectory import Trajectory
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import Simulation, simulate

OPTIONS = Options(poses=500, landmark_sigma=0.05, landmark_range=12.0, loop_rate=0.0, landmarks=25)
Displaced = Callable[
    [int, np.ndarray], np.ndarray | None
]  # which sighting of it, the point seen -> the point told


@pytest.fixture(scope="module")
def drive() -> Simulation:
    """Round a block, among 25 landmarks that are seen again and again."""
    return simulate("square", 2, OPTIONS)


def culprit(drive: Simulation) -> str:
    """The landmark that is seen most often."""
    seen = Counter(m.landmark for m in drive.measurements if isinstance(m, LandmarkObservation))
    return seen.most_common(1)[0][0]


def told(drive: Simulation, name: str, displaced: Displaced) -> Iterator[Measurement]:
    """The drive, with the sightings of one landmark as they are when it stands elsewhere in the map."""
    poses = dict(zip(drive.stamps.tolist(), Trajectory(drive.stamps, drive.sevens).poses, strict=True))
    count = 0
    for m in drive.measurements:
        if isinstance(m, LandmarkObservation) and m.landmark == name:
            pose = poses[m.stamp]
            there = displaced(count, pose[:3, :3] @ m.value + pose[:3, 3])
            count += 1
            if there is not None:
                yield replace(m, value=frozen((there - pose[:3, 3]) @ pose[:3, :3]))
        else:
            yield m


def ran(drive: Simulation, items: Iterator[Measurement], **settings: object) -> tuple[Backend, list]:
    backend = Backend(config_from({**drive.settings, **settings}))
    decisions = [d for item in items for update in backend.add(item) for d in update.decisions]
    return backend, decisions + [d for update in backend.finish() for d in update.decisions]


def error(drive: Simulation, backend: Backend) -> float:
    """Root mean square of the positions (m); both begin at the origin."""
    found = backend.snapshot().trajectory
    rows = np.searchsorted(drive.stamps, found.stamps)
    gaps = np.linalg.norm(found.sevens[:, :3] - drive.sevens[rows, :3], axis=1)
    return float(np.sqrt((gaps**2).mean()))


@pytest.mark.parametrize(
    ("reason", "displaced"),
    [
        ("moved", lambda n, point: point + (np.array([1.5, -1.0, 0.0]) if n >= 25 else 0.0)),
        ("duplicate", lambda n, point: point + (np.array([2.0, 0.5, 0.0]) if n // 3 % 2 else 0.0)),
        ("moving", lambda n, point: point + np.array([0.25 * n, 0.0, 0.0])),
    ],
)
def test_a_landmark_that_does_not_stand_still_is_taken_out_for_what_it_did(drive, reason, displaced) -> None:
    """With the reason; further sightings are refused; the path ends as good as it is without that landmark."""
    name = culprit(drive)
    backend, decisions = ran(drive, told(drive, name, displaced))
    removed = [d for d in decisions if d.stage == "quarantine" and d.verdict == "removed"]
    assert {d.reason for d in removed} == {reason}
    assert all(d.statistic is not None and d.statistic > d.threshold for d in removed)
    assert any(d.reason == "quarantined" and d.verdict == "refused" for d in decisions)
    assert (name in backend.snapshot().names) == (reason == "moved")
    without, _ = ran(drive, told(drive, name, lambda *_: None))
    assert error(drive, backend) <= 1.1 * error(drive, without) + 0.005


def test_a_tag_with_an_orientation_that_was_moved_is_taken_out_as_well(drive: Simulation) -> None:
    """The same drive, past tags that all look east; one is carried away in between."""
    poses = dict(zip(drive.stamps.tolist(), drive.sevens, strict=True))
    noise = frozen(np.diag([0.05**2] * 3 + [0.02**2] * 3))
    east = np.array([-1.0, -1.0, -1.0, 1.0])  # turns back what the robot is turned

    def tags(items: Iterator[Measurement]) -> Iterator[Measurement]:
        for m in items:
            if isinstance(m, LandmarkObservation):
                seen = np.concatenate([m.value, poses[m.stamp][3:] * east])
                yield replace(m, form="pose", value=frozen(seen), covariance=noise)
            else:
                yield m

    name = culprit(drive)
    moved = told(drive, name, lambda n, point: point + (np.array([1.5, -1.0, 0.0]) if n >= 25 else 0.0))
    backend, decisions = ran(drive, tags(moved))
    removed = [d for d in decisions if d.stage == "quarantine" and d.verdict == "removed"]
    assert {d.reason for d in removed} == {"moved"}
    assert len({d.basis["landmark"] for d in removed}) == 1
    assert name in backend.snapshot().orientations
    without, _ = ran(drive, tags(told(drive, name, lambda *_: None)))
    assert error(drive, backend) <= 1.1 * error(drive, without) + 0.005


def test_landmarks_that_stand_still_stay_even_if_their_noise_is_larger_than_they_say(
    drive: Simulation,
) -> None:
    """The drive as it is, and with sightings three times as bad as stated: nobody is suspected."""
    rng = np.random.default_rng(8)
    worse = (
        replace(m, value=frozen(m.value + rng.normal(0, 0.14, 3) * [1, 1, 0]))
        if isinstance(m, LandmarkObservation)
        else m
        for m in drive.measurements
    )
    for items in (drive.measurements, worse):
        _, decisions = ran(drive, items)
        assert not [d for d in decisions if d.stage == "quarantine"]


@pytest.mark.parametrize("reason", ["moved", "moving"])
def test_what_does_not_stand_still_is_found_out_within_a_budget_too(drive: Simulation, reason: str) -> None:
    """Of whose old sightings only those are left that say most."""
    name = culprit(drive)

    def displaced(n: int, point: np.ndarray) -> np.ndarray:
        return point + (np.array([1.5, -1.0, 0.0]) * (n >= 25) if reason == "moved" else [0.25 * n, 0.0, 0.0])

    _, decisions = ran(drive, told(drive, name, displaced), budget={"sightings": 30})
    assert {d.reason for d in decisions if d.stage == "quarantine"} == {reason}
