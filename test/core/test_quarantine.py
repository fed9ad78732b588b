"""Landmarks that do not stand still are found out, taken out with the reason, and do not bend the map."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.measurement import frozen
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.lab.options import Options

OPTIONS = Options(poses=500, landmark_sigma=0.05, landmark_range=12.0, loop_rate=0.0, landmarks=25)
NEVER = {"split": 0}


@pytest.fixture(scope="module")
def drive(walk):
    """Round a block, among 25 landmarks that are seen again and again."""
    return walk("square", 2, OPTIONS)


@pytest.mark.parametrize(
    ("reason", "displaced"),
    [
        ("moved", lambda n, point: point + (np.array([1.5, -1.0, 0.0]) if n >= 25 else 0.0)),
        ("duplicate", lambda n, point: point + (np.array([2.0, 0.5, 0.0]) if n // 3 % 2 else 0.0)),
        ("moving", lambda n, point: point + np.array([0.25 * n, 0.0, 0.0])),
    ],
)
def test_a_landmark_that_does_not_stand_still_is_taken_out_for_what_it_did(drive, reason, displaced) -> None:
    """Where none is to be split. With the reason; further sightings are refused; the path ends as good as it is without that landmark."""
    name = drive.most_seen
    backend, decisions = drive.ran(drive.told(displaced), quarantine=NEVER)
    removed = [d for d in decisions if d.stage == "quarantine" and d.verdict == "removed"]
    assert {d.reason for d in removed} == {reason}
    assert all(d.statistic is not None and d.statistic > d.threshold for d in removed)
    assert any(d.reason == "quarantined" and d.verdict == "refused" for d in decisions)
    assert (name in backend.snapshot().names) == (reason == "moved")
    without, _ = drive.ran(drive.told(lambda *_: None))
    assert drive.error(backend) <= 1.1 * drive.error(without) + 0.005


def test_a_tag_with_an_orientation_that_was_moved_is_taken_out_as_well(drive) -> None:
    """The same drive, past tags that all look east; one is carried away in between."""
    sevens = dict(zip(drive.drive.stamps.tolist(), drive.drive.sevens, strict=True))
    noise = frozen(np.diag([0.05**2] * 3 + [0.02**2] * 3))
    east = np.array([-1.0, -1.0, -1.0, 1.0])  # turns back what the robot is turned

    def tags(items):
        for m in items:
            if isinstance(m, LandmarkObservation):
                seen = np.concatenate([m.value, sevens[m.stamp][3:] * east])
                yield replace(m, form="pose", value=frozen(seen), covariance=noise)
            else:
                yield m

    moved = drive.told(lambda n, point: point + (np.array([1.5, -1.0, 0.0]) if n >= 25 else 0.0))
    backend, decisions = drive.ran(tags(moved), quarantine=NEVER)
    removed = [d for d in decisions if d.stage == "quarantine" and d.verdict == "removed"]
    assert {d.reason for d in removed} == {"moved"}
    assert len({d.basis["landmark"] for d in removed}) == 1
    assert drive.most_seen in backend.snapshot().orientations
    without, _ = drive.ran(tags(drive.told(lambda *_: None)))
    assert drive.error(backend) <= 1.1 * drive.error(without) + 0.005


def test_landmarks_that_stand_still_stay_even_if_their_noise_is_larger_than_they_say(drive) -> None:
    """The drive as it is, and with sightings three times as bad as stated: nobody is suspected."""
    rng = np.random.default_rng(8)
    worse = (
        replace(m, value=frozen(m.value + rng.normal(0, 0.14, 3) * [1, 1, 0]))
        if isinstance(m, LandmarkObservation)
        else m
        for m in drive.drive.measurements
    )
    for items in (drive.drive.measurements, worse):
        _, decisions = drive.ran(items)
        assert not [d for d in decisions if d.stage in ("quarantine", "splitting")]


@pytest.mark.parametrize("reason", ["moved", "moving"])
def test_what_does_not_stand_still_is_found_out_within_a_budget_too(drive, reason: str) -> None:
    """Of whose old sightings only those are left that say most."""

    def displaced(n: int, point: np.ndarray) -> np.ndarray:
        return point + (np.array([1.5, -1.0, 0.0]) * (n >= 25) if reason == "moved" else [0.25 * n, 0.0, 0.0])

    _, decisions = drive.ran(drive.told(displaced), budget={"sightings": 30}, quarantine=NEVER)
    assert {d.reason for d in decisions if d.stage == "quarantine"} == {reason}
