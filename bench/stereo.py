"""Stereo features of KITTI 00: the batch optimum beside gtsam's own, and what a frame costs beside a bare loop with the same factors."""

from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import gtsam
import numpy as np

from bench.table import Row
from slam_backend.core.backend import Backend
from slam_backend.core.graph import Decision
from slam_backend.core.solvers.batch import solve
from slam_backend.io.configfile import configured, load_config
from slam_backend.io.inputs import open_inputs
from slam_backend.io.replay import replay, settled_stream
from slam_backend.lab.datasets import make_dataset

CONFIG = Path(__file__).parents[1] / "config/kitti_stereo.yaml"
OPTIMUM = 7399.0425  # of all sightings, from gtsam by itself, the first camera fixed
ALL = ("features.probability=1", "features.share=10")  # no sighting is doubted, no point too far
TURNS = 3


def stereo() -> list[Row]:
    with TemporaryDirectory() as folder:
        bag = make_dataset("kitti_stereo", Path(folder) / "stereo.mcap").path
        return [*_batch(bag), *_online(bag)]


def _batch(bag: Path) -> list[Row]:
    """Every sighting of the file, from where the points are triangulated first."""
    result = replay(bag, configured(load_config(CONFIG), ALL)).result
    factors, start = list(result.factors), result.run.backend.dead_reckoning()
    ours, bare, cost = [], [], 0.0
    for _ in range(TURNS):
        before = process_time()
        cost = solve(factors, start).cost
        ours.append(process_time() - before)
        before = process_time()
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor.factor)
        gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
        bare.append(process_time() - before)
    ratio = float(np.median(np.array(ours) / bare))
    off = abs(cost / OPTIMUM - 1)
    return [
        Row(
            "KITTI stereo, batch, every sighting: cost",
            f"{cost:.2f}",
            f"{OPTIMUM:.2f} gtsam",
            off,
            "<= 0.001",
        ),
        Row(
            "the same: time", f"{np.median(ours):.2f} s", f"{np.median(bare):.2f} s bare LM", ratio, "<= 1.2"
        ),
    ]


def _online(bag: Path) -> list[Row]:
    """With the defaults; what it costs beside a bare loop is in bench/sensors.py."""
    config = load_config(CONFIG)
    backend, frames = Backend(config), []
    with open_inputs([bag]) as inputs:
        items = [
            item for item in settled_stream(inputs.stream(config), config) if not isinstance(item, Decision)
        ]
    for item in items:
        before = process_time()
        if backend.add(item):
            frames.append(process_time() - before)
    p99 = float(np.percentile(frames, 99))
    return [Row("KITTI stereo, online: a frame, p99", f"{p99:.3f} s", "-", p99, "<= 0.5")]
