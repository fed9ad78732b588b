"""A drive without ids ends with the map that it has with them; what is seen once is no landmark."""

from collections import Counter, defaultdict
from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.fingerprint import run_hash
from slam_backend.core.measurement import frozen
from slam_backend.core.sensors.landmark import NAMELESS, LandmarkObservation
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import Simulation, simulate

OPTIONS = Options(poses=400, landmark_sigma=0.05, landmark_range=6.0, sigma_rotation_per_meter=0.004)


@pytest.fixture(scope="module")
def drive() -> Simulation:
    return simulate("lawnmower", 4, OPTIONS)


def backend(drive: Simulation, space: str = "2d", **trees: object) -> Backend:
    settings = {**drive.settings, "space": space}
    settings["landmarks"] = {**settings["landmarks"], **trees}
    return Backend(config_from(settings))


def run(backend: Backend, drive: Simulation, nameless: bool = True, clutter: int = 0) -> list:
    """Decisions. clutter: things that are seen once, and never where anything was seen before."""
    rng = np.random.default_rng(5)
    decisions = []
    for said in drive.measurements:
        item = said
        if isinstance(item, LandmarkObservation) and nameless:
            item = replace(item, landmark=NAMELESS)
            if clutter and rng.random() < 0.05:
                clutter -= 1
                stray = replace(item, value=frozen([*rng.uniform(-9, 9, 2), 0.0]))
                decisions += [d for update in backend.add(stray) for d in update.decisions]
        decisions += [d for update in backend.add(item) for d in update.decisions]
    return decisions + [d for update in backend.finish() for d in update.decisions]


def identities(engine: Backend, drive: Simulation) -> dict[str, Counter]:
    """Name that was given -> which true landmarks its sightings are of, told by their ids."""
    names = {engine.landmark(name): name for name in engine.snapshot().names}
    found: dict[str, Counter] = defaultdict(Counter)
    order: dict[str, list] = defaultdict(list)
    for m in drive.measurements:
        if isinstance(m, LandmarkObservation):
            order[m.source, m.stamp].append(m.landmark)
    for factor in engine.solver.factors.values():
        if factor.kind == "landmark":
            n = int(factor.id.rpartition("/")[2])
            found[names[factor.keys[1]]][order[factor.source, factor.stamp][n]] += 1
    return found


def test_without_ids_every_sighting_finds_its_landmark(drive: Simulation) -> None:
    """One name for each landmark that was seen more than once, and no sighting under another's name."""
    engine = backend(drive)
    run(engine, drive)
    found = identities(engine, drive)
    assert all(len(each) == 1 for each in found.values())
    owners = [next(iter(each)) for each in found.values()]
    assert len(set(owners)) == len(owners)
    known = backend(drive)
    run(known, drive, nameless=False)
    with_ids, without = known.snapshot(), engine.snapshot()
    assert len(without.names) >= 0.9 * len(with_ids.names)
    np.testing.assert_allclose(without.trajectory.sevens[:, :2], with_ids.trajectory.sevens[:, :2], atol=0.05)


def test_the_nearest_landmark_is_nearly_always_the_right_one(drive: Simulation) -> None:
    """The cheaper method, where landmarks stand apart: 98 of 100 sightings under the name that their landmark has."""
    engine = backend(drive, association="nearest")
    run(engine, drive)
    found = identities(engine, drive).values()
    assert sum(max(each.values()) for each in found) >= 0.98 * sum(sum(each.values()) for each in found)


def test_what_is_seen_once_becomes_no_landmark_and_is_told(drive: Simulation) -> None:
    """Strays among the sightings: they wait, and are refused as unconfirmed; every match is a decision with its statistic."""
    engine = backend(drive)
    decisions = run(engine, drive, clutter=60)
    reasons = Counter(d.reason for d in decisions if d.stage == "association")
    assert reasons["unconfirmed"] >= 50
    matched = [d for d in decisions if d.reason == "matched"]
    assert all(d.statistic is not None and d.statistic <= d.threshold for d in matched)
    assert len(engine.snapshot().names) <= 1.05 * len(drive.landmarks)


def test_ids_that_mean_nothing_are_ignored_where_the_setting_says_so(drive: Simulation) -> None:
    """The same drive with an id of its own for every sighting gives the same factors as without ids."""
    nameless, ignored = backend(drive), backend(drive, ignore_ids=True)
    run(nameless, drive)
    run(ignored, drive, nameless=False)
    hashes = [
        run_hash(list(e.solver.factors.values()), [], e.estimate.values(), e.snapshot().trajectory.sevens)
        for e in (nameless, ignored)
    ]
    assert hashes[0] == hashes[1]


def test_a_bearing_without_an_id_is_refused(drive: Simulation) -> None:
    """It could be of anything along its line: a decision, not a guess."""
    engine = backend(drive)
    for item in drive.measurements:
        if isinstance(item, LandmarkObservation):
            bearing = replace(
                item,
                landmark=NAMELESS,
                form="bearing",
                value=frozen([0.1, 0.0]),
                covariance=frozen(np.eye(2)),
            )
            engine.add(bearing)
            break
        engine.add(item)
    decisions = [d for update in engine.finish() for d in update.decisions]
    assert [d.reason for d in decisions if d.stage == "association"] == ["nameless"]
