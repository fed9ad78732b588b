"""run.mcap: a finished run as a bag, so that Foxglove and RViz play it corrected.

Path, trajectory, landmarks and graph come first, whole and final; then map -> odom at each keyframe, as the finished map
has it, and every decision at its stamp. The topics and types are those of the node (`ros/outputs.py`). Log times are
data stamps, moved by how much later the driving topic was logged than stamped, so that they fit those of the inputs.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from heapq import merge
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from ..core.errors import BadFile
from ..core.geometry import inverse_of, matrix_of, seven_of_matrix
from ..core.sensors.odometry import TRANSFORMS, OdometryPose
from ..core.trajectory import Trajectory
from .bags import Bag, open_bag
from .cdr import Decoder
from .drawing import drawn_graph, landmark_cloud, newest, status_of, trajectory_cloud
from .encode import encode_diagnostics, encode_markers, encode_path, encode_transforms
from .inputs import TF_STATIC, BagInputs
from .records import Record
from .result import Result
from .rundir import INPUTS, RESULT_BAG
from .typestore import typestore_of
from .writing import write_bag

With = Literal["link", "copy"]
TF, MAP = "/tf", "map"
NODE = "/slam_backend/"
LATCHED = {  # name below the node's own -> type
    "path": "nav_msgs/msg/Path",
    "trajectory": "sensor_msgs/msg/PointCloud2",
    "landmarks": "sensor_msgs/msg/PointCloud2",
    "graph": "visualization_msgs/msg/MarkerArray",
}
DECISIONS = "diagnostic_msgs/msg/DiagnosticArray"
LOOKED_AT = 2000  # messages of /tf, to see whether they hold odom -> base


class Robot(NamedTuple):
    """The frames of the driving odometry, and how much later (ns) than stamped it was logged."""

    odom: str = "odom"
    base: str = "base_link"
    later: int = 0


def write_result_bag(result: Result, out: Path, inputs: With) -> int:
    """Write run.mcap into the run directory `out` and return the number of records.

    inputs: copy: their records are in it too, but for transforms to the odometry's frame, of which there must be one parent
    only; link: symbolic links to them stand beside it. BadFile if that cannot be written.
    """
    with ExitStack() as stack:
        paths = result.run.inputs.paths if isinstance(result.run.inputs, BagInputs) else []
        bags = [stack.enter_context(open_bag(path)) for path in paths]
        store = typestore_of([connection for bag in bags for connection in bag.connections])
        robot = _robot(result, bags)
        own = sorted(_records(result, robot, _moves_base(bags, robot)), key=lambda record: record.log_time)
        streams = [_copied(bag, robot, store) for bag in bags] if inputs == "copy" else []
        if inputs == "link":
            _link(paths, out / INPUTS)
        (out / RESULT_BAG).unlink(missing_ok=True)
        records = merge(own, *streams, key=lambda record: record.log_time)
        latched = {TF_STATIC, *(NODE + name for name in LATCHED)}
        return write_bag(out / RESULT_BAG, records, store, strictly_increasing=True, latched=latched)


def _records(result: Result, robot: Robot, moves_base: bool) -> Iterator[Record]:
    """What the run has to say; unsorted."""
    snapshot, width = result.snapshot, result.run.config.keyframes.distance / 10
    stamp, start = newest(snapshot), int(snapshot.stamps[0]) + robot.later
    whole = {
        "path": encode_path(MAP, stamp, snapshot.stamps, snapshot.trajectory.sevens),
        "trajectory": trajectory_cloud(stamp, MAP, snapshot, None),
        "landmarks": landmark_cloud(stamp, MAP, snapshot, None),
        "graph": encode_markers(stamp, MAP, drawn_graph(snapshot, result.decisions, width)),
    }
    for name, data in whole.items():
        yield Record(NODE + name, LATCHED[name], start, data)
    odometry = result.run.backend.track.trajectory()
    yield from _transforms(MAP, robot.odom, _corrections(snapshot.trajectory, odometry), robot.later)
    if not moves_base:
        yield from _transforms(robot.odom, robot.base, odometry, robot.later)
    for decision in result.decisions:
        data = encode_diagnostics(decision.stamp, [status_of(decision)])
        yield Record(NODE + "decisions", DECISIONS, max(decision.stamp + robot.later, start), data)


def _corrections(keyframes: Trajectory, odometry: Trajectory) -> Trajectory:
    """map_T_odom at each keyframe that the odometry covers."""
    there = odometry.at(keyframes.stamps)
    rows = np.isfinite(there).all(axis=1)
    poses = keyframes.poses[rows] @ inverse_of(matrix_of(there[rows]))
    return Trajectory(keyframes.stamps[rows], seven_of_matrix(poses))


def _transforms(parent: str, child: str, poses: Trajectory, later: int) -> Iterator[Record]:
    for stamp, seven in zip(poses.stamps.tolist(), poses.sevens, strict=True):
        yield Record(TF, TRANSFORMS, stamp + later, encode_transforms(stamp, parent, {child: seven}))


def _robot(result: Result, bags: Sequence[Bag]) -> Robot:
    """From the first message of the driving odometry."""
    config = result.run.config
    driver = config.sources.get(config.driver or "")
    if driver is None or driver.kind != "odometry":
        return Robot()
    for bag in bags:
        decoder = Decoder(bag.typestore, {driver.topic: (config.driver or "", "odometry")})
        for record in bag.records({driver.topic}):
            for item in decoder.decode(record):
                if isinstance(item, OdometryPose):
                    base = item.child or config.base_frame or Robot().base
                    return Robot(item.frame or Robot().odom, base, record.log_time - item.stamp)
    return Robot()


def _moves_base(bags: Iterable[Bag], robot: Robot) -> bool:
    """Whether the inputs say on /tf where the base is in the odometry's frame."""
    for bag in bags:
        if TF in bag.topics and bag.topics[TF].type == TRANSFORMS:
            for record in islice(bag.records({TF}), LOOKED_AT):
                message: Any = bag.typestore.deserialize_cdr(record.data, TRANSFORMS)
                if any(_name(t.header.frame_id) == _name(robot.odom) for t in message.transforms):
                    return True
    return False


def _copied(bag: Bag, robot: Robot, store: Typestore) -> Iterator[Record]:
    """The records of an input whose types are known, without what the run says itself."""
    for record in bag.records():
        if record.topic.startswith(NODE) or record.type not in store.fielddefs:
            continue
        if record.topic == TF and record.type == TRANSFORMS:
            data = _without(record.data, robot.odom, store)
            if data is not None:
                yield replace(record, data=data)
        else:
            yield record


def _without(data: bytes, child: str, store: Typestore) -> bytes | None:
    """A TFMessage without the transforms to one frame; None if nothing is left of it."""
    message: Any = store.deserialize_cdr(data, TRANSFORMS)
    kept = [each for each in message.transforms if _name(each.child_frame_id) != _name(child)]
    if len(kept) == len(message.transforms):
        return data
    return bytes(store.serialize_cdr(replace(message, transforms=kept), TRANSFORMS)) if kept else None


def _name(frame: str) -> str:
    """Old bags write frames with a slash before them."""
    return frame.removeprefix("/")


def _link(paths: Sequence[Path], folder: Path) -> None:
    """Symbolic links to the inputs; those of an earlier run are replaced."""
    try:
        folder.mkdir(exist_ok=True)
        for n, path in enumerate(paths):
            twins = [other for other in paths if other.name == path.name]
            (folder / (f"{n}_{path.name}" if len(twins) > 1 else path.name)).symlink_to(path.resolve())
    except OSError as error:
        raise BadFile(f"{folder}: cannot be written: {error.strerror or error}; use --bag copy") from None
