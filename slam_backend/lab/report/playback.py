"""The run as it went: the newest pose that a filter would know, and the whole path that the smoother knew at that moment."""

from collections.abc import Sequence

import numpy as np

from ...core.measurement import SECOND, Array
from ...core.trajectory import Stamps, Trajectory
from ..colours import LOOP, ODOMETRY, ONLINE, SMOOTHED
from .page import Section, drawer, drawn, figure, line, numbers, script_data
from .subject import Subject
from .verdicts import entered, loops_of

MOST_LOOPS = 300  # of one moment
BODY = """
<p>Drag: the dot is the pose that was newest at that moment, its trail what was believed of each pose while it was newest. The line is the
whole path as the smoother knew it then. Seen from above.</p>
<div class="bar"><button id="play">play</button><input id="moment" type="range" min="0" value="0"><span id="moment-told"></span></div>
"""
SCRIPT = """
const floats = packed => new Float32Array(Uint8Array.from(atob(packed.bdata), c => c.charCodeAt(0)).buffer);
const points = floats(frames.points), trail = floats(frames.trail), segments = floats(frames.segments);
const slider = document.getElementById("moment"), label = document.getElementById("moment-told"), button = document.getElementById("play");
const column = (array, from, to, k) => Array.from({ length: to - from }, (_, n) => array[2 * (from + n) + k]);
slider.max = frames.times.length - 1;
const show = () => {
  const n = +slider.value, a = frames.ends[n], b = frames.ends[n + 1], t = frames.trails[n], c = frames.loops[n], d = frames.loops[n + 1];
  const data = [[points, a, b], [trail, 0, t], [trail, t - 1, t], [segments, c, d]];
  Plotly.restyle("playback", { x: data.map(each => column(...each, 0)), y: data.map(each => column(...each, 1)) }, [1, 2, 3, 4]);
  label.textContent = `${frames.times[n].toFixed(1)} s, ${frames.counts[n]} loops`;
};
let timer = 0;
button.onclick = () => {
  if (timer) { clearInterval(timer); timer = 0; button.textContent = "play"; return; }
  if (+slider.value === +slider.max) slider.value = 0;
  button.textContent = "stop";
  timer = setInterval(() => {
    slider.value = +slider.value + 1; show();
    if (+slider.value === +slider.max) button.onclick();
  }, 120);
};
slider.oninput = show;
ready.playback.then(() => { slider.value = slider.max; show(); });
"""


def section(run: Subject) -> Section | None:
    history = run.history
    if history is None or len(history["frame_stamps"]) < 2:
        return None
    stamps, frames = history["frame_stamps"].astype(np.int64), history.frames
    online = run.online
    segments, ends, loops = _loops(run, stamps, frames)
    data = {
        "times": ((stamps - run.trajectory.stamps[0]) / SECOND).round(2).tolist(),
        "points": numbers(np.concatenate([points for _, points in frames])[:, :2]),
        "ends": np.cumsum([0, *(len(at) for at, _ in frames)]).tolist(),
        "trail": numbers(online.sevens[:, :2]),
        "trails": np.searchsorted(online.stamps, stamps, side="right").tolist(),
        "segments": numbers(segments),
        "loops": ends,
        "counts": loops,
    }
    # the extent of the end is drawn at once, and stays the frame of all moments
    first = [
        line("odometry alone", ODOMETRY, *_above(run.odometry), opacity=0.3),
        line("smoothed, as known then", SMOOTHED, [], []),
        line("newest pose while driving", ONLINE, [], [], opacity=0.7),
        {**line("newest pose", ONLINE, [], []), "mode": "markers", "marker": {"size": 12, "color": ONLINE}},
        line("loops", LOOP, [], [], type=drawer(max(loops, default=0)), opacity=0.5),
    ]
    drawing = figure(first, "x (m)", "y (m)", equal=True, height=560, uirevision="stay")
    for axis, k in (("xaxis", 0), ("yaxis", 1)):
        low, high = run.trajectory.sevens[:, k].min(), run.trajectory.sevens[:, k].max()
        margin = 0.08 * max(high - low, 1.0)
        drawing["layout"][axis]["range"] = [float(low - margin), float(high + margin)]
    return Section(
        "As it went", BODY + drawn("playback"), {"playback": drawing}, script_data("frames", data) + SCRIPT
    )


def _above(trajectory: Trajectory) -> Array:
    return trajectory.sevens[:: -(-len(trajectory) // 5000), :2].T


def _loops(
    run: Subject, stamps: Stamps, frames: Sequence[tuple[Stamps, Array]]
) -> tuple[Array, list[int], list[int]]:
    """(S, 2) segments with gaps: the loops of each frame at the places of its own path; where each frame's begin; how many
    loops there were.
    """
    since = entered(run)
    known = [(since[d["id"]], ends) for d, ends in loops_of(run) if d["id"] in since]
    begin = np.array([stamp for stamp, _ in known], dtype=np.int64)
    ends = np.array([moments for _, moments in known], dtype=np.int64).reshape(-1, 2)
    pieces, counts = [np.zeros((0, 2))], []
    for stamp, (at, points) in zip(stamps, frames, strict=True):
        there = np.flatnonzero(begin <= stamp)
        counts.append(len(there))
        some = ends[there[:: -(-len(there) // MOST_LOOPS) or 1]]
        places = [np.interp(some.ravel(), at, points[:, k]).reshape(-1, 2) for k in (0, 1)]
        segment = np.full((len(some), 3, 2), np.nan)
        segment[:, :2] = np.stack(places, axis=2)
        pieces.append(segment.reshape(-1, 2))
    return np.concatenate(pieces), np.cumsum([len(each) for each in pieces]).tolist(), counts
