"""The pose graphs inside gtsam's wheel as relative poses between stamps; `datasets.py` says how their noise is read."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..core.geometry import covariance_to_ros, seven_of_matrix
from ..core.graph import Motion
from ..core.measurement import SECOND, Array, format_stamp
from ..core.sensors.odometry import STILL, UNKNOWN
from ..io.encode import encode_odometry
from ..io.formats.trajectory import Trajectory
from ..io.records import Record
from .gtsam_data import Content, lifted, planar, pose, rows
from .simulate import ODOMETRY, START
from .world import chain

BASE = "base_link"
VERTEX = SECOND // 10  # ns between two vertices


class Edge(NamedTuple):
    """`i_T_j` between vertices, its covariance at the tangent of j."""

    i: int
    j: int
    motion: Motion


def sphere2500() -> Content:
    edges = []
    for row in rows("sphere2500.txt"):
        numbers = np.array(row[3:], dtype=np.float64)
        root = np.zeros((6, 6))
        root[np.triu_indices(6)] = numbers[6:]
        order = [3, 4, 5, 0, 1, 2]  # x y z roll pitch yaw, to GTSAM's
        covariance = np.asarray(np.linalg.inv(root.T @ root)[np.ix_(order, order)], dtype=np.float64)
        edges.append(Edge(int(row[1]), int(row[2]), Motion(pose(*numbers[:6]), covariance)))
    steps = [row for row in rows("sphere2500_groundtruth.txt") if int(row[2]) == int(row[1]) + 1]
    true_steps = [pose(*map(float, row[3:9])).matrix() for row in steps]
    return _graph(edges, seven_of_matrix(chain(np.array(true_steps))))


def city10000() -> Content:
    """`EDGE2 i 1 j 0 n` and n guesses `dx dy dtheta`: of two, the first is the right one (in all 200 cases)."""
    covariance = lifted(np.diag([0.02, 0.02, 0.01]) ** 2)
    edges = [
        Edge(int(row[1]), int(row[3]), Motion(planar(*map(float, row[6:9])), covariance))
        for row in rows("T1_city10000_04.txt")
    ]
    truth = [planar(*map(float, row)).matrix() for row in rows("ISAM2_GT_city10000.txt")]
    return _graph(edges, seven_of_matrix(np.array(truth)))


def w10000() -> Content:
    """Each edge is written from the newer vertex to the older. The first guesses and EQUIV lines are not used."""
    noise = lifted(np.eye(3))
    return _graph(
        Edge(int(row[1]), int(row[2]), Motion(planar(*map(float, row[3:6])), noise))
        for row in rows("w10000.graph")
        if row[0] == "EDGE2"
    )


def _graph(edges: Iterable[Edge], truth: Array | None = None) -> Content:
    """Edges in the order in which a robot could measure them: by the newer vertex, its motion first."""
    forward = (e if e.i < e.j else Edge(e.j, e.i, e.motion.inverse()) for e in edges)
    records = []
    for n, (i, j, motion) in enumerate(sorted(forward, key=lambda e: (e.j, e.i != e.j - 1, e.i))):
        ends = [START + vertex * VERTEX for vertex in (i, j)]
        parent, child = (f"{BASE}@{format_stamp(end)}" for end in ends)
        matrix = motion.pose.matrix()
        noise = covariance_to_ros(motion.covariance, matrix[:3, :3]).reshape(36)
        data = encode_odometry(ends[1], parent, child, seven_of_matrix(matrix), noise, STILL, UNKNOWN)
        records.append(Record("/edges", ODOMETRY, ends[1] + 1 + n, data))
    if truth is None:
        return Content(records)
    stamps = [START + vertex * VERTEX for vertex in range(len(truth))]
    for stamp, seven in zip(stamps, truth, strict=True):
        data = encode_odometry(stamp, "map", BASE, seven, UNKNOWN, STILL, UNKNOWN)
        records.append(Record("/truth", ODOMETRY, stamp, data))
    return Content(records, Trajectory(np.array(stamps), truth))
