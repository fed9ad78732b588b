"""What each sensor costs online, beside a bare loop over gtsam.ISAM2 that is handed the same samples and factors."""

import gc
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, NamedTuple

import gtsam
import numpy as np

from bench.park import parameters as solver_parameters
from bench.table import Row
from slam_backend.core.backend import Backend
from slam_backend.core.config import Config
from slam_backend.core.graph import Decision, Delta, Estimate, Factor, total
from slam_backend.core.inertial import imu_of, parameters
from slam_backend.core.measurement import SECOND, Array, ImuSample, Measurement, StaticTransform
from slam_backend.core.mounts import Mounts
from slam_backend.core.sensors.pixels import PixelFrame
from slam_backend.core.solvers.isam2 import JOINING, Isam2
from slam_backend.core.space import SPACES
from slam_backend.core.variables import estimate_in
from slam_backend.io.configfile import configured, load_config
from slam_backend.io.inputs import open_inputs
from slam_backend.io.replay import settled_stream
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import simulate, write_simulation

TITLE = "Sensors: what each costs"
EXPLANATION = (
    "CPU time of `Backend.add` per keyframe, records in memory, beside a bare loop over gtsam.ISAM2 of the same settings: one update per "
    "keyframe with the same factors, after a loop further ones until nothing is linearized anew, IMU samples preintegrated and stereo "
    "factors made from their pixels by the loop itself, then the newest pose (velocity, bias) asked; first guesses and all other factors "
    "are given to it. Nothing judges loops. Medians of alternating runs; what the run before has left behind is freed before each, and "
    "Python's garbage collection does not look through what the bench holds. What is above the bare loop: making the factors, a state at "
    "every stamp, the track, ids, decisions, fixes and pixels that are judged, checks of what the solver answers, a factor store from which "
    "it can be rebuilt. That is some 70 us of Python per keyframe, 40 us per landmark that is seen and 0.4 ms per fix, whatever the graph: "
    'beside an update that takes 50 us it is much, beside those of a graph with many loops little (see "Online" and "Victoria Park").'
)
CONFIGS = Path(__file__).parents[1] / "config"
DRIVES = {  # simulated: scenario, options
    "odometry": ("city", Options(poses=800)),
    "odometry and IMU, 10 samples per keyframe": ("city", Options(poses=800, imu_rate=100.0)),
    "odometry and fixes, one in 5 keyframes": ("city", Options(poses=800, gnss_every=5)),
    "odometry and landmarks": ("warehouse", Options(poses=800)),
}
SETS = {  # of gtsam: name, configuration
    "IMU and fixes, KITTI, 50 samples per keyframe": "kitti_imu_gnss",
    "stereo pixels, KITTI": "kitti_stereo",
}
Sample = tuple[Array, Array, float]
BOUND = "<= 1.3"
PASSES = 3


class Pixel(NamedTuple):
    """What a stereo factor is made of: u, right u, v; noise, calibration and mount as a loop would share them."""

    place: tuple[float, float, float]
    noise: Any
    calibration: Any
    mount: Any


class Records(NamedTuple):
    """What the bare loop makes factors of. samples: of the IMU, by the stamp of the keyframe that they lead to: acceleration, rate
    and seconds of each. pixels: by the id of the factor.
    """

    samples: Mapping[int, Sequence[Sample]]
    pixels: Mapping[str, Pixel]


@dataclass(frozen=True, slots=True)
class Stream:
    config: Config
    items: Sequence[Measurement]


class Recorded(Isam2):
    """Keeps the changes that it was given."""

    def __init__(self, config: Config) -> None:
        super().__init__(config, SPACES[config.space])
        self.deltas: list[Delta] = []

    def update(self, delta: Delta) -> Estimate:
        self.deltas.append(delta)
        return super().update(delta)


def rows(names: Sequence[str] = (*DRIVES, *SETS)) -> list[Row]:
    return [row for name, stream in _streams(names) for row in _rows(name, stream)]


def _streams(names: Sequence[str]) -> Iterator[tuple[str, Stream]]:
    with TemporaryDirectory() as folder:
        for name in names:
            if name in DRIVES:
                scenario, options = DRIVES[name]
                written = write_simulation(
                    simulate(scenario, 1, options), Path(folder) / f"{scenario}{len(name)}.mcap"
                )
                yield name, _stream(written.bag, written.config)
            else:
                bag = make_dataset(SETS[name], Path(folder) / f"{SETS[name]}.mcap").path
                yield name, _stream(bag, CONFIGS / f"{SETS[name]}.yaml")


def _stream(bag: Path, config_file: Path) -> Stream:
    config = configured(load_config(config_file), ("robust=[]",))
    with open_inputs([bag]) as inputs:
        items = list(settled_stream(inputs.stream(config), config))
    return Stream(config, [item for item in items if not isinstance(item, Decision)])


def _rows(name: str, stream: Stream) -> Iterator[Row]:
    changes, qr = _changes(stream)
    records = _records(stream, changes)
    bare(changes, records, stream.config, qr)  # warm
    gc.collect()
    gc.freeze()
    pairs = [(ours(stream), bare(changes, records, stream.config, qr)) for _ in range(PASSES)]
    gc.unfreeze()
    each, loop = (1e6 * median(seconds) / len(changes) for seconds in zip(*pairs, strict=True))
    ratio = median(own / theirs for own, theirs in pairs)
    yield Row(name, f"{each:.0f} us per keyframe", f"{loop:.0f} us bare", ratio, BOUND)


def ours(stream: Stream) -> float:
    backend = Backend(stream.config)
    gc.collect()  # else the graph of the run before is taken apart in the middle of this one
    begin = process_time()
    for item in stream.items:
        backend.add(item)
    return process_time() - begin


def _changes(stream: Stream) -> tuple[list[Delta], bool]:
    """What was given to the solver, one change per measurement that made keyframes; and whether it has come to QR."""
    solver, found = Recorded(stream.config), list[Delta]()
    backend = Backend(stream.config, solver)
    for item in stream.items:
        if backend.add(item):
            found.append(_whole(solver.deltas))
        solver.deltas.clear()
    return found, solver._qr  # noqa: SLF001  # nobody else asks


def _whole(deltas: Sequence[Delta]) -> Delta:
    """Without what came and went at the same keyframe."""
    change = total(deltas)
    gone = set(change.remove) & {factor.id for factor in change.add}
    return replace(change, add=tuple(each for each in change.add if each.id not in gone))


def bare(changes: Sequence[Delta], records: Records, config: Config, qr: bool) -> float:
    """CPU seconds of the loop that one would write without us; of its factors those of IMU and pixels are made, the others copied.

    qr: from the start, where Cholesky throws.
    """
    settings = solver_parameters(config)
    settings.setFactorization("QR" if qr else "CHOLESKY")
    isam = gtsam.ISAM2(settings)
    gc.collect()
    begin = process_time()
    _loop(isam, changes, records, config)
    return process_time() - begin


def _loop(isam: gtsam.ISAM2, changes: Sequence[Delta], records: Records, config: Config) -> None:
    slots, space, params = dict[str, int](), SPACES[config.space], _noise(config)
    for change in changes:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in change.add:
            if isinstance(factor.factor, gtsam.CombinedImuFactor):
                _imu(factor, records.samples[factor.stamp], params)
            pixel = records.pixels.get(factor.id)
            graph.add(factor.factor.clone() if pixel is None else _stereo(factor, pixel))
            slots[factor.id] = len(slots)
        for key, value in change.values.items():
            values.insert(key, value)
        update = gtsam.ISAM2UpdateParams()
        update.removeFactorIndices = [slots[id_] for id_ in change.remove if id_ in slots]
        update.force_relinearize = any(factor.kind == "pixel" for factor in change.add)
        isam.update(graph, values, update)
        if any(factor.kind in JOINING for factor in change.add):
            _settle(isam, config)
        for key in _newest(change.values):
            estimate_in(space, isam, key)


def _settle(isam: gtsam.ISAM2, config: Config) -> None:
    """After a loop, as ours: further updates until nothing is linearized anew."""
    anew = gtsam.ISAM2UpdateParams()
    anew.force_relinearize = True
    for _ in range(config.isam2.extra_updates):
        result = isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), anew)
        if result.getVariablesRelinearized() == 0:
            return


def _imu(factor: Factor, samples: Sequence[Sample], params: Any) -> gtsam.CombinedImuFactor:
    """The work that the factor took."""
    bias = factor.factor.preintegratedMeasurements().biasHat()
    measured = gtsam.PreintegratedCombinedMeasurements(params, bias)
    for acceleration, rate, seconds in samples:
        measured.integrateMeasurement(acceleration, rate, seconds)
    return gtsam.CombinedImuFactor(*factor.factor.keys(), measured)


def _stereo(factor: Factor, pixel: Pixel) -> gtsam.GenericStereoFactor3D:
    measured = gtsam.StereoPoint2(*pixel.place)
    return gtsam.GenericStereoFactor3D(
        measured, pixel.noise, *factor.keys, pixel.calibration, False, False, pixel.mount
    )


def _pixels(stream: Stream, changes: Sequence[Delta]) -> dict[str, Pixel]:
    found, shared = dict[str, Pixel](), dict[tuple[float, ...], tuple[Any, Any]]()
    mounts = Mounts(SPACES[stream.config.space], stream.config.base_frame, stream.config.extrinsics)
    for transform in (item for item in stream.items if isinstance(item, StaticTransform)):
        mounts.add(transform)
    frames = {item.source: mounts.get(item.frame) for item in stream.items if isinstance(item, PixelFrame)}
    for factor in (factor for change in changes for factor in change.add):
        stereo = factor.factor
        if isinstance(stereo, gtsam.GenericStereoFactor3D):
            at, lens, noise = stereo.measured(), stereo.calibration(), stereo.noiseModel()
            alike = shared.setdefault((*noise.sigmas(), *np.ravel(lens.K()), lens.baseline()), (noise, lens))
            found[factor.id] = Pixel((at.uL(), at.uR(), at.v()), *alike, frames[factor.source])
            assert _stereo(factor, found[factor.id]).equals(stereo, 1e-9)  # no kernel among them
    return found


def _noise(config: Config) -> Any:
    imu = imu_of(config)
    return None if imu is None else parameters(imu, imu.stated, None)


def _records(stream: Stream, changes: Sequence[Delta]) -> Records:
    return Records(_samples(stream, changes), _pixels(stream, changes))


def _samples(stream: Stream, changes: Sequence[Delta]) -> dict[int, list[Sample]]:
    found: dict[int, list[Sample]] = defaultdict(list)
    ends = sorted({factor.stamp for change in changes for factor in change.add})
    for before, each in pairwise(item for item in stream.items if isinstance(item, ImuSample)):
        if (n := bisect_left(ends, each.stamp)) < len(ends):
            found[ends[n]].append((each.acceleration, each.rate, (each.stamp - before.stamp) / SECOND))
    return found


def _newest(values: Mapping[int, Any]) -> list[int]:
    """The pose, and the velocity and bias beside it."""
    return [key for key in values if chr(key >> 56) in "xvb"]


if __name__ == "__main__":
    for row in rows():
        print(row)
