"""A car with RTK and a cheap IMU (rtklibexplorer, drive_0708): half a minute without fixes, ten times, nothing but the IMU between."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml

from bench.table import Row
from slam_backend.core.config import config_from
from slam_backend.core.measurement import SECOND
from slam_backend.io.bags import write_bag
from slam_backend.io.replay import replay
from slam_backend.lab import rtklib
from slam_backend.lab.fixes import away, away_by_lines

FOLDER = Path(__file__).parents[2] / "shared/data/gnss_imu_rtklibexplorer/drive_0708"
PARKED = 34.0  # s: of the 39 s in which the car stands at first; an IMU alone has drifted away by their end
LENGTH, STEP, FIRST, COUNT = 30.0, 49.0, 20.0, 10  # s, s, s and windows
SPANS = [[FIRST + STEP * k, FIRST + STEP * k + LENGTH] for k in range(COUNT)]
CONFIG = f"""
space: 3d
base_frame: car
keyframes: {{distance: 10.0, angle: 0.5, time: 1.0}}
sources: [imu, gps]
imu: {{kind: imu, topic: /imu, preset: consumer, start: rest}}
gps: {{kind: gnss, topic: /fix, withhold: {SPANS}}}
extrinsics: {{gps: [0, 0, 0, 0, 0, 0], imu: [0, 0, 0, 0, 0, 3.14159]}}
"""


def drive() -> list[Row]:
    """Horizontally, at the middle of each window: the median over the windows. Beside it straight lines across."""
    if not FOLDER.exists():
        return []
    with TemporaryDirectory() as folder:
        records = sorted(rtklib.read(FOLDER).records, key=lambda record: record.log_time)
        begin = records[0].log_time + PARKED * SECOND
        bag = Path(folder) / "drive.mcap"
        write_bag(bag, (record for record in records if record.log_time >= begin))
        result = replay(bag, config_from(yaml.safe_load(CONFIG))).result
    found = result.run.backend.compared(result.snapshot)
    assert found is not None
    seconds = (found.stamps - found.stamps[0]) / SECOND
    middles = [int(np.argmin(np.abs(seconds - (start + end) / 2))) for start, end in SPANS]
    ours, lines = (float(np.median(each[middles])) for each in (away(found), away_by_lines(found)))
    what = "drive_0708, middle of 30 s without RTK, IMU alone (median of 10)"
    return [Row(what, f"{ours:.2f} m", f"{lines:.2f} m interpolated", ours, f"<= {lines:.3g}")]
