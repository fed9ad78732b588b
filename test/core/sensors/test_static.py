"""/tf_static: one transform per pair of frames, no factors."""

from types import SimpleNamespace

import numpy as np

from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.static import decode, factors


def transform(parent, child, x) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=4, nanosec=5)
    there = SimpleNamespace(
        translation=SimpleNamespace(x=x, y=2.0, z=3.0), rotation=SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8)
    )
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=parent), child_frame_id=child, transform=there
    )


def test_each_transform_of_a_message_is_a_record():
    told = list(
        decode(
            SimpleNamespace(transforms=[transform("base", "a", 1.0), transform("a", "b", 9.0)]), "/tf_static"
        )
    )
    assert [(t.parent, t.child, t.stamp, t.source) for t in told] == [
        ("base", "a", 4 * SECOND + 5, "/tf_static"),
        ("a", "b", 4 * SECOND + 5, "/tf_static"),
    ]
    np.testing.assert_array_equal(told[1].pose, [9, 2, 3, 0, 0, 0.6, 0.8])
    assert not list(decode(SimpleNamespace(transforms=[]), "/tf_static"))


def test_static_transforms_make_no_factors(world):
    a, b = world.timeline.keyframes[:2]
    assert not factors([], a, b, world.context(), None)
