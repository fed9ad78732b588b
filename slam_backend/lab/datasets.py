"""Public data sets as bags: those inside gtsam's wheel, and others from a folder of their files (RECORDINGS).

What the files leave unsaid, and how it is read here:

Noise of Victoria Park. `ODOMETRY i j dx dy dtheta v1..v6` and `LANDMARK i l x y v1 v2 v3`: the v are the upper triangle,
row by row, of a covariance: of the increment (m, m, rad) at pose j, and of x, y in the vehicle's frame. The odometry
decides it: 1e-4 and 4e-6 are 1 cm, 2 mm and 2 mrad a step as variances, but 0.1 mm and 4 micrometres as standard deviations,
and 100 m and 500 m as information. The trees are the same writer's: 0.4 is a variance, 0.63 m. The optimum agrees: chi2 is 6347
on 6978 degrees of freedom (8825 with 0.4 m, 4299 with 1 / sqrt(0.4) m).

Noise of the pose graphs. In sphere2500.txt the triangle is the upper triangular *root* of the information: the edges differ
from those of sphere2500_groundtruth.txt by 0.1 m and 0.01, 0.01, 0.04 rad, which is 1 / (10, 100, 100, 25). (Taken as
information the numbers claim 0.32 m and 0.1, 0.1, 0.2 rad.) city10000 states none: against ISAM2_GT_city10000.txt its edges
are 0.02 m and 0.01 rad off. w10000 states the identity, which is its own root. All at the tangent of the second pose.

Noise of Plaza. None is stated: 0.01 m and 0.003 rad per 0.2 s, growing with the root of time, is what worked; ranges 1 m
(with a robust kernel: some are metres off). The ranges are as measured: 7 % too long. The truth of Plaza2 looks backwards, and
is turned round.

Time. Only Plaza tells it. The poses of Victoria Park are scans of a laser that ran at 4.7 Hz: 0.2 s apart. Graphs: 0.1 s.

Planar data say nothing of z, roll and pitch: they get the noise of y and of yaw, so that a replay in 3-D works too.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import BadConfig
from ..core.geometry import covariance_to_ros, seven_of_matrix
from ..core.measurement import SECOND, Array
from ..core.sensors.odometry import UNKNOWN
from ..io.bags import write_bag
from ..io.encode import encode_cloud, encode_odometry
from ..io.formats import tum
from ..io.formats.trajectory import Trajectory
from ..io.records import Record
from . import kitti_features, mrclam, pose_graphs, rtklib, victoria_raw
from .gtsam_data import Content, example, lifted, planar, rows, symmetric
from .kitti import kitti_imu_gnss
from .matlab import read_arrays
from .simulate import CLOUD, ODOMETRY, START, beside
from .world import chain

SCAN = SECOND // 5  # ns between the poses of Victoria Park
BASE = "base_link"


@dataclass(frozen=True, slots=True)
class Dataset:
    description: str
    read: Callable[[], Content]


@dataclass(frozen=True, slots=True)
class Recording:
    """A data set that gtsam does not bring: from a folder of its own files."""

    description: str
    read: Callable[[Path], Content]


class Made(NamedTuple):
    """What was written: `seconds` from the first to the last message; `truth` as TUM where there is one."""

    path: Path
    messages: int
    description: str
    seconds: float
    truth: Path | None = None


def make_dataset(
    name: str, out: Path, advance: Callable[[int], None] = lambda _: None, folder: Path | None = None
) -> Made:
    """Write one of DATASETS, or one of RECORDINGS from its folder, as a bag at `out`; `advance` hears of every message.

    BadConfig for another name, or where the folder is missing or of no use; BadFile for what is wrong in it.
    """
    content = _content(name, folder)
    records = sorted(content.records, key=lambda record: record.log_time)
    write_bag(out, _counted(records, advance))
    truth = None
    if content.truth is not None:
        truth = beside(out, ".truth.tum")
        tum.write(truth, content.truth)
    seconds = (records[-1].log_time - records[0].log_time) / SECOND
    known = RECORDINGS[name] if name in RECORDINGS else DATASETS[name]
    return Made(out, len(records), known.description, seconds, truth)


def _content(name: str, folder: Path | None) -> Content:
    if name in RECORDINGS:
        if folder is None:
            raise BadConfig(f"'{name}' does not come with gtsam: name the folder of its files with --from")
        return RECORDINGS[name].read(folder)
    if name not in DATASETS:
        raise BadConfig(f"there is no data set '{name}'; known: {', '.join([*DATASETS, *RECORDINGS])}")
    if folder is not None:
        raise BadConfig(f"'{name}' comes with gtsam: it is not read from a folder")
    return DATASETS[name].read()


def _counted(records: Iterable[Record], advance: Callable[[int], None]) -> Iterator[Record]:
    for record in records:
        yield record
        advance(1)


def _victoria_park() -> Content:
    lines = rows("victoria_park.txt")
    odometry = np.array([row[3:] for row in lines if row[0] == "ODOMETRY"], dtype=np.float64)
    # Poses and trees share one numbering, poses in order of appearance.
    ranks = {"0": 0} | {row[2]: k + 1 for k, row in enumerate(row for row in lines if row[0] == "ODOMETRY")}
    stamps = [START + k * SCAN for k in range(len(ranks))]
    records = _odometry(stamps, odometry[:, :3], lifted(symmetric(odometry[:, 3:])))
    seen: dict[int, list[list[str]]] = {}
    for row in lines:
        if row[0] == "LANDMARK":
            seen.setdefault(stamps[ranks[row[1]]], []).append(row)
    for stamp, trees in seen.items():
        values = np.array([row[3:] for row in trees], dtype=np.float64)
        covariances = np.zeros((len(trees), 3, 3))
        covariances[:, :2, :2] = symmetric(values[:, 2:])
        covariances[:, 2, 2] = covariances[:, 0, 0]
        columns: dict[str, NDArray[Any]] = {
            "id": np.array([row[2] for row in trees], dtype=np.uint32),
            "x": values[:, 0],
            "y": values[:, 1],
            "cov": covariances.reshape(-1, 9),
        }
        records.append(Record("/trees", CLOUD, stamp + SECOND // 1000, encode_cloud(stamp, BASE, columns)))
    return Content(records)


def _plaza(name: str) -> Content:
    """DR: rows of time (s), distance (m) and turn (rad) since the row before. TD: time, receiver, beacon, range. GT: time and pose."""
    arrays = read_arrays(example(f"{name}_.mat"))
    table, truth = arrays["DR"], arrays["GT"]
    steps = np.stack([table[1:, 1], np.zeros(len(table) - 1), table[1:, 2]], axis=1)
    share = np.diff(table[:, 0])[:, None, None] / 0.2
    records = _odometry(_stamps(table), steps, lifted(np.diag([0.01, 0.01, 0.003]) ** 2 * share))
    for stamp, (_, _, beacon, distance) in zip(_stamps(arrays["TD"]), arrays["TD"], strict=True):
        columns: dict[str, NDArray[Any]] = {
            "id": np.array([beacon], dtype=np.uint32), "range": np.array([distance]), "sigma_range": np.array([1.0])
        }  # fmt: skip
        records.append(Record("/ranges", CLOUD, stamp, encode_cloud(stamp, BASE, columns)))
    turned = np.pi if name == "Plaza2" else 0.0
    poses = np.array([planar(x, y, yaw + turned).matrix() for _, x, y, yaw in truth])
    return Content(records, Trajectory(np.array(_stamps(truth)), seven_of_matrix(poses)))


def beacons(name: str) -> Mapping[str, Array]:
    """Where the beacons of plaza1 or plaza2 truly stand: id -> x, y in the frame of the truth."""
    table = read_arrays(example(f"{name.capitalize()}_.mat"))["TL"]
    return {str(int(beacon)): np.array(place) for beacon, *place in table.tolist()}


def _stamps(table: Array) -> list[int]:
    return [round(t * 1e9) for t in table[:, 0].tolist()]


def _odometry(stamps: list[int], steps: Array, covariances: Array) -> list[Record]:
    """N stamps, N - 1 steps x y yaw, and their (N - 1, 6, 6) covariances in GTSAM's order, as messages on /odom.

    The twist is the step over its time and its covariance the step's over the time squared; the pose states none.
    """
    sevens = seven_of_matrix(chain(np.array([planar(*step).matrix() for step in steps])))
    seconds = np.diff(stamps) / SECOND
    twists = np.zeros((len(stamps), 6))
    twists[1:, [0, 1, 5]] = steps / seconds[:, None]
    noises = covariance_to_ros(covariances, np.eye(3)) / seconds[:, None, None] ** 2
    noises = np.concatenate([noises[:1], noises]).reshape(-1, 36)
    return [
        Record("/odom", ODOMETRY, stamp, encode_odometry(stamp, "odom", BASE, seven, UNKNOWN, twist, noise))
        for stamp, seven, twist, noise in zip(stamps, sevens, twists, noises, strict=True)
    ]


DATASETS: Mapping[str, Dataset] = {
    "victoria_park": Dataset(
        "a truck among trees: 6,969 poses on /odom, 3,640 sightings of 151 trees on /trees; 2-D", _victoria_park
    ),
    "plaza1": Dataset(
        "a lawn mower, 32 min: 9,657 poses on /odom, 3,529 ranges to 4 beacons on /ranges; 2-D", partial(_plaza, "Plaza1")
    ),
    "plaza2": Dataset(
        "a lawn mower, 7 min: 4,090 poses on /odom, 1,816 ranges to 4 beacons on /ranges; 2-D", partial(_plaza, "Plaza2")
    ),
    "kitti_imu_gnss": Dataset(
        "a car in a town, 8 min: 46,968 samples of an IMU on /imu, 470 fixes on /fix; 3-D", kitti_imu_gnss
    ),
    "kitti_stereo": Dataset(
        "a car with a stereo camera, 8 s: 77 poses on /odom, 52,544 sightings of 15,638 features on /features; 3-D", kitti_features.stereo
    ),
    "sphere2500": Dataset(
        "simulated, on a sphere: 2,500 poses, 4,949 relative poses on /edges, truth on /truth; 3-D", pose_graphs.sphere2500
    ),
    "city10000": Dataset(
        "simulated, in a city: 10,000 poses, 20,687 relative poses on /edges, truth on /truth; 2-D", pose_graphs.city10000
    ),
    "w10000": Dataset(
        "simulated, in a grid: 10,000 poses, 64,311 relative poses on /edges; 2-D", pose_graphs.w10000
    ),
}  # fmt: skip

RECORDINGS: Mapping[str, Recording] = {
    "rtklib": Recording("a receiver's solution (.pos) on /fix, with imu*.csv on /imu", rtklib.read),
    "victoria_park_raw": Recording(
        "a truck among trees as recorded: wheel and steering on /odom, trunks without ids on /trees; 2-D", victoria_raw.read
    ),
    **{
        f"mrclam{robot}": Recording(
            f"robot {robot} of MRCLAM, among 15 landmarks on /landmarks and four robots on /robots; 2-D",
            partial(mrclam.read, robot=robot),
        )
        for robot in mrclam.ROBOTS
    },
}  # fmt: skip
