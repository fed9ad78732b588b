"""The run on the earth: every fix beside the path, how far it is from it, and whether its noise is what it says."""

import numpy as np

from ...core.geometry import inverse_of, matrix_of
from ...core.measurement import SECOND, parse_stamp
from ...io.earth import NAME, read_fixes
from ..colours import ODOMETRY, SMOOTHED, TRUTH
from .page import Section, dots, drawn, figure, line, said, table
from .subject import Subject

MOST = 20_000  # fixes that are drawn
USED, DOUBTED = "#3c9a5f", "#c0392b"


def section(run: Subject) -> Section | None:
    earth = run.summary.get("earth")
    if earth is None:
        return None
    if earth["map_T_earth"] is None:
        return Section("On the earth", said(f"Where the map lies there is unknown: {earth['why']}."), {})
    fixes = read_fixes(run.path / NAME)
    step = -(-len(fixes.stamps) // MOST)
    stamps, places = fixes.stamps[::step], fixes.fixes[::step]
    away = np.linalg.norm((fixes.antennas[::step] - places)[:, :2], axis=1)
    refused = {
        (line["source"], parse_stamp(line["stamp"])) for line in run.decisions if line["reason"] == "alone"
    }
    lone = np.array(
        [each in refused for each in zip(fixes.sources[::step], stamps.tolist(), strict=True)], dtype=bool
    )
    withheld = fixes.withheld[::step]
    seconds = (stamps - run.trajectory.stamps[0]) / SECOND
    kinds = (
        ("used", USED, ~withheld & ~lone), ("kept back as a truth", TRUTH, withheld), ("refused", DOUBTED, lone)
    )  # fmt: skip
    earth_T_map = inverse_of(matrix_of(np.array(earth["map_T_earth"])))
    path = run.trajectory.sevens[:, :3] @ earth_T_map[:3, :3].T + earth_T_map[:3, 3]
    shown = [(f"{chosen.sum()} {name}", colour, chosen) for name, colour, chosen in kinds if chosen.any()]
    seen = [dots(name, colour, *places[chosen][:, :2].T) for name, colour, chosen in shown]
    seen.append(line("smoothed path", SMOOTHED, *path[:, :2].T))
    apart = [dots(name, colour, seconds[chosen], away[chosen]) for name, colour, chosen in shown]
    apart.append(line("stated (one sigma)", ODOMETRY, seconds, fixes.sigmas[::step, 0]))
    figures = {
        "earth": figure(seen, "east (m)", "north (m)", equal=True, height=560),
        "fixes": figure(apart, "time along the run (s)", "from the fix to the antenna, horizontally (m)"),
    }
    rows = [
        (source, f"{nis['mean']:.2f}", f"{nis['low']:.2f} to {nis['high']:.2f}", f"{nis['noise_is']:.2f}")
        for source, nis in earth["nis"].items()
    ]
    words = f"The map's x axis points {np.degrees(earth['yaw']):.1f} degrees from east to north."
    head = (
        "receiver",
        "mean NIS",
        "99.9 % of means, were the noise as stated",
        "noise is, of what is stated",
    )
    return Section("On the earth", said(words) + drawn("earth") + drawn("fixes") + table(head, rows), figures)
