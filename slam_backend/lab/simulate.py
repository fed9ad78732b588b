"""Drives through simulated worlds: messages as a robot would send them, and the truth behind them."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain as chain_of
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.config import config_from
from ..core.errors import BadConfig
from ..core.geometry import inverse_of, seven_of_matrix
from ..core.measurement import SECOND, Array, ImuSample, Measurement, format_stamp, frozen
from ..core.sensors.gnss import Fix
from ..core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from ..core.sensors.pixels import PixelFrame
from ..core.sensors.relative import RelativePose
from ..io.bags import write_bag
from ..io.encode import encode_cloud, encode_fix, encode_imu, encode_odometry, encode_transforms
from ..io.formats import tum
from ..io.formats.trajectory import Trajectory
from ..io.records import Record
from . import features, sensing
from .channel import Sent, delivered, in_order
from .inertia import imu_messages
from .options import Options
from .world import SCENARIOS, Scenario, chain, exp_of

__all__ = ["SCENARIOS", "Options", "Simulation", "Written", "simulate", "write_simulation"]

START = 1_700_000_000 * SECOND
FIX = "sensor_msgs/msg/NavSatFix"
ODOMETRY, CLOUD, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"
PARTS = ("gyroscope", "accelerometer")
LATENCY = {
    "/truth": 0,
    "/odom": 1_000_000,
    "/loops": 5_000_000,
    "/landmarks": 50_000_000,
    "/imu": 0,
    "/fix": 80_000_000,
    "/features": 40_000_000,
}  # ns
TOLD = {  # fields of a cloud, by what is told of a landmark
    "position": ("x", "y", "z"), "bearing_range": ("azimuth", "elevation", "range"),
    "bearing": ("azimuth", "elevation"), "range": ("range",),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """A function of scenario, seed and options alone.

    stamps: (N,) int64 ns; sevens: (N, 7) true poses in the frame `map`, which is the first pose.
    landmarks: (M, 3) true positions there, their ids are their rows. loops: right and wrong ones, before losses.
    sent: every message in order of arrival. lost: how many were silent, dropped, late, duplicated.
    settings: the configuration that replays it, its noise as simulated.
    """

    scenario: str
    seed: int
    options: Options
    stamps: NDArray[np.int64]
    sevens: Array
    landmarks: Array
    loops: tuple[sensing.Loop, ...]
    sent: tuple[Sent, ...]
    lost: Mapping[str, int]
    settings: Mapping[str, Any]

    @property
    def records(self) -> Iterator[Record]:
        """What the bag holds, log times strictly increasing; /tf_static first where there is a camera."""
        mounts = {
            frame: seven_of_matrix(_mounted(each))
            for frame, each in _cameras(SCENARIOS[self.scenario]).items()
        }
        if mounts:
            data = encode_transforms(START, sensing.BASE, mounts)
            yield Record("/tf_static", "tf2_msgs/msg/TFMessage", START - SECOND // 1000, data)
        yield from map(_record, self.sent)

    @property
    def measurements(self) -> Iterator[Measurement]:
        """What decoding the records would give, in order of arrival, without the truth."""
        return (item for sent in self.sent if sent.topic != "/truth" for item in sent.measurements)


def simulate(scenario: str, seed: int = 0, options: Options = Options()) -> Simulation:  # noqa: B008  # frozen
    """Drive through one of SCENARIOS. BadConfig if there is none of that name."""
    if scenario not in SCENARIOS:
        raise BadConfig(f"there is no scenario '{scenario}'; known: {', '.join(SCENARIOS)}")
    world = SCENARIOS[scenario]
    # One stream for each cause of chance: a change of the loops leaves the odometry as it was.
    *chances, for_channel, for_imu, for_gnss, for_images = np.random.default_rng(seed).spawn(10)
    truth = chain(exp_of(world.path(options.poses, chances[0])))
    count = world.landmarks if options.landmarks is None else options.landmarks
    landmarks = world.place(truth, count, chances[1])
    loops = tuple(sensing.find_loops(truth, options, chances[2]))
    stamps = [START + k * round(options.period * SECOND) for k in range(options.poses)]
    messages = _messages(world, truth, landmarks, loops, stamps, options, chances[3:])
    if options.imu_rate:
        samples = imu_messages(truth, stamps, options, sensing.BASE, for_imu)
        messages = chain_of(messages, (_sent("/imu", sample) for sample in samples))
    if options.gnss_every:
        messages = chain_of(
            messages, (_sent("/fix", fix) for fix in sensing.fixes(truth, stamps, options, for_gnss))
        )
    messages = chain_of(messages, _images(world, truth, stamps, options, for_images))
    lost: Counter[str] = Counter()

    def counted(what: str) -> None:
        lost[what] += 1

    arrived = list(delivered(messages, START, options, for_channel, counted))
    topics = {sent.topic for sent in arrived}
    arrived += [_sent("/truth", item) for item in sensing.truth_messages(truth, stamps)]
    return Simulation(
        scenario, seed, options, np.array(stamps), frozen(seven_of_matrix(truth)), frozen(landmarks), loops,
        in_order(arrived), dict(lost), _settings(world, options, topics),
    )  # fmt: skip


def _messages(
    world: Scenario, truth: Array, landmarks: Array, loops: tuple[sensing.Loop, ...],
    stamps: list[int], options: Options, chances: list[np.random.Generator],
) -> Iterator[Sent]:  # fmt: skip
    for_odometry, for_loops, for_landmarks = chances
    poses = sensing.drifted(inverse_of(truth[:-1]) @ truth[1:], options, world.space, for_odometry)
    for pose in sensing.odometry(poses, stamps, options):
        yield _sent("/odom", pose)
    for loop in sensing.loop_messages(loops, stamps, options, world.space, for_loops):
        yield _sent("/loops", loop)
    camera = None if world.camera is None else _mounted(world.camera)
    for seen in sensing.sightings(truth, landmarks, camera, stamps, options, for_landmarks):
        yield Sent(seen[0].stamp + LATENCY["/landmarks"], "/landmarks", seen)


def _images(
    world: Scenario, truth: Array, stamps: list[int], options: Options, rng: np.random.Generator
) -> Iterator[Sent]:
    if world.eye is not None:
        path = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
        points = features.around(truth, round(options.features * path), rng)
        for frame in features.frames(truth, points, _mounted(world.eye), stamps, options, rng):
            yield _sent("/features", frame)


def _cameras(world: Scenario) -> dict[str, tuple[float, ...]]:
    """Frame -> where it is in the base."""
    named = {sensing.CAMERA: world.camera, features.EYE: world.eye}
    return {frame: six for frame, six in named.items() if six is not None}


def _sent(topic: str, item: OdometryPose | RelativePose | ImuSample | Fix | PixelFrame) -> Sent:
    return Sent(item.stamp + LATENCY[topic], topic, item)


def _mounted(extrinsics: tuple[float, ...]) -> Array:
    x, y, z, roll, pitch, yaw = extrinsics
    return np.asarray(gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array((x, y, z))).matrix())


def _record(sent: Sent) -> Record:
    item = sent.content
    if isinstance(item, tuple):
        columns: dict[str, NDArray[Any]] = {
            "id": np.array([int(seen.landmark) for seen in item], dtype=np.uint32)
        }
        values = np.stack([seen.value for seen in item])
        sigmas = np.sqrt([np.diag(seen.covariance) for seen in item])
        columns |= {axis: values[:, k] for k, axis in enumerate(TOLD[item[0].form])}
        if (sigmas == sigmas[:, :1]).all():
            columns["sigma"] = sigmas[:, 0]
        else:
            columns |= {f"sigma_{axis}": sigmas[:, k] for k, axis in enumerate(TOLD[item[0].form])}
        data = encode_cloud(item[0].stamp, item[0].frame, columns)
        return Record(sent.topic, CLOUD, sent.arrival, data)
    if isinstance(item, ImuSample):
        felt = (item.rate, item.acceleration, item.rate_covariance, item.acceleration_covariance)
        return Record(sent.topic, IMU, sent.arrival, encode_imu(item.stamp, item.frame, *felt))
    if isinstance(item, Fix):
        return Record(
            sent.topic, FIX, sent.arrival, encode_fix(item.stamp, item.frame, item.place, item.covariance)
        )
    if isinstance(item, PixelFrame):
        columns = {
            "id": item.ids.astype(np.uint32),
            "u": item.pixels[:, 0],
            "v": item.pixels[:, 1],
            "sigma": item.sigmas,
        }
        columns |= {} if np.isnan(item.pixels[:, 2]).all() else {"ur": item.pixels[:, 2]}
        return Record(sent.topic, CLOUD, sent.arrival, encode_cloud(item.stamp, item.frame, columns))
    if isinstance(item, OdometryPose):
        frames, noise = (item.frame, item.child), (item.covariance, item.twist, item.twist_covariance)
    else:
        frames = (
            f"{item.frame_i}@{format_stamp(item.stamp_i)}",
            f"{item.frame_j}@{format_stamp(item.stamp_j)}",
        )
        noise = (item.covariance, STILL, UNKNOWN)
    return Record(sent.topic, ODOMETRY, sent.arrival, encode_odometry(item.stamp, *frames, item.pose, *noise))


def _settings(world: Scenario, options: Options, topics: set[str]) -> dict[str, Any]:
    """What a YAML file says to replay the drive with the noise it was made with."""
    growth = {f"sigma_{a}_per_{b}": 0.0 for a in ("translation", "rotation") for b in ("meter", "radian")}
    floors = {"sigma_translation_floor": 1e-4, "sigma_rotation_floor": 1e-5}  # the simulation has none
    sources: dict[str, dict[str, Any]] = {
        "wheels": {"kind": "odometry", "topic": "/odom", "noise": "model"}
        | {name: getattr(options, name) for name in growth}
        | floors,
        "loops": {
            "kind": "relative",
            "topic": "/loops",
            "sigma_translation": options.loop_sigma_translation,
            "sigma_rotation": options.loop_sigma_rotation,
        },
        "landmarks": {"kind": "landmark", "topic": "/landmarks", "sigma_position": options.landmark_sigma},
        "imu": {"kind": "imu", "topic": "/imu"}
        | {
            f"{part}_{what}": getattr(options, f"{part}_{what}")
            for part in PARTS
            for what in ("density", "walk")
        }
        | {f"sigma_{part}_bias": getattr(options, f"{part}_bias") for part in PARTS},
        "features": {
            "kind": "pixels",
            "topic": "/features",
            "sigma": options.pixel_sigma,
            "camera": _lens(options),
        },
    }
    sources["gps"] = {"kind": "gnss", "topic": "/fix"}
    present = {name: source for name, source in sources.items() if source["topic"] in topics}
    mounts = {frame: list(six) for frame, six in _cameras(world).items()}
    if "/fix" in topics:
        mounts[sensing.ANTENNA] = [*sensing.arm_of(options).tolist(), 0.0, 0.0, 0.0]
    extrinsics = {"extrinsics": mounts} if mounts else {}
    space = "3d" if "/imu" in topics else world.space
    head = {"space": space, "base_frame": sensing.BASE, "keyframes": {"every": True}}
    settings = {**head, **extrinsics, "sources": list(present), **present}
    config_from(settings)  # options that no configuration can say are refused here, not at the replay
    return settings


def _lens(options: Options) -> dict[str, float]:
    lens = features.lens_of(options)._asdict()
    return lens if options.stereo_baseline else {name: lens[name] for name in ("fx", "fy", "cx", "cy")}


class Written(NamedTuple):
    """The files of a simulation; `wrong` (stamps of the wrong loops) only where there are any."""

    bag: Path
    truth: Path
    config: Path
    wrong: Path | None


def write_simulation(simulation: Simulation, out: Path) -> Written:
    """The bag at `out` (.mcap, else a folder); beside it the truth (.truth.tum) and the configuration (.yaml)."""
    written = Written(out, beside(out, ".truth.tum"), beside(out, ".yaml"), None)
    write_bag(out, simulation.records)
    tum.write(written.truth, Trajectory(simulation.stamps, simulation.sevens))
    head = f"# {simulation.scenario}, seed {simulation.seed}: replays {out.name} with the noise it was made with.\n"
    text = yaml.safe_dump(dict(simulation.settings), sort_keys=False, default_flow_style=None, width=100)
    written.config.write_text(head + text)
    wrong = [loop for loop in simulation.loops if loop.wrong]
    if not wrong:
        return written
    ends = [",".join(format_stamp(int(simulation.stamps[k])) for k in (loop.i, loop.j)) for loop in wrong]
    path = beside(out, ".wrong.csv")
    path.write_text("\n".join(["stamp_i,stamp_j", *ends, ""]))
    return written._replace(wrong=path)


def beside(bag: Path, ending: str) -> Path:
    """`drive.mcap` and `.yaml` to `drive.yaml`; a folder's whole name is kept."""
    name = bag.stem if bag.suffix == ".mcap" else bag.name
    return bag.with_name(name + ending)
