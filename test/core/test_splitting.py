"""A landmark whose sightings lie at two places becomes two, each of them where something stands; what is one stays one."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.books import Twins
from slam_backend.core.command import Command
from slam_backend.core.config import config_from
from slam_backend.core.fingerprint import run_hash
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.landmark import NAMELESS, LandmarkObservation
from slam_backend.core.sensors.odometry import OdometryPose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.trajectory import Trajectory
from slam_backend.lab.options import Options

OPTIONS = Options(poses=500, landmark_sigma=0.05, landmark_range=12.0, loop_rate=0.0, landmarks=25)
BLOCK = Options(poses=600, landmark_sigma=0.05, landmark_range=10.0, landmarks=40, loop_rate=0.5)
LAP = 160  # poses of these
BESIDE = "6"  # a landmark of the block that is seen on the fourth lap, before the drive ends
AWAY = np.array([1.5, -1.0, 0.0])
NOTHING = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7)))


def moved(n, point):
    """Carried away once."""
    return point + (AWAY if n >= 25 else 0.0)


def twice(n, point):
    """One number on two barcodes, seen in turn."""
    return point + (AWAY if n // 3 % 2 else 0.0)


@pytest.fixture(scope="module")
def drive(walk):
    """Round a block, among 25 landmarks that are seen again and again."""
    return walk("square", 2, OPTIONS)


@pytest.fixture(scope="module", params=[moved, twice], ids=["moved", "duplicate"])
def split(request, drive):
    """Which it was, the back-end, and what it decided."""
    return request.param, *drive.ran(drive.told(request.param))


@pytest.fixture(scope="module")
def doubled(drive):
    return drive.ran(drive.told(twice))


def splits(decisions):
    return [d for d in decisions if d.stage == "splitting"]


def about(decisions, *stages):
    return {f"{d.stage}/{d.reason}" for d in decisions if d.stage in stages}


def truth(walked):
    """Where the landmark stands at first."""
    first = next(m for m in walked.sightings if m.landmark == walked.most_seen)
    return walked.seen_at(first)


def place(backend, name):
    snapshot = backend.snapshot()
    return snapshot.landmarks[snapshot.names.index(name)]


def test_both_places_are_in_the_map_under_the_id_and_the_id_with_a_suffix(drive, split) -> None:
    """Each where something stands; the path is as good as it is without that landmark."""
    _, backend, decisions = split
    assert not about(decisions, "quarantine")
    name = drive.most_seen
    assert np.linalg.norm(place(backend, name) - truth(drive)) < 0.25
    assert np.linalg.norm(place(backend, f"{name}~2") - truth(drive) - AWAY) < 0.25
    without, _ = drive.ran(drive.told(lambda *_: None))
    assert drive.error(backend) <= 1.1 * drive.error(without) + 0.005


def test_every_sighting_is_of_the_place_at_which_it_was_made(drive, split) -> None:
    """Those before the split, and those after it, which are sorted one by one."""
    displaced, backend, decisions = split
    name = drive.most_seen
    keys = {backend.landmark(name): 0, backend.landmark(f"{name}~2"): 1}
    stamps = [m.stamp for m in drive.sightings if m.landmark == name]
    there = [bool(np.any(displaced(n, np.zeros(3)))) for n in range(len(stamps))]
    kept = [f for f in backend.solver.factors.values() if f.kind == "landmark" and f.keys[1] in keys]
    assert len(kept) >= len(stamps) - 3
    assert all(keys[f.keys[1]] == there[stamps.index(f.stamp)] for f in kept)
    assert about(decisions, "landmark") >= {"landmark/sorted"}


def test_a_split_is_told_once_with_what_it_rests_on(drive, split) -> None:
    displaced, backend, decisions = split
    (told,) = splits(decisions)
    name = drive.most_seen
    assert (told.verdict, told.reason) == ("accepted", "moved" if displaced is moved else "duplicate")
    assert told.id == f"landmarks/{name}~2"
    assert told.basis["from"] == name
    assert told.statistic > told.threshold >= 4 * max(told.basis["spreads"])
    assert min(told.basis["stay"], len(told.basis["sightings"])) >= 5
    keys = {backend.solver.factors[id_].keys[1] for id_ in told.basis["sightings"]}
    assert keys == {backend.landmark(f"{name}~2")}


def test_in_space_as_in_the_plane(walk) -> None:
    spiral = walk("spiral", 3, replace(OPTIONS, poses=400, landmarks=60))
    backend, decisions = spiral.ran(spiral.told(twice))
    assert about(decisions, "splitting", "quarantine") == {"splitting/duplicate"}
    assert np.linalg.norm(place(backend, spiral.most_seen) - truth(spiral)) < 0.3
    assert np.linalg.norm(place(backend, f"{spiral.most_seen}~2") - truth(spiral) - AWAY) < 0.3


def test_a_tag_with_an_orientation_becomes_two_tags(drive) -> None:
    """All of them look east."""
    sevens = dict(zip(drive.drive.stamps.tolist(), drive.drive.sevens, strict=True))
    noise = frozen(np.diag([0.05**2] * 3 + [0.02**2] * 3))
    turned_back = np.array([-1.0, -1.0, -1.0, 1.0])

    def tags():
        for m in drive.told(moved):
            if isinstance(m, LandmarkObservation):
                seen = frozen(np.concatenate([m.value, sevens[m.stamp][3:] * turned_back]))
                yield replace(m, form="pose", value=seen, covariance=noise)
            else:
                yield m

    backend, decisions = drive.ran(tags())
    assert splits(decisions)
    assert not about(decisions, "quarantine")
    second = f"{drive.most_seen}~2"
    assert second in backend.snapshot().orientations
    assert np.linalg.norm(place(backend, second) - truth(drive) - AWAY) < 0.25
    assert about(decisions, "landmark") == {"landmark/sorted"}


def test_a_sighting_of_which_it_cannot_be_told_where_it_was_is_kept_out_with_the_reason(drive) -> None:
    """The last but one is at neither place; the last is so uncertain that it may be of both."""
    last = [m for m in drive.told(twice) if getattr(m, "landmark", "") == drive.most_seen][-2:]
    strays = {
        last[0].stamp: {"value": frozen(last[0].value + np.array([0.0, 6.0, 0.0]))},
        last[1].stamp: {"covariance": frozen(np.eye(3) * 4.0)},
    }
    items = (
        replace(m, **strays[m.stamp])
        if getattr(m, "landmark", "") == drive.most_seen and m.stamp in strays
        else m
        for m in drive.told(twice)
    )
    _, decisions = drive.ran(items)
    refused = {d.stamp: d.reason for d in decisions if d.stage == "landmark" and d.verdict == "refused"}
    assert {refused[last[0].stamp], refused[last[1].stamp]} == {"elsewhere", "ambiguous"}


def test_what_was_moved_is_taken_to_be_where_it_was_at_that_time(drive) -> None:
    """A sighting that may be of both places, of a landmark that was carried away once."""
    newest = [m for m in drive.told(moved) if getattr(m, "landmark", "") == drive.most_seen][-1]
    items = (
        replace(m, covariance=frozen(np.eye(3) * 4.0)) if m is newest or m.stamp == newest.stamp else m
        for m in drive.told(moved)
        if not isinstance(m, LandmarkObservation) or m.stamp < newest.stamp or m.landmark == newest.landmark
    )
    _, decisions = drive.ran(items)
    (told,) = [d for d in decisions if d.stage == "landmark" and d.stamp == newest.stamp]
    assert (told.reason, told.detail) == ("sorted", f"of {drive.most_seen}~2")


# -- landmarks without ids -----------------------------------------------------------------------


def confused(walked, name, apart):
    """Without ids. After two laps nothing is seen for one; then something that stands `apart` (m) from a landmark, as often as it takes; then the
    loops arrive, and the rest.
    """
    stamps, sightings, held = walked.drive.stamps.tolist(), 0, []
    for m in walked.drive.measurements:
        if isinstance(m, RelativePose) and max(m.ends) >= stamps[2 * LAP] and sightings < 8:
            held.append(m)
        elif not isinstance(m, LandmarkObservation):
            yield m
        elif m.stamp < stamps[2 * LAP]:
            yield replace(m, landmark=NAMELESS)
        elif m.stamp >= stamps[3 * LAP]:
            pose, is_it = walked.poses[m.stamp], m.landmark == name
            sightings += is_it
            if sightings >= 8:
                yield from (replace(loop, stamp=m.stamp) for loop in held)
                held = []
            if is_it or sightings >= 8:
                aside = pose[:3, :3].T @ [apart, 0, 0] if is_it else np.zeros(3)
                yield replace(m, landmark=NAMELESS, value=frozen(m.value + aside))


@pytest.fixture(scope="module")
def block(walk):
    return walk("square", 5, BLOCK)


def test_two_things_that_were_given_one_name_get_two(block) -> None:
    """The second was seen while the pose was uncertain; once the loops have put that right, its sightings are its own, and none is left under the
    name of the first.
    """
    backend, decisions = block.ran(confused(block, BESIDE, 0.9))
    (told,) = splits(decisions)
    assert (told.reason, told.verdict) == ("confused", "accepted")
    first, new = told.basis["from"], told.id.partition("/")[2]
    assert about(decisions, "quarantine") == set()
    there = block.seen_at(next(m for m in block.sightings if m.landmark == BESIDE))
    assert np.linalg.norm(place(backend, first) - there) < 0.2
    assert np.linalg.norm(place(backend, new) - there - [0.9, 0, 0]) < 0.2
    key, stamp = backend.landmark(first), block.drive.stamps[3 * LAP]
    assert not [f for f in backend.solver.factors.values() if f.keys[-1] == key and f.stamp >= stamp]
    assert not backend._books.twins  # what an associator names needs no sorting


def test_what_is_one_thing_keeps_its_name_through_the_same_confusion(block) -> None:
    """The same stretch without sight, and the same loops; nothing stands beside the landmark."""
    _, decisions = block.ran(confused(block, BESIDE, 0.0))
    assert not about(decisions, "splitting", "quarantine")


# -- what is no second place ---------------------------------------------------------------------


SURE_WHEELS = {
    "sigma_translation_per_meter": 0.005, "sigma_translation_per_radian": 0.0025,
    "sigma_rotation_per_meter": 0.001, "sigma_rotation_per_radian": 0.005,
}  # fmt: skip


def slipped(walked, off):
    """After one lap the wheels slip, `off` (m) to the side, and say nothing of it. What is seen on the second lap has never been seen before, but
    for one landmark; on the third everything is as on the first.
    """
    stamps = walked.drive.stamps.tolist()
    for m in walked.drive.measurements:
        if isinstance(m, OdometryPose) and m.stamp >= stamps[LAP]:
            yield replace(m, pose=frozen(m.pose + np.array([*off, 0.0, 0, 0, 0, 0])))
        elif (
            isinstance(m, LandmarkObservation)
            and stamps[LAP] <= m.stamp < stamps[2 * LAP]
            and m.landmark != walked.most_seen
        ):
            yield replace(m, landmark=f"new {m.landmark}")
        else:
            yield m


@pytest.mark.parametrize("sigmas", [{}, SURE_WHEELS], ids=["usual wheels", "wheels that are too sure"])
def test_a_pose_that_is_off_until_a_loop_closes_makes_no_second_place(walk, sigmas) -> None:
    """Only what is as new as the error speaks against the landmark that does not fit."""
    drive = walk("square", 2, replace(OPTIONS, **sigmas))
    _, decisions = drive.ran(slipped(drive, (0.8, 0.8)))
    assert not splits(decisions)


def test_what_moves_on_and_on_is_taken_out_as_a_whole(drive) -> None:
    _, decisions = drive.ran(drive.told(lambda n, point: point + np.array([0.25 * n, 0.0, 0.0])))
    assert about(decisions, "splitting", "quarantine") == {"quarantine/moving"}


def test_nobody_else_pays_for_the_path_that_the_wrong_name_has_bent(walk) -> None:
    """A neighbour, whose sightings are drawn from there, seems to move until the two places are told apart."""
    drive = walk("square", 11, replace(OPTIONS, poses=400))
    _, decisions = drive.ran(drive.told(twice))
    assert about(decisions, "splitting", "quarantine") == {"splitting/duplicate"}


def test_of_a_second_place_that_was_seen_too_rarely_nothing_is_made(drive) -> None:
    """It is taken out, as what is never split."""
    _, decisions = drive.ran(drive.told(twice), quarantine={"split": 40})
    assert about(decisions, "splitting", "quarantine") <= {"quarantine/duplicate", "quarantine/moved"}
    assert about(decisions, "quarantine")


# -- a person, other runs, other sessions --------------------------------------------------------


def test_a_landmark_about_which_a_person_has_decided_is_not_split(drive) -> None:
    backend = Backend(config_from(drive.drive.settings))
    decisions, edited = [], ""
    for m in drive.told(twice):
        decisions += [d for update in backend.add(m) for d in update.decisions]
        key = backend._books.landmarks.get(drive.most_seen)
        if not edited and (mine := [f.id for f in backend.solver.factors.values() if f.keys[-1] == key]):
            edited = mine[0]
            backend.add(Command(m.stamp, "command", "1", "edit", {"disable": [edited]}))
    assert not splits(decisions)
    assert about(decisions, "quarantine")


def test_the_sightings_of_a_second_place_can_be_disabled_and_the_edit_undone(drive, doubled) -> None:
    backend, _ = drive.ran(drive.told(twice))
    second, before = f"{drive.most_seen}~2", place(doubled[0], f"{drive.most_seen}~2")
    key = backend.landmark(second)
    ids = [f.id for f in backend.solver.factors.values() if f.keys[-1] == key]
    stamp = int(drive.drive.stamps[-1]) + SECOND
    backend.add(Command(stamp, "command", "1", "edit", {"disable": ids}))
    assert second not in backend.snapshot().names
    backend.add(Command(stamp, "command", "2", "undo", {}))
    assert {backend.solver.factors[id_].keys[1] for id_ in ids} == {key}
    np.testing.assert_allclose(place(backend, second), before, atol=0.02)


def test_a_run_with_a_split_is_the_same_each_time(drive, doubled) -> None:
    hashes = {
        run_hash(
            each.solver.factors.values(), decisions, each.estimate.values(), each.snapshot().trajectory.sevens
        )
        for each, decisions in (doubled, drive.ran(drive.told(twice)))
    }
    assert len(hashes) == 1


def test_another_session_knows_which_ids_are_at_two_places(drive, split) -> None:
    displaced, backend, _ = split
    again = Backend(config_from(drive.drive.settings))
    again.load(backend.saved(NOTHING))
    assert again._books.twins == backend._books.twins
    twins = again._books.twins[drive.most_seen]
    assert twins == Twins((drive.most_seen, f"{drive.most_seen}~2"), twins.since)
    assert (twins.since is None) == (displaced is twice)


@pytest.mark.slow
def test_factors_that_are_made_anew_stay_with_their_place(drive) -> None:
    """Constants of the sensor are estimated, so that each sighting becomes a factor again, from the message that has the first name."""
    landmarks = {**drive.drive.settings["landmarks"], "calibrate": ["time_offset"]}
    backend, decisions = drive.ran(drive.told(moved), landmarks=landmarks)
    (told,) = splits(decisions)
    assert any(d.stage == "calibration" for d in decisions)
    keys = {backend.solver.factors[id_].keys[1] for id_ in told.basis["sightings"]}
    assert keys == {backend.landmark(f"{drive.most_seen}~2")}
