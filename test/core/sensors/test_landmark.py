"""Sightings of landmarks: what the messages say, and factors that fit the truth with the noise they state."""

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import LandmarkSource
from slam_backend.core.context import Correction
from slam_backend.core.errors import BadMessage
from slam_backend.core.graph import UNTIL_JOINED, Wait
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.mounts import Mounts
from slam_backend.core.sensors.landmark import (
    LandmarkObservation,
    decode_points,
    decode_range,
    decode_tag,
    factors,
    positioned,
)

KEYFRAMES = (2, 6, 11)  # s
AT_KEYFRAME, AFTER, BEFORE = 6 * SECOND, 7 * SECOND + SECOND // 3, 5 * SECOND - SECOND // 7
STAMPS = pytest.mark.parametrize("stamp", [AT_KEYFRAME, AFTER, BEFORE], ids=["at", "after", "before"])
FRAMES = pytest.mark.parametrize("frame", ["", "mast"], ids=["base", "mast"])
FORMS = pytest.mark.parametrize("form", ["position", "bearing_range", "bearing", "range"])


def form_of(point, form) -> np.ndarray:
    """What a sensor says of a point in its own frame."""
    x, y, z = np.append(point, np.zeros(3 - len(point)))
    azimuth, elevation, distance = (
        np.arctan2(y, x),
        np.arctan2(z, np.hypot(x, y)),
        np.sqrt(x * x + y * y + z * z),
    )
    return {
        "position": np.array([x, y, z]),
        "bearing_range": np.array([azimuth, elevation, distance]),
        "bearing": np.array([azimuth, elevation]),
        "range": np.array([distance]),
    }[form]


SIGMAS = {
    "position": [0.01, 0.03, 0.02],
    "bearing_range": [0.004, 0.001, 0.02],
    "bearing": [0.004, 0.001],
    "range": [0.02],
}
UNUSED = {"position": 2, "bearing_range": 1, "bearing": 1}


def noise_of_form(rng, world, form, spread) -> np.ndarray:
    """A full covariance; in the plane, nonsense on the axis that it lacks."""
    covariance = spread(rng, SIGMAS[form])
    if world.space.name == "2d" and form in UNUSED:
        k = UNUSED[form]
        covariance[k, :] = covariance[:, k] = np.nan
    return covariance


def sighting(world, form, frame, stamp, covariance, rng=None) -> LandmarkObservation:
    """Of the oak; true, or with noise in the sensor and in the motion since the keyframe."""
    base = world.track.pose(stamp) if rng is None else world.wrongly(rng, stamp)
    sensor = base.compose(world.mounts.get(frame))
    value = form_of(sensor.transformTo(world.point("oak")), form)
    if rng is not None:
        value = value + rng.multivariate_normal(np.zeros(len(value)), np.nan_to_num(covariance))
    return LandmarkObservation(stamp, "trees", frame, "oak", form, frozen(value), frozen(covariance))


@FORMS
@FRAMES
@STAMPS
def test_a_true_sighting_has_no_error_at_the_truth(world, offered, form, frame, stamp):
    seen = sighting(world, form, frame, stamp, np.full((len(SIGMAS[form]),) * 2, np.nan))
    (made,) = factors(offered(seen), None, None, world.context(), LandmarkSource()).add
    assert made.keys == (world.place(stamp).keyframe.pose, world.key("oak"))
    assert (made.kind, made.source, made.stamp) == ("landmark", "trees", stamp)
    assert made.factor.error(world.values()) < 1e-12


@FORMS
@FRAMES
@STAMPS
def test_the_noise_is_that_of_the_sighting_and_of_the_motion(
    world, offered, agree, spread, form, frame, stamp
):
    """Whitened by their own noise, errors at the truth are standard normal."""
    rng = np.random.default_rng(1)
    covariance = noise_of_form(rng, world, form, spread)
    context, values, errors = world.context(), world.values(), []
    for _ in range(1_500):
        seen = sighting(world, form, frame, stamp, covariance, rng)
        (made,) = factors(offered(seen), None, None, context, LandmarkSource()).add
        errors.append(made.factor.whitenedError(values))
    agree(errors)


def test_bearing_and_range_from_the_keyframe_itself_is_the_native_factor(world, offered, spread):
    rng, space = np.random.default_rng(2), world.space
    covariance = spread(rng, SIGMAS["bearing_range"])
    seen = sighting(world, "bearing_range", "", AT_KEYFRAME, covariance, rng)
    (made,) = factors(offered(seen), None, None, world.context(), LandmarkSource()).add
    azimuth, _, distance = seen.value
    keys = world.timeline.keyframes[1].pose, world.key("oak")
    if space.name == "2d":
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_([0, 2], [0, 2])])
        native = gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(azimuth), distance, noise)
    else:
        isotropic = np.diag([0.01**2, 0.01**2, 0.05**2])
        seen = replace(seen, covariance=frozen(isotropic))
        seen = replace(seen, value=frozen([azimuth, 0.0, distance]))  # there azimuth and elevation are equals
        (made,) = factors(offered(seen), None, None, world.context(), LandmarkSource()).add
        ahead = gtsam.Unit3(np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        native = gtsam.BearingRangeFactor3D(
            *keys, ahead, distance, gtsam.noiseModel.Gaussian.Covariance(isotropic)
        )
    values = world.values()
    assert made.factor.error(values) == pytest.approx(native.error(values), rel=1e-9)


@pytest.mark.parametrize("form", ["position", "bearing_range"])
@FRAMES
def test_a_new_landmark_starts_where_it_is_seen(world, offered, form, frame):
    world.known.discard("oak")
    seen = sighting(world, form, frame, AFTER, np.full((3, 3), np.nan))
    delta = factors(offered(seen, seen), None, None, world.context(), LandmarkSource())
    assert list(delta.values) == [world.key("oak")]
    np.testing.assert_allclose(delta.values[world.key("oak")], world.point("oak"), atol=1e-9)
    assert len(delta.add) == 2


def test_a_bearing_alone_waits_until_its_landmark_has_a_position(world, offered):
    world.known.discard("oak")
    bearing = sighting(world, "bearing", "", AT_KEYFRAME, np.full((2, 2), np.nan))
    delta = factors(offered(bearing), None, None, world.context(), LandmarkSource())
    assert not delta.add
    assert [wait.until for wait in delta.waits] == [world.key("oak")]
    placing = sighting(world, "position", "", AT_KEYFRAME, np.full((3, 3), np.nan))
    delta = factors(offered(placing, bearing), None, None, world.context(), LandmarkSource())
    assert len(delta.add) == 2
    assert not delta.waits


def test_ranges_that_are_too_long_are_divided_by_their_scale(world, offered):
    true = sighting(world, "range", "", AT_KEYFRAME, np.array([[0.01]]))
    long = replace(true, value=frozen(true.value * 1.1), covariance=frozen(true.covariance * 1.1**2))
    (plain,) = factors(offered(true), None, None, world.context(), LandmarkSource()).add
    context = replace(world.context(), correction=Correction(range_scale=1.1))
    (scaled,) = factors(offered(long), None, None, context, LandmarkSource()).add
    assert scaled.factor.measured() == pytest.approx(plain.factor.measured())
    np.testing.assert_allclose(scaled.factor.noiseModel().R(), plain.factor.noiseModel().R())


def test_a_range_to_a_beacon_from_a_mast_is_the_native_factor_with_the_mast(world, offered):
    seen = sighting(world, "range", "mast", AT_KEYFRAME, np.array([[0.01]]))
    (made,) = factors(offered(seen), None, None, world.context(), LandmarkSource()).add
    native = {"2d": gtsam.RangeFactorWithTransform2D, "3d": gtsam.RangeFactorWithTransform3D}[
        world.space.name
    ]
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    keys = world.timeline.keyframes[1].pose, world.key("oak")
    assert made.factor.equals(native(*keys, seen.value[0], noise, world.mounts.get("mast")), 1e-9)


@pytest.mark.parametrize("form", ["range", "bearing"])
def test_what_waits_for_a_place_becomes_factors_together_with_the_sighting_that_decides(world, offered, form):
    world.known.discard("oak")
    stamps = [int(t) for t in np.linspace(KEYFRAMES[0], KEYFRAMES[-1], 15) * SECOND]
    sigma = np.eye(len(SIGMAS[form])) * 1e-8
    offers = offered(*(sighting(world, form, "mast", stamp, sigma) for stamp in stamps))
    before = [Wait(offer, world.key("oak"), "") for offer in offers[:-1]]
    context = replace(world.context(), waiting=lambda _: before)
    delta = factors(offers[-1:], None, None, context, LandmarkSource())
    assert {factor.id for factor in delta.add} == {offer.id for offer in offers}
    np.testing.assert_allclose(delta.values[world.key("oak")], world.point("oak"), atol=1e-3)
    assert [(d.verdict, d.stage, d.reason) for d in delta.decisions] == [("accepted", "placing", "placed")]
    assert not delta.waits


def test_a_landmark_of_another_part_waits_until_they_are_joined(world, offered):
    world.parts[world.key("oak")] = 7
    seen = sighting(world, "position", "", AT_KEYFRAME, np.full((3, 3), np.nan))
    delta = factors(offered(seen), None, None, world.context(), LandmarkSource())
    assert [wait.until for wait in delta.waits] == [UNTIL_JOINED]


def test_what_cannot_be_used_becomes_a_decision(world, offered):
    good = sighting(world, "position", "", AT_KEYFRAME, np.full((3, 3), np.nan))
    origin = world.mounts.get("mast").inverse().translation()
    value = np.append(origin, np.zeros(3 - len(origin)))
    bad = [
        replace(good, frame="tail"),
        replace(good, stamp=40 * SECOND),
        replace(good, frame="mast", value=value),
    ]
    delta = factors(offered(*bad), None, None, world.context(), LandmarkSource())
    assert [(d.verdict, d.stage, d.reason) for d in delta.decisions] == [
        ("refused", "landmark", "unknown_frame"),
        ("refused", "landmark", "uncovered"),
        ("refused", "landmark", "range"),
    ]
    assert not delta


@FORMS
def test_noise_that_is_not_stated_is_the_configured_one(world, offered, form):
    config = LandmarkSource(sigma_position=0.3, sigma_range=0.2, sigma_bearing=0.1)
    size = len(SIGMAS[form])
    seen = sighting(world, form, "", AT_KEYFRAME, np.full((size, size), np.nan))
    stated = {
        "position": [0.3] * 3,
        "bearing_range": [0.1, 0.1, 0.2],
        "bearing": [0.1, 0.1],
        "range": [0.2],
    }[form]
    same = replace(seen, covariance=frozen(np.diag(np.square(stated))))
    made = factors(offered(seen, same), None, None, world.context(), config).add
    default, explicit = (each.factor.noiseModel().R() for each in made)
    np.testing.assert_allclose(default, explicit, rtol=1e-9)


@pytest.mark.parametrize("form", ["bearing_range", "range"])
def test_noise_of_a_range_may_grow_with_it(world, offered, form):
    """As data sheets have it: centimetres and per cent, as variances."""
    config = LandmarkSource(sigma_range=0.03, sigma_range_per_meter=0.02)
    size = len(SIGMAS[form])
    seen = sighting(world, form, "", AT_KEYFRAME, np.full((size, size), np.nan))
    (made,) = factors(offered(seen), None, None, world.context(), config).add
    sigma = np.hypot(0.03, 0.02 * seen.value[-1])
    assert abs(made.factor.noiseModel().R()[-1, -1]) == pytest.approx(1 / sigma, rel=1e-6)


def test_the_kernel_of_the_source_is_around_the_noise(world, offered):
    seen = sighting(world, "position", "", AT_KEYFRAME, np.full((3, 3), np.nan))
    (made,) = factors(offered(seen), None, None, world.context(), LandmarkSource(kernel="cauchy")).add
    assert isinstance(made.factor.noiseModel(), gtsam.noiseModel.Robust)


# -- tags of nav_msgs/Odometry -----------------------------------------------------------------------------------


def tag_message(x, y, z, covariance=None) -> SimpleNamespace:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=6, nanosec=0), frame_id="camera")
    turned = SimpleNamespace(x=0.0, y=0.6, z=0.0, w=0.8)
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z), orientation=turned)
    told = SimpleNamespace(pose=pose, covariance=np.zeros(36) if covariance is None else covariance)
    return SimpleNamespace(header=header, child_frame_id="tag36h11:5", pose=told)


def test_a_tag_is_a_landmark_that_is_named_by_its_family_and_number():
    covariance = np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06])
    seen = decode_tag(tag_message(1.0, 2.0, 3.0, covariance.ravel()), "tags")
    assert (seen.stamp, seen.source, seen.frame, seen.landmark) == (
        6 * SECOND,
        "tags",
        "camera",
        "tag36h11:5",
    )
    assert (seen.form, seen.value.tolist()) == ("pose", [1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8])
    np.testing.assert_array_equal(seen.covariance, covariance)


def test_in_the_plane_too_an_optical_frame_looks_along_its_z_axis(world, offered):
    """x of an optical frame is to the right, y down: a tag 5 m ahead and 1 m to the right is there in either space."""
    optical = {"camera": (0.3, 0.0, 0.6, -np.pi / 2, 0.0, -np.pi / 2)}
    context = replace(world.context(), mounts=Mounts(world.space, "base_link", optical))
    seen = positioned(replace(decode_tag(tag_message(1.0, 0.2, 5.0), "tags"), landmark="oak"))
    world.known.discard("oak")
    delta = factors(offered(seen), None, None, context, LandmarkSource())
    from_base = world.pose(delta.add[0].keys[0]).transformTo(delta.values[world.key("oak")])
    np.testing.assert_allclose(from_base, [5.3, -1.0, 0.4][: world.space.point_dimension], atol=1e-9)


# -- ranges of sensor_msgs/Range ---------------------------------------------------------------------------------


def range_message(distance, **fields) -> SimpleNamespace:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=5), frame_id="beacon_7")
    told = {"min_range": 0.3, "max_range": 80.0, "variance": 0.04, **fields}
    return SimpleNamespace(header=header, range=distance, **told)


def test_a_range_message_names_its_beacon_and_may_state_its_variance():
    (seen,) = decode_range(range_message(12.5), "radio")
    assert (seen.stamp, seen.source, seen.form, seen.landmark) == (
        3 * SECOND + 5,
        "radio",
        "range",
        "beacon_7",
    )
    assert (seen.value.tolist(), seen.covariance.tolist()) == ([12.5], [[0.04]])
    (unstated,) = decode_range(range_message(12.5, variance=0.0), "radio")
    assert np.isnan(unstated.covariance).all()


def test_a_range_beyond_what_the_sensor_can_tell_is_no_echo_and_says_nothing():
    assert not list(decode_range(range_message(0.1), "radio"))
    assert not list(decode_range(range_message(81.0), "radio"))
    assert not list(decode_range(range_message(np.inf), "radio"))


def test_the_sensor_of_ranges_sits_in_the_frame_that_the_source_names(world, offered):
    (seen,) = decode_range(range_message(5.0), "radio")
    seen = replace(seen, stamp=AT_KEYFRAME, landmark="oak")
    (made,) = factors(offered(seen), None, None, world.context(), LandmarkSource(frame="mast")).add
    sensor = world.pose(made.keys[0]).compose(world.mounts.get("mast"))
    distance = np.linalg.norm(sensor.transformTo(world.point("oak")))
    assert made.factor.unwhitenedError(world.values()) == pytest.approx(distance - 5.0)


# -- messages ----------------------------------------------------------------------------------------------------


def cloud(stamp=(3, 5), frame="mast", **columns) -> SimpleNamespace:
    """A PointCloud2 with one float64 field per column; a column may hold vectors."""
    arrays = {name: np.asarray(column, dtype=np.float64) for name, column in columns.items()}
    fields, parts, offset = [], [], 0
    for name, array in arrays.items():
        count = array.shape[1] if array.ndim > 1 else 1
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=8, count=count))
        parts.append(array.reshape(len(array), count))
        offset += 8 * count
    table = np.hstack(parts)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]), frame_id=frame)
    return SimpleNamespace(
        header=header, width=len(table), height=1, point_step=offset, fields=fields, is_bigendian=False,
        data=np.ascontiguousarray(table).tobytes(),
    )  # fmt: skip


def test_a_sigma_below_zero_is_no_variance():
    """It must not become that of its size: the firewall refuses it."""
    (point,) = decode_points(cloud(id=[1], x=[1.0], y=[2.0], z=[3.0], sigma_z=[-0.5], sigma=[0.1]), "trees")
    assert np.diag(point.covariance).tolist() == pytest.approx([0.01, 0.01, -0.25])


def test_positions_ids_and_sigmas_are_read_by_field_name():
    message = cloud(
        frame="/mast",
        id=[7, 2.5],
        x=[1, 4],
        y=[2, 5],
        z=[3, 6],
        sigma_position=[0.1, 0.2],
        sigma_z=[0.5, 0.6],
    )
    first, second = decode_points(message, "trees")
    assert (first.stamp, first.source, first.frame) == (3 * SECOND + 5, "trees", "mast")
    assert (first.form, first.landmark, second.landmark) == ("position", "7", "2.5")
    np.testing.assert_array_equal(second.value, [4, 5, 6])
    np.testing.assert_allclose(first.covariance, np.diag([0.01, 0.01, 0.25]))
    assert not first.value.flags.writeable


def test_missing_axes_are_zero_and_missing_noise_is_nan():
    (flat,) = decode_points(cloud(id=[1], x=[1], y=[2]), "trees")
    np.testing.assert_array_equal(flat.value, [1, 2, 0])
    assert np.isnan(np.diag(flat.covariance)).all()
    (angle,) = decode_points(cloud(id=[1], azimuth=[0.5], sigma=[0.1]), "trees")
    assert angle.form == "bearing"
    np.testing.assert_array_equal(angle.value, [0.5, 0.0])
    (polar,) = decode_points(
        cloud(id=[1], range=[4], azimuth=[0.5], elevation=[0.1], sigma_range=[0.3]), "trees"
    )
    assert polar.form == "bearing_range"
    np.testing.assert_array_equal(polar.value, [0.5, 0.1, 4.0])
    np.testing.assert_allclose(np.diag(polar.covariance), [np.nan, np.nan, 0.09])


def test_a_quaternion_beside_a_position_and_an_id_is_a_pose():
    """Its noise has six axes; without an id it is a position, since orientations are not associated."""
    turned = {"qx": [0.0], "qy": [0.6], "qz": [0.0], "qw": [0.8]}
    place = {"x": [1.0], "y": [2.0], "z": [3.0], **turned, "sigma_position": [0.1], "sigma_yaw": [0.2]}
    (seen,) = decode_points(cloud(id=[5], **place), "tags")
    assert (seen.form, seen.value.tolist()) == ("pose", [1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8])
    np.testing.assert_allclose(np.sqrt(np.diag(seen.covariance)), [0.1] * 3 + [np.nan] * 2 + [0.2])
    (bare,) = decode_points(cloud(**place), "tags")
    assert (bare.form, bare.value.tolist()) == ("position", [1.0, 2.0, 3.0])


def test_a_full_covariance_is_taken_as_it_stands():
    covariance = np.arange(9.0)
    (seen,) = decode_points(cloud(id=[1], x=[1], y=[2], z=[3], cov=[covariance]), "trees")
    np.testing.assert_array_equal(seen.covariance, covariance.reshape(3, 3))


def test_a_cloud_without_points_says_nothing():
    assert not list(decode_points(cloud(id=np.zeros(0), x=np.zeros(0), y=np.zeros(0)), "trees"))


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"z": [1]}, "'range'"),
        ({"id": [1], "x": [1]}, "azimuth"),
        ({"id": [1], "x": [1], "y": [1], "cov": [[1, 2]]}, "9 are needed"),
        ({"id": [1], "x": [[1, 2]], "y": [[1, 2]]}, "'x' holds 2 numbers"),
        ({"id": [[1, 2]], "x": [1], "y": [1]}, "'id' holds 2 numbers"),
    ],
)
def test_a_cloud_that_cannot_be_understood_is_one_clear_line(columns, text):
    with pytest.raises(BadMessage, match=text):
        list(decode_points(cloud(**columns), "trees"))
