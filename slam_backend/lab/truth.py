"""Where the robot truly was: from a trajectory file or from a topic of a bag."""

from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.sensors.odometry import DECODERS, TRANSFORMS, OdometryPose
from ..core.trajectory import Trajectory
from ..io.bags import Bag, open_bag
from ..io.cdr import Decoder
from ..io.formats import format_of, read_trajectory

BAGS = (".bag", ".mcap", ".db3")
POSES = sorted(set(DECODERS) - {TRANSFORMS})


def load_truth(path: Path, topic: str = "") -> Trajectory:
    """TUM, KITTI, EuRoC or our csv, or the poses of a bag's topic, in the order of stamps. BadFile says what is missing."""
    if path.is_dir() or path.suffix in BAGS:
        with open_bag(path) as bag:
            return _of_bag(bag, topic)
    if topic:
        raise BadFile(f"{path}: is no bag: it has no topic '{topic}'")
    return load_trajectory(path)


def load_trajectory(path: Path) -> Trajectory:
    """Of a file. A stamp that comes again is left out, as its second pose says nothing new of the same moment."""
    found = read_trajectory(path)
    return _sorted(found.stamps, found.sevens)


def has_stamps(path: Path) -> bool:
    """Whether the poses of a file know when they were."""
    return path.is_dir() or path.suffix in BAGS or format_of(path).name != "kitti"


def _of_bag(bag: Bag, topic: str) -> Trajectory:
    known = {name: each.type for name, each in bag.topics.items() if each.type in POSES}
    some = ", ".join(known) or "none"
    if not topic and len(known) != 1:
        raise BadFile(
            f"{bag.path}: which topic is the truth? name it with --topic; with poses there are: {some}"
        )
    topic = topic or next(iter(known))
    if topic not in known:
        raise BadFile(f"{bag.path}: no topic '{topic}' with poses ({', '.join(POSES)}); there are: {some}")
    decoder = Decoder(bag.typestore, {topic: ("truth", "odometry")})
    poses = [
        item
        for record in bag.records({topic})
        for item in decoder.decode(record)
        if isinstance(item, OdometryPose)
    ]
    if not poses:
        raise BadFile(f"{bag.path}: no message of '{topic}' can be read")
    return _sorted(np.array([p.stamp for p in poses]), np.array([p.pose for p in poses]))


def _sorted(stamps: np.ndarray, sevens: np.ndarray) -> Trajectory:
    unique, rows = np.unique(stamps.astype(np.int64), return_index=True)
    sevens = sevens[rows].astype(np.float64)
    sevens[:, 3:] /= np.linalg.norm(sevens[:, 3:], axis=1, keepdims=True)
    return Trajectory(unique, sevens)
