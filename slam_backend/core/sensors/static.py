"""Where the sensors sit, as robots publish it: tf2_msgs/TFMessage on /tf_static. Makes no factors."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..context import Context
from ..graph import Delta, Keyframe, Offer
from ..measurement import Decoder, Message, StaticTransform, frozen, stamp_of


def decode(message: Message, source: str) -> Iterable[StaticTransform]:
    """tf2_msgs/msg/TFMessage."""
    for each in message.transforms:
        p, q = each.transform.translation, each.transform.rotation
        pose = frozen((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        yield StaticTransform(stamp_of(each), source, each.header.frame_id, each.child_frame_id, pose)


DECODERS: Mapping[str, Decoder] = {"tf2_msgs/msg/TFMessage": decode}


def factors(
    window: Sequence[Offer],  # noqa: ARG001  # one signature for the table
    a: Keyframe | None,  # noqa: ARG001
    b: Keyframe,  # noqa: ARG001
    context: Context,  # noqa: ARG001
    config: Any,  # noqa: ARG001
) -> Delta:
    """Nothing: the back-end keeps the frames itself."""
    return Delta()
