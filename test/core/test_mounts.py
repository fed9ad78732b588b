"""Where sensors sit, from the configuration or from /tf_static, in whatever order that comes."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.measurement import StaticTransform, frozen
from slam_backend.core.mounts import Mounts
from slam_backend.core.space import SPACES

BOTH = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
STEPS = {  # a tree: the base is a leaf below the footprint, like the mast
    ("footprint", "base_link"): (0.0, 0.0, 0.1, 0.0, 0.0, 0.3),
    ("footprint", "mast"): (0.5, 0.1, 1.0, 0.0, 0.0, -0.2),
    ("mast", "laser"): (0.1, 0.2, 0.3, 0.0, 0.0, 1.1),
    ("base_link", "camera"): (0.3, 0.0, 0.2, 0.0, 0.0, 0.4),
}


def transforms(space, steps=STEPS):
    for (parent, child), six in steps.items():
        yield StaticTransform(0, "/tf_static", parent, child, frozen(space.seven(space.from_extrinsics(six))))


def mounted(space, base="base_link", extrinsics=None, order=1) -> Mounts:
    mounts = Mounts(space, base, extrinsics or {})
    for transform in list(transforms(space))[::order]:
        mounts.add(transform)
    return mounts


def step(space, parent, child):
    return space.from_extrinsics(STEPS[parent, child])


@BOTH
@pytest.mark.parametrize("order", [1, -1])
def test_a_frame_is_found_through_the_nearest_common_ancestor(space, order):
    mounts = mounted(space, order=order)
    up = step(space, "footprint", "base_link").inverse()
    expected = up.compose(step(space, "footprint", "mast")).compose(step(space, "mast", "laser"))
    assert mounts.get("laser").equals(expected, 1e-9)
    assert mounts.get("camera").equals(step(space, "base_link", "camera"), 1e-9)
    assert mounts.get("footprint").equals(up, 1e-9)


@BOTH
def test_the_base_has_three_names_and_one_object(space):
    mounts = mounted(space)
    assert mounts.get("") is mounts.get("base") is mounts.get("base_link") is space.identity


@BOTH
def test_an_unknown_frame_is_none_until_it_is_told(space):
    mounts = Mounts(space, "base_link", {})
    assert mounts.get("camera") is None
    for transform in transforms(space):
        mounts.add(transform)
    assert mounts.get("camera") is not None
    assert mounts.get("tail") is None


@BOTH
def test_the_configuration_wins_for_a_frame_and_for_what_hangs_below_it(space):
    """Who corrects the mast in the configuration has moved its laser too."""
    given = (7.0, 8.0, 9.0, 0.0, 0.0, 0.25)
    mounts = mounted(space, extrinsics={"/mast": given})
    mast = space.from_extrinsics(given)
    assert mounts.get("mast").equals(mast, 1e-12)
    assert mounts.get("laser").equals(mast.compose(step(space, "mast", "laser")), 1e-9)
    assert mounts.get("camera").equals(step(space, "base_link", "camera"), 1e-9)


@BOTH
def test_a_newer_transform_replaces_the_older(space):
    mounts = mounted(space)
    assert mounts.get("camera") is not None
    moved = {("base_link", "camera"): (2.0, 0, 0, 0, 0, 0)}
    for transform in transforms(space, moved):
        mounts.add(transform)
    assert mounts.get("camera").equals(space.from_extrinsics((2.0, 0, 0, 0, 0, 0)), 1e-9)


@BOTH
def test_slashes_before_names_mean_nothing(space):
    mounts = Mounts(space, "/base_link", {})
    for transform in transforms(space, {("/base_link", "/camera"): STEPS["base_link", "camera"]}):
        mounts.add(transform)
    assert mounts.get("base_link") is space.identity
    assert mounts.get("camera").equals(step(space, "base_link", "camera"), 1e-9)


@BOTH
def test_the_odometry_names_the_base_unless_the_configuration_did(space):
    mounts = mounted(space, base="")
    assert mounts.get("camera") is None
    mounts.name_base("/base_link")
    assert mounts.get("camera") is not None
    mounts.name_base("mast")
    assert mounts.get("base_link") is space.identity
    nameless = Mounts(space, "", {})
    nameless.name_base("")
    assert nameless.get("mast") is None


@BOTH
def test_loops_in_the_tree_neither_hang_nor_hide_what_hangs_below_the_base(space):
    mounts = mounted(space)
    wrong = {("laser", "footprint"): (0,) * 6, ("camera", "camera"): (1.0, 0, 0, 0, 0, 0)}
    before = mounts.get("camera")
    for transform in transforms(space, wrong):
        mounts.add(transform)
    assert mounts.get("camera").equals(before, 1e-9)
    assert mounts.get("laser") is not None
    assert mounts.get("tail") is None


def test_in_space_the_whole_rotation_counts():
    six = (0.1, 0.2, 0.3, -1.5, 0.2, 1.0)
    mounts = Mounts(SPACES["3d"], "b", {"camera": six})
    expected = gtsam.Pose3(gtsam.Rot3.RzRyRx(*six[3:]), np.array(six[:3]))
    assert mounts.get("camera").equals(expected, 1e-12)
