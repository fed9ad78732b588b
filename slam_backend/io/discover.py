"""A configuration for an input that came without one: what its topics are, by type and first message."""

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

from ..core.config import Config, config_from
from ..core.errors import BadConfig, BadMessage
from ..core.measurement import Array, Measurement
from ..core.sensors.cloud import columns
from ..core.sensors.gnss import DECODERS as GNSS
from ..core.sensors.imu import DECODERS as IMU
from ..core.sensors.odometry import DECODERS as ODOMETRY
from ..core.sensors.odometry import TRANSFORMS, OdometryPose, decode_transforms
from .bags import Bag
from .inputs import EDGES, LANDMARKS, TF_STATIC, BagInputs, GraphInput
from .records import Record

ENOUGH = (
    200  # messages that are looked at to tell whether the robot moves in a plane, or /tf holds its odometry
)
RANK = {
    "nav_msgs/msg/Odometry": 2,
    TRANSFORMS: 1,
}  # of the types of odometry: others may be poses of anything
TRUTH = (
    "truth",
    "ground",
    "_gt",
    "/gt",
    "vicon",
    "mocap",
)  # parts of names of topics that must not become input


ASIDE = (  # what is said of an IMU
    "an IMU is used where a configuration names it under 'sources' (kind: imu, space: 3d): its mounting and noise must be told"
)
UNASKED = " (an IMU or absolute poses do so where a configuration names them under 'sources')"
COASTING = "fixes tell heights; between them the robot is taken to go on at constant velocity"


def discover(inputs: BagInputs | GraphInput) -> tuple[Config, list[str]]:
    """The configuration, and lines that say what was chosen and what was left aside. BadConfig when nothing drives."""
    if isinstance(inputs, GraphInput):
        return _of_graph(inputs), []
    kinds, notes = _kinds_of(inputs)
    sources: dict[str, dict[str, Any]] = {}
    for topic, kind in kinds.items():
        sources[name_of(topic)] = {"kind": kind, "topic": topic}
    if not any(kind in ("odometry", "relative", "gnss") for kind in kinds.values()):
        where = ", ".join(str(path) for path in inputs.paths)
        has = (
            ", ".join(f"{name} ({topic.type})" for name, topic in inputs.topics.items()) or "no topics at all"
        )
        raise BadConfig(
            f"{where}: no odometry, relative poses or fixes in it that could drive the keyframes{UNASKED}; it has {has}"
        )
    space, why = _space(inputs, kinds)
    notes.append(f"space {space}: {why}")
    return config_from({"space": space, "sources": list(sources), **sources}), notes


def is_truth(topic: str) -> bool:
    """Whether a topic's name says that it is ground truth, which must not become input."""
    return any(part in topic.lower() for part in TRUTH)


def name_of(topic: str) -> str:
    """The name of a source that was found by its topic."""
    return topic.strip("/").replace("/", "_") or "source"


def _of_graph(inputs: GraphInput) -> Config:
    sources: dict[str, Any] = {EDGES: {"kind": "relative"}}
    if inputs.graph.sees_landmarks:
        sources[LANDMARKS] = {"kind": "landmark"}
    return config_from({"space": inputs.graph.space, "sources": list(sources), **sources})


def _kinds_of(inputs: BagInputs) -> tuple[dict[str, str], list[str]]:
    """Topic -> kind, one odometry only: the one with most messages."""
    kinds: dict[str, str] = {}
    notes: list[str] = []
    for topic, (first, bag) in _first_messages(inputs).items():
        if is_truth(topic):
            notes.append(f"{topic} is taken for ground truth and left aside")
            continue
        kind = kind_of(first, bag.typestore)
        if kind == "imu":
            notes.append(f"{topic} is left aside: {ASIDE}")
        elif kind is not None:
            kinds[topic] = kind
    odometries = [topic for topic, kind in kinds.items() if kind == "odometry"]
    best = max(
        odometries,
        key=lambda topic: (RANK.get(inputs.topics[topic].type, 0), inputs.topics[topic].count),
        default=None,
    )
    for topic in odometries:
        if topic != best:
            del kinds[topic]
            notes.append(f"{topic} is left aside: {best} is the odometry")
    notes += [f"{topic} is used as {kind}" for topic, kind in kinds.items()]
    return kinds, notes


def _first_messages(inputs: BagInputs) -> dict[str, tuple[Any, Bag]]:
    first: dict[str, tuple[Any, Bag]] = {}
    types = {*ODOMETRY, *GNSS, *IMU, "sensor_msgs/msg/PointCloud2"}
    for bag in inputs.bags:
        for topic, what in bag.topics.items():
            if what.type in types and topic not in first and topic != TF_STATIC:
                for record in islice(bag.records({topic}), ENOUGH if what.type == TRANSFORMS else 1):
                    first[topic] = (record, bag)
                    if kind_of(record, bag.typestore) is not None:
                        break
    return first


def kind_of(record: Record, typestore: Any) -> str | None:
    """What a topic is, from its first message; None when it is nothing that can be used. An IMU is used only if a configuration wants it."""
    try:
        message: Any = typestore.deserialize_cdr(record.data, record.type)
        if record.type == TRANSFORMS:
            return "odometry" if any(decode_transforms(message, "")) else None
    except Exception:  # noqa: BLE001  # any damage: the decoder will say it, message by message
        return None
    if record.type == "sensor_msgs/msg/PointCloud2":
        return _kind_of_cloud(message)
    if record.type not in ODOMETRY:  # a Range is as a rule a sonar's
        return "gnss" if record.type in GNSS else "imu" if record.type in IMU else None
    if "@" in message.header.frame_id:
        return "relative"
    is_tag = ":" in getattr(message, "child_frame_id", "")  # family:number
    in_map = message.header.frame_id.lstrip("/") == "map"
    absolute = in_map and record.type == "geometry_msgs/msg/PoseWithCovarianceStamped"
    return "landmark" if is_tag else "pose" if absolute else "odometry"


def _kind_of_cloud(message: Any) -> str | None:
    try:
        names = set(columns(message))
    except BadMessage:
        return None
    if "stamp_i_sec" in names:
        return "relative"
    told = {"x", "y"} <= names or not names.isdisjoint({"azimuth", "range"})
    return "landmark" if "id" in names and told else None


def _space(inputs: BagInputs, kinds: dict[str, str]) -> tuple[str, str]:
    """2d where z, roll and pitch are exactly zero in the first poses of the source that drives; and why, in words."""
    driving = [topic for kind in ("odometry", "relative") for topic, k in kinds.items() if k == kind]
    if not driving:
        return "3d", COASTING
    poses = list(islice(_poses(inputs, driving[0]), ENOUGH))
    if poses and all(z == 0 and qx == 0 and qy == 0 for _, _, z, qx, qy, *_ in poses):
        return "2d", "the poses lie in a plane"
    return "3d", "the poses leave the plane"


def _poses(inputs: BagInputs, topic: str) -> Iterator[Array]:
    """Sevens, as the messages have them."""
    for bag in inputs.bags:
        records: Iterable[Any] = bag.records({topic}) if topic in bag.topics else ()
        for record in records:
            if record.type == "sensor_msgs/msg/PointCloud2":
                return
            try:
                message: Any = bag.typestore.deserialize_cdr(record.data, record.type)
            except Exception:  # noqa: BLE001, S112  # as above
                continue
            told = ODOMETRY[record.type](message, "")
            for each in [told] if isinstance(told, Measurement) else told:
                assert isinstance(each, OdometryPose)
                yield each.pose
