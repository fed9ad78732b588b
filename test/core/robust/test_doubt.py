"""Fixes that are not where they can be: a lone one is refused, those that agree are believed."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.gnss import Fix, enu, geodetic


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return request.param


def shifted(road, items, east, first, last):
    """The fixes from one second to another, moved to the east."""

    def moved(fix):
        place = geodetic(enu(fix.place, road.origin) + np.array([east, 0.0, 0.0]), road.origin)
        return replace(fix, place=frozen(place))

    chosen = [isinstance(item, Fix) and first <= item.stamp // SECOND < last for item in items]
    return [moved(item) if here else item for item, here in zip(items, chosen, strict=True)]


def told(decisions):
    """Second -> the last verdict of the stage about the fix of that second."""
    return {d.stamp // SECOND: (d.verdict, d.reason) for d in decisions if d.stage == "doubt"}


def test_a_lone_wrong_fix_is_kept_out_and_said_so(road, space):
    items, truth = road.drive(space)
    found = road.backend(space, earth={"origin": road.origin})
    decisions = road.run(found, shifted(road, items, 12.0, 60, 62))
    verdicts = told(decisions)
    refused = {second for second, (verdict, _) in verdicts.items() if verdict == "refused"}
    assert refused >= {60, 61}
    assert len(refused) <= 4  # one true fix in a thousand
    doubted = [d for d in decisions if d.reason == "unexpected"]
    assert all(d.statistic > d.threshold for d in doubted)
    assert f"gps/{doubted[0].stamp // SECOND}.000000000/0" not in found.solver.factors
    assert np.sqrt(np.mean(road.errors(found, truth) ** 2)) < 0.25


def test_fixes_that_agree_with_each_other_are_believed_against_the_odometry(road, space):
    """From one second on the odometry is elsewhere: a slip that nobody noticed."""
    items, _ = road.drive(space)
    slipped = shifted(road, items, 12.0, 60, 1000)
    found = road.backend(space, earth={"origin": road.origin})
    verdicts = told(road.run(found, slipped))
    assert verdicts[60] == ("accepted", "agreeing")
    accepted = [second for second, (verdict, _) in verdicts.items() if verdict == "accepted"]
    assert len(accepted) >= 110
    compared = found.compared(found.snapshot())
    assert np.linalg.norm((compared.antennas - compared.fixes)[-1, :2]) < 1.0


def test_what_is_doubted_at_the_end_is_refused(road, space):
    items, _ = road.drive(space, seconds=40)
    found = road.backend(space, earth={"origin": road.origin})
    verdicts = told(road.run(found, shifted(road, items, 12.0, 39, 1000)))
    assert verdicts[39] == verdicts[40] == ("refused", "alone")


def test_innovations_are_as_large_as_the_noise_says(road, space):
    """Their mean chi-square over 20 seeded drives lies within 99.9 % of its own spread around the degrees of freedom."""
    axes = 2 if space == "2d" else 3
    found = []
    for seed in range(20):
        items, _ = road.drive(space, seed=seed, seconds=60)
        backend = road.backend(space, earth={"origin": road.origin})
        found += [
            d.statistic for d in road.run(backend, items) if d.reason == "expected" and d.stamp > 20 * SECOND
        ]
    assert abs(np.mean(found) - axes) < 3.29 * np.sqrt(2 * axes / len(found)) + 0.02 * axes
