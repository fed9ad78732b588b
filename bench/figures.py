"""The figures of docs/sensors.md, from real data: `python -m bench.figures [NAME...]` draws them anew into docs/figures.

Those whose data are not at hand are left as they are.
"""

import sys
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from PIL import Image

from bench.accuracy import HUSKY, OUTAGES, SHARED
from bench.kitti import EVERY, SETTLED
from bench.sightings import laid_over, replayed
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadFile
from slam_backend.core.measurement import SECOND
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import Result, replay
from slam_backend.lab import mrclam
from slam_backend.lab.colours import LANDMARK, ODOMETRY, REFUSED, SMOOTHED, TRUTH
from slam_backend.lab.datasets import beacons, make_dataset
from slam_backend.lab.fixes import away, away_by_lines
from slam_backend.lab.picture import pyplot

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs/figures"
WIDTH, HEIGHT, DPI = 8.0, 4.2, 100  # inches, inches, dots per inch
COLOURS = 64  # of a picture: more would only make the file larger


def ranges(figure: Any) -> None:
    """Plaza1: the path and four beacons by ranges alone, laid over the truth."""
    result, truth = replayed("plaza1", None, "plaza.yaml")
    _, fit = laid_over(result.trajectory, truth)
    left, right = figure.subplots(1, 2)
    left.plot(*truth.sevens[:, :2].T, color=TRUTH, linewidth=2.5, alpha=0.35, label="truth (GPS)")
    left.plot(*fit(result.trajectory.sevens[:, :2]).T, color=SMOOTHED, linewidth=0.8, label="smoothed")
    known = beacons("plaza1")
    left.plot(
        *np.array(list(known.values())).T, "o", color=TRUTH, mfc="none", ms=11, label="beacons, surveyed"
    )
    left.plot(*fit(result.snapshot.landmarks[:, :2]).T, "^", color=LANDMARK, ms=6, label="beacons, found")
    for errors, colour, label in (
        (laid_over(result.snapshot.odometry, truth)[0], ODOMETRY, "odometry alone"),
        (laid_over(result.trajectory, truth)[0], SMOOTHED, "smoothed"),
    ):
        right.plot(np.linspace(0, 1, len(errors)), errors, color=colour, linewidth=0.8, label=label)
    right.set(xlabel="share of the run", ylabel="distance from the truth (m)")
    mapped(left)


def gnss(figure: Any) -> None:
    """Husky: the fixes, and the path through a minute without them, on the earth."""
    settings = (f"gps.withhold=[{list(OUTAGES[1])}]",)
    bag = SHARED / "bags/robot_localization/test1.bag"
    result = replay(bag, config_from(yaml.safe_load(HUSKY)), settings).result
    found, earth = compared(result), result.snapshot.earth
    path = earth.on_earth(result.trajectory.sevens[:, :3])
    left, right = figure.subplots(1, 2)
    left.plot(*found.fixes[~found.withheld, :2].T, ".", color=LANDMARK, ms=3, label="fixes")
    left.plot(*found.fixes[found.withheld, :2].T, ".", color=REFUSED, ms=3, label="kept back for a minute")
    left.plot(*path[:, :2].T, color=SMOOTHED, linewidth=1.2, label="smoothed")
    mapped(left, "east (m)", "north (m)")
    errors(right, result)


def imu_gnss(figure: Any) -> None:
    """KITTI: every tenth fix kept back; how far the path, and straight lines, pass from it."""
    with TemporaryDirectory() as place:
        bag = make_dataset("kitti_imu_gnss", Path(place) / "kitti.mcap").path
        config = load_config(ROOT / "config/kitti_imu_gnss.yaml")
        stamps = compared(replay(bag, config).result).stamps
        seconds = (stamps - stamps[0]) / SECOND
        numbers = np.arange(SETTLED, len(stamps) - 1)
        spans = [[t - 0.01, t + 0.01] for t in seconds[numbers[numbers % EVERY == 0]].tolist()]
        result = replay(bag, config, settings=(f"gps.withhold={spans}",)).result
        found, earth = compared(result), result.snapshot.earth
    left, right = figure.subplots(1, 2)
    path = earth.on_earth(result.trajectory.sevens[:, :3])
    left.plot(*path[:, :2].T, color=SMOOTHED, linewidth=1.2, label="smoothed")
    left.plot(*found.fixes[found.withheld, :2].T, ".", color=REFUSED, ms=4, label="fixes kept back")
    mapped(left, "east (m)", "north (m)")
    errors(right, result)


def range_bearing(figure: Any) -> None:
    """MRCLAM, robot 1: range and bearing to barcodes whose places nobody told."""
    folder = SHARED / "mrclam_raw/MRCLAM_Dataset6"
    result, truth = replayed("mrclam1", folder, "mrclam.yaml")
    gaps, fit = laid_over(result.trajectory, truth)
    left, right = figure.subplots(1, 2)
    left.plot(*truth.sevens[:, :2].T, color=TRUTH, linewidth=2.0, alpha=0.3, label="truth (Vicon)")
    left.plot(*fit(result.trajectory.sevens[:, :2]).T, color=SMOOTHED, linewidth=0.5, label="smoothed")
    known = mrclam.landmarks(folder)
    left.plot(
        *np.array([known[n] for n in result.snapshot.names]).T,
        "o",
        color=TRUTH,
        mfc="none",
        ms=9,
        label="landmarks, surveyed",
    )
    left.plot(*fit(result.snapshot.landmarks[:, :2]).T, "^", color=LANDMARK, ms=5, label="landmarks, found")
    mapped(left)
    alone = laid_over(result.snapshot.odometry, truth)[0]
    for each, colour, label in ((alone, ODOMETRY, "odometry alone"), (gaps, SMOOTHED, "smoothed")):
        right.semilogy(np.linspace(0, 1, len(each)), each, color=colour, linewidth=0.6, label=label)
    right.set(xlabel="share of the run", ylabel="distance from the truth (m)")


def stereo(figure: Any) -> None:
    """KITTI 00: a camera's way and the points that it saw, from above and from the side."""
    with TemporaryDirectory() as place:
        bag = make_dataset("kitti_stereo", Path(place) / "stereo.mcap").path
        result = replay(bag, load_config(ROOT / "config/kitti_stereo.yaml")).result
    points, path = result.snapshot.landmarks, result.trajectory.sevens[:, :3]
    low, high = path.min(axis=0) - 25, path.max(axis=0) + 25
    points = points[((points > low) & (points < high)).all(axis=1)]
    for panel, axes in zip(figure.subplots(2, 1), ((0, 1), (0, 2)), strict=True):
        panel.plot(*points[:, axes].T, ",", color=LANDMARK, label=f"{len(points)} points")
        panel.plot(*path[:, axes].T, color=SMOOTHED, linewidth=1.6, label=f"{len(path)} frames")
        mapped(panel, *("xyz"[axis] + " (m)" for axis in axes))


def compared(result: Result) -> Any:
    found = result.run.backend.compared(result.snapshot)
    assert found is not None
    return found


def errors(panel: Any, result: Result) -> None:
    """Of the fixes that were kept back: the path, and straight lines between the other fixes."""
    found = compared(result)
    seconds = (found.stamps - found.stamps[0])[found.withheld] / SECOND
    for each, colour, label in (
        (away_by_lines(found), ODOMETRY, "interpolated"),
        (away(found), SMOOTHED, "smoothed"),
    ):
        panel.plot(seconds, each[found.withheld], ".-", color=colour, linewidth=0.8, ms=3, label=label)
    panel.set(xlabel="time along the run (s)", ylabel="from a fix that was kept back (m)")


def mapped(panel: Any, x: str = "x (m)", y: str = "y (m)") -> None:
    panel.set(xlabel=x, ylabel=y)
    panel.set_aspect("equal", adjustable="datalim")


FIGURES: Mapping[str, Callable[[Any], None]] = {
    "ranges": ranges,
    "gnss": gnss,
    "imu_gnss": imu_gnss,
    "range_bearing": range_bearing,
    "stereo": stereo,
}


def main(names: list[str]) -> None:
    plt = pyplot()
    FOLDER.mkdir(exist_ok=True)
    for name in names or FIGURES:
        figure = plt.figure(figsize=(WIDTH, HEIGHT))
        try:
            FIGURES[name](figure)
        except BadFile as error:
            sys.stderr.write(f"{name}: left out: {error}\n")
            continue
        for panel in figure.axes:
            rows = panel.get_subplotspec().get_gridspec().nrows
            panel.grid(alpha=0.3, linewidth=0.5)
            panel.legend(
                fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16 * rows), ncols=2
            )
        figure.tight_layout()
        drawn = BytesIO()
        figure.savefig(drawn, dpi=DPI)
        plt.close(figure)
        Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
            FOLDER / f"{name}.png", optimize=True
        )


if __name__ == "__main__":
    main(sys.argv[1:])
