"""Several odometries at once, odometry that restarts, wheels in a 3-D graph, robots on a floor."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadConfig
from slam_backend.core.geometry import inverse_of, matrix_of, seven_of_matrix
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.space import SPACES
from slam_backend.io.replay import settled_stream
from slam_backend.io.result import cost

BOTH = pytest.mark.parametrize("space", ["2d", "3d"])
OPTICAL = (0.3, 0.1, 0.5, -np.pi / 2, 0.0, -np.pi / 2)  # a camera that looks ahead: z forward, x right


def config(space="3d", keyframes=None, floor=None, extrinsics=None, **sources):
    described = {name: {"kind": "odometry", **settings} for name, settings in sources.items()}
    return config_from(
        {
            "space": space,
            "keyframes": keyframes or {"distance": 0.99, "angle": 6.0},
            "floor": floor or {},
            "extrinsics": extrinsics or {},
            "sources": list(described),
            **described,
        }
    )


def circle(seconds):
    """`world_T_base`: 1 m/s on a circle of 10 m radius."""
    angle = seconds / 10
    return pose(10 * np.sin(angle), 10 - 10 * np.cos(angle), angle)


def pose(x=0.0, y=0.0, yaw=0.0, z=0.0):
    return matrix_of(np.array((x, y, z, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2))))


def told(source, seconds, matrix, child="base", **more):
    item = OdometryPose(
        round((1 + seconds) * SECOND), source, f"{source}_odom", child, frozen(seven_of_matrix(matrix)),
        UNKNOWN, STILL, UNKNOWN,
    )  # fmt: skip
    return replace(item, **more)


def drive(source, times, way=circle, frame=None, mount=None, child="base"):
    """Odometry of a sensor at `base_T_child`, in a frame of its own: `frame_T_world`."""
    frame, mount = np.eye(4) if frame is None else frame, np.eye(4) if mount is None else mount
    return [told(source, t, frame @ way(t) @ mount, child) for t in times]


def run(backend, *streams):
    """All decisions; the streams in order of their stamps."""
    decisions = []
    items = sorted((item for stream in streams for item in stream), key=lambda m: m.stamp)
    for item in settled_stream(items, backend.config):
        decisions += [item] if isinstance(item, Decision) else told_by(backend.add(item))
    return decisions + told_by(backend.finish())


def told_by(updates):
    return [decision for update in updates for decision in update.decisions]


def edges(backend, source):
    return [f for f in backend.solver.factors.values() if f.source == source and f.kind == "odometry"]


def spans(backend, source):
    """The stamps of the two keyframes of each edge, in s since the start."""
    stamps = {k.pose: k.stamp / SECOND - 1 for k in backend.timeline.keyframes}
    return [tuple(stamps[key] for key in edge.keys) for edge in edges(backend, source)]


def final_cost(backend):
    return cost(backend.solver.factors.values(), backend.estimate.values())


# -- edges beside the motion -------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("mount", ["base", "camera"])
def test_each_odometry_adds_its_own_edges_and_exact_ones_agree(space, mount):
    """Whatever the rate, the frame and the seat of the second: nothing contradicts."""
    extrinsics = {"camera": OPTICAL} if mount == "camera" else {}
    backend = Backend(config(space, wheels={}, visual={}, extrinsics=extrinsics))
    seat = np.eye(4) if mount == "base" else SPACES["3d"].from_extrinsics(OPTICAL).matrix()
    frame = inverse_of(circle(0) @ seat) if mount == "camera" else pose(5, -3, 1.0)
    visual = drive("visual", np.arange(0, 20, 0.033), frame=frame, mount=seat, child=mount)
    assert run(backend, drive("wheels", np.arange(0, 20, 0.1)), visual) == []
    assert len(edges(backend, "visual")) == len(backend.timeline) - 1
    assert final_cost(backend) < 1e-12


@BOTH
def test_two_odometries_are_weighed_by_their_noise(space):
    """One says 10 m, the other 11 m with half the standard deviation: inverse variances, as by hand."""
    settings = {
        "sigma_rotation_per_meter": 0.0,
        "sigma_rotation_floor": 1e-6,
        "sigma_translation_floor": 1e-6,
    }
    backend = Backend(
        config(
            space,
            {"distance": 9.9},
            wheels={"sigma_translation_per_meter": 0.2, **settings},
            visual={"sigma_translation_per_meter": 0.1 * np.sqrt(10 / 11), **settings},
        )
    )
    ends = (0.0, 10.0)
    straight = [told("visual", t, pose(1.1 * t)) for t in (*np.arange(0, 10.0, 0.1), 10.0)]
    run(backend, [told("wheels", t, pose(t)) for t in ends], straight)
    last = backend.timeline.keyframes[-1].pose
    assert backend.estimate.pose(last).x() == pytest.approx(10 + 0.8, abs=1e-4)
    covariance = backend.space.covariance_to_ros(
        backend.estimate.covariance([last]), backend.estimate.pose(last)
    )
    assert covariance[0, 0] == pytest.approx(1 / (1 / 0.4 + 1 / 0.1), rel=1e-3)


def test_the_noise_of_an_odometry_is_that_of_its_sensor_and_its_mode():
    """A sensor 2 m ahead of the base that is uncertain of its turns: the base is uncertain sideways, by how far behind it then lies."""
    stated = frozen(np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 0.01]).ravel())
    backend = Backend(
        config("2d", wheels={}, visual={"noise": "twist"}, extrinsics={"head": (2, 0, 0, 0, 0, 0)})
    )
    items = [
        told("visual", t, pose(t + 2), "head", twist_covariance=stated) for t in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    run(backend, [told("wheels", t, pose(t)) for t in (0.0, 1.0)], items)
    (edge,) = edges(backend, "visual")
    sigmas = np.sqrt(np.diag(edge.factor.noiseModel().covariance()))
    steps, levers = np.full(4, 0.1 * 0.25), 2 + np.array([0.25, 0.5, 0.75, 1.0]) - 1.0
    assert sigmas[2] == pytest.approx(np.linalg.norm(steps), rel=1e-3)
    assert sigmas[1] == pytest.approx(np.linalg.norm(steps * levers), rel=0.01)


def test_where_an_odometry_was_silent_its_edge_spans_what_it_did_not_see():
    backend = Backend(config("2d", wheels={}, visual={}))
    heard = [t for t in np.arange(0, 12, 0.05) if not 3.32 < t < 7.28]
    run(backend, drive("wheels", np.arange(0, 12, 0.1)), drive("visual", heard))
    assert (3.0, 7.0) in [(round(a), round(b)) for a, b in spans(backend, "visual")]
    assert final_cost(backend) < 1e-12


def test_a_slow_odometry_lands_at_the_keyframes_nearest_to_its_messages():
    backend = Backend(config("2d", {"distance": 0.3}, wheels={}, scans={}))
    run(backend, drive("wheels", np.arange(0, 12, 0.1)), drive("scans", np.arange(0.55, 12, 2.0)))
    assert len(edges(backend, "scans")) == 4  # of six messages; the last has no keyframe after it yet
    assert final_cost(backend) < 1e-12


def test_what_comes_from_an_unknown_frame_is_refused_once_a_second():
    backend = Backend(config("2d", wheels={}, visual={}))
    lost = drive("visual", np.arange(0, 3, 0.1), child="camera")
    decisions = run(backend, drive("wheels", np.arange(0, 3, 0.1)), lost)
    assert {(d.verdict, d.stage, d.reason) for d in decisions} == {("refused", "odometry", "unknown_frame")}
    assert not edges(backend, "visual")


# -- restarts ----------------------------------------------------------------------------------------


@BOTH
def test_across_a_restart_there_is_no_edge_of_that_source(space):
    backend = Backend(config(space, wheels={}, visual={}))
    before = drive("visual", np.arange(0, 5.25, 0.05))
    after = drive("visual", np.arange(5.3, 12, 0.05), frame=inverse_of(circle(5.3)))
    decisions = run(backend, drive("wheels", np.arange(0, 12, 0.1)), before, after)
    assert [(d.source, d.reason) for d in decisions] == [("visual", "restart")]
    ends = [(round(a), round(b)) for a, b in spans(backend, "visual")]
    assert (5, 6) not in ends
    assert {(4, 5), (6, 7)} <= set(ends)
    assert final_cost(backend) < 1e-12


@BOTH
def test_a_driving_odometry_that_restarts_leaves_the_graph_in_one_piece(space):
    """The robot went on as before; how far that is believed is the wide edge's covariance. The epoch begins at a keyframe."""
    backend = Backend(config(space, wheels={"sigma_acceleration": 2.0, "sigma_angular_acceleration": 0.5}))
    before = drive("wheels", np.arange(0, 5.05, 0.1))
    after = drive("wheels", np.arange(5.8, 12, 0.1), frame=inverse_of(circle(5.8)))
    decisions = run(backend, before, after)
    assert [d.reason for d in decisions] == ["restart"]
    assert len(backend.parts) == 1
    for k in backend.timeline.keyframes:
        expected = backend.space.pose(seven_of_matrix(circle(k.stamp / SECOND - 1)).tolist())
        assert backend.estimate.pose(k.pose).equals(expected, 1e-3)
    wide = next(f for f in backend.solver.factors.values() if f.stamp == after[0].stamp)
    seconds = (after[0].stamp - before[-1].stamp) / SECOND
    sigmas = np.sqrt(np.diag(wide.factor.noiseModel().covariance()))
    x, yaw = (0, 2) if space == "2d" else (3, 2)
    assert sigmas[x] == pytest.approx(2.0 * np.sqrt(seconds**3 / 3), rel=0.02)
    assert sigmas[yaw] == pytest.approx(0.5 * np.sqrt(seconds**3 / 3), rel=0.02)


def test_another_odometry_carries_the_robot_over_a_restart_of_the_one_that_drives():
    """It turns while the driver is silent: constant velocity is wrong there, and the other odometry is right."""

    def turning(t):
        return (
            circle(t) if t < 5 else circle(5) @ pose(yaw=min(t - 5, 1.0)) @ inverse_of(circle(5)) @ circle(t)
        )

    backend = Backend(config("2d", wheels={}, visual={}))
    before = drive("wheels", np.arange(0, 5.05, 0.1), turning)
    after = drive("wheels", np.arange(6.5, 12, 0.1), turning, frame=inverse_of(turning(6.5)))
    run(backend, before, after, drive("visual", np.arange(0, 12, 0.05), turning))
    newest = backend.timeline.keyframes[-1]
    expected = backend.space.pose(seven_of_matrix(turning(newest.stamp / SECOND - 1)).tolist())
    assert backend.estimate.pose(newest.pose).equals(expected, 0.05)


def test_updates_tell_where_the_frame_of_the_messages_is_after_a_restart():
    backend = Backend(config("2d", wheels={}))
    after = drive("wheels", np.arange(5.1, 8, 0.1), frame=pose(100, 50, 2.0))
    updates = []
    for item in settled_stream([*drive("wheels", np.arange(0, 5.05, 0.1)), *after], backend.config):
        updates += [] if isinstance(item, Decision) else backend.add(item)
    last = updates[-1]
    raw = next(item for item in after if item.stamp == last.keyframe.stamp)
    map_T_base = matrix_of(last.correction) @ matrix_of(last.origin) @ matrix_of(raw.pose)
    np.testing.assert_allclose(map_T_base, matrix_of(last.pose), atol=1e-9)


# -- wheels and floors in space 3d -------------------------------------------------------------------


def hill(seconds):
    """A robot that climbs 6 m up a slope that begins and ends gently, turning as it goes."""
    t = np.clip(seconds / 20, 0, 1)
    pitch = -0.6 * np.sin(np.pi * t) ** 2
    turn = SPACES["3d"].from_extrinsics((0, 0, 0, 0, pitch, 0.04 * seconds)).matrix()
    steps = np.linspace(0, seconds, 200)
    slopes = -0.6 * np.sin(np.pi * np.clip(steps / 20, 0, 1)) ** 2
    turn[:3, 3] = [
        np.trapezoid(np.cos(slopes) * np.cos(0.04 * steps), steps),
        np.trapezoid(np.cos(slopes) * np.sin(0.04 * steps), steps),
        np.trapezoid(np.sin(-slopes), steps),
    ]
    return turn


def flat(seconds):
    """What wheels make of it: the path length and the turn, in a plane."""
    steps = np.linspace(0, seconds, 200)
    x, y = np.trapezoid(np.cos(0.04 * steps), steps), np.trapezoid(np.sin(0.04 * steps), steps)
    return pose(x, y, 0.04 * seconds)


@pytest.mark.parametrize("planar", [True, False])
def test_planar_wheels_do_not_flatten_a_hill(planar):
    """Beside lidar odometry that is right: as if they were not there; wheels that are believed on all axes push it down."""
    backend = Backend(config(lidar={}, wheels={"planar": planar}))
    times = np.arange(0, 20.05, 0.1)
    run(backend, drive("lidar", times, hill), drive("wheels", times, flat))
    top = backend.estimate.pose(backend.timeline.keyframes[-1].pose).z()
    assert bool(abs(top - hill(20.0)[2, 3]) < 0.2) is planar


def test_planar_wheels_sharpen_only_what_they_measure():
    backend = Backend(config(lidar={}, wheels={"planar": True, "sigma_translation_per_meter": 0.001}))
    alone = Backend(config(lidar={}))
    times = np.arange(0, 10, 0.1)
    run(backend, drive("lidar", times, flat), drive("wheels", times, flat))
    run(alone, drive("lidar", times, flat))
    key = alone.timeline.keyframes[-2].pose
    less, more = (np.diag(each.estimate.covariance([key])) for each in (backend, alone))
    ratio = np.sqrt(less / more)
    assert ratio[3] < 0.2  # x
    assert ratio[[0, 1]] == pytest.approx(1.0, abs=0.02)  # roll, pitch


def test_wheels_drive_in_3d_and_a_floor_holds_what_they_do_not_see():
    """Without it height and tilt are unknown; with it they stay within what it says; x, y and yaw are not touched."""
    plain, held = (
        Backend(config(wheels={"planar": True}, floor=floor)) for floor in ({}, {"z": 0.05, "tilt": 0.02})
    )
    for backend in (plain, held):
        run(backend, drive("wheels", np.arange(0, 30, 0.1)))
        assert final_cost(backend) < 1e-8
    key = plain.timeline.keyframes[-1].pose
    without, with_ = (
        np.sqrt(
            np.diag(each.space.covariance_to_ros(each.estimate.covariance([key]), each.estimate.pose(key)))
        )
        for each in (plain, held)
    )
    assert (without[2:5] > 1.0).all()
    assert with_[2] < 0.06
    assert (with_[3:5] < 0.025).all()
    np.testing.assert_allclose(with_[5], without[5], rtol=0.01)


def test_a_floor_measures_height_and_tilt_as_they_are():
    """Errors by the numbers: 0.1 m too high is two sigma of 0.05, 0.04 rad of lean two of 0.02; yaw, x and y cost nothing."""
    backend = Backend(config(wheels={}, floor={"z": 0.05, "tilt": 0.02}))
    run(backend, drive("wheels", (0.0, 1.0)))
    z, tilt = [f.factor for f in backend.solver.factors.values() if f.kind == "floor"][:2]
    for lean in ((0.04, 0, 0), (0, 0.04, 0)):
        values = gtsam.Values()
        there = (30.0, -7.0, 0.1, lean[0], lean[1], 2.0)
        values.insert(z.keys()[0], SPACES["3d"].from_extrinsics(there))
        assert 2 * z.error(values) == pytest.approx(4.0, rel=1e-6)
        assert 2 * tilt.error(values) == pytest.approx(4.0, rel=1e-3)


def test_a_plane_needs_no_floor():
    with pytest.raises(BadConfig, match="'floor' needs space: 3d"):
        config("2d", wheels={}, floor={"z": 0.1})


# -- honest together ---------------------------------------------------------------------------------


@pytest.mark.parametrize("lie", [1.0, 5.0])
def test_an_odometry_that_lies_is_found_among_the_newest_factors(lie):
    """On the heading alone; as a running node looks at it, with what is older held where it is."""
    honest = {
        "sigma_translation_per_meter": 0.03,
        "sigma_rotation_per_meter": 0.01,
        "sigma_rotation_per_radian": 0.0,
    }
    exact = {name: sigma / 100 for name, sigma in honest.items()}
    sources = {"wheels": honest, "visual": honest | {"sigma_rotation_per_meter": 0.01 / lie}, "lidar": exact}
    backend = Backend(config("2d", {"distance": 0.9}, **sources))
    walks = [walk(name, "2d", np.random.default_rng(n), 300) for n, name in enumerate(("wheels", "visual"))]
    run(backend, *walks, [told("lidar", float(n), pose(n)) for n in range(301)])
    found = backend.recent(450).consistency()
    assert [found[name].factors for name in sources] == [150, 150, 150]
    assert found["wheels"].advice == ""
    assert ("optimistic in yaw" in found["visual"].advice) is (lie > 1)


@pytest.mark.slow
@BOTH
def test_two_odometries_together_state_their_error_truly(space):
    """NEES of the last pose over 200 seeded runs within its 99.9 % bounds."""
    noise = {
        "sigma_translation_per_meter": 0.03, "sigma_translation_per_radian": 0.0, "sigma_rotation_per_meter": 0.01,
        "sigma_rotation_per_radian": 0.0, "sigma_translation_floor": 1e-6, "sigma_rotation_floor": 1e-6,
    }  # fmt: skip
    settings = config(space, {"distance": 0.999}, wheels=noise, visual=noise)
    total, dimension = 0.0, SPACES[space].dimension
    for seed in range(200):
        backend, rng = Backend(settings), np.random.default_rng(seed)
        run(backend, *(walk(name, space, rng) for name in ("wheels", "visual")))
        last = backend.timeline.keyframes[-2]
        truth = backend.space.pose(seven_of_matrix(pose(last.stamp / SECOND - 1)).tolist())
        error = backend.space.logmap(truth.between(backend.estimate.pose(last.pose)))
        total += error @ np.linalg.solve(backend.estimate.covariance([last.pose]), error)
    spread = 3.29 * np.sqrt(2 * 200 * dimension)  # chi-square of so many degrees of freedom is nearly normal
    assert abs(total - 200 * dimension) < spread


def walk(source, space, rng, steps=10):
    """A metre a step, straight on; the noise of each step as the model says."""
    here, items = SPACES[space].identity, []
    sigmas = np.sqrt(np.diag(SPACES[space].diagonal(0.01**2, 0.03**2)))
    for n in range(steps + 1):
        items.append(told(source, float(n), matrix_of(np.array(SPACES[space].seven(here)))))
        step = SPACES[space].expmap(SPACES[space].logmap(SPACES[space].pose((1, 0, 0, 0, 0, 0, 1))))
        here = here.compose(step).compose(SPACES[space].expmap(sigmas * rng.normal(size=len(sigmas))))
    return items
