"""The factor graph around any keyframe."""

import numpy as np

from ...core.graph import HOLDING, keyframe
from .page import Section, drawn, figure, numbers, script_data
from .subject import Subject

KINDS = {"motion": "#8a94a6", "loop": "#3c9a5f", "landmark": "#d9822b", "pose": "#8e6bbf",
         "odometry": "#2a9d9d", "floor": "#b5a642"}  # fmt: skip
OTHERS = ("#c0392b", "#6d4c41", "#00796b", "#555555")  # of kinds that have no colour of their own
MOST = 60_000  # factors
BODY = """
<p>Factors of the chosen keyframes, coloured by kind; the wider a line, the worse it fits (width: residual in standard deviations). A ring is a factor of one keyframe.</p>
<div class="bar"><label>keyframe <input id="which" type="number" min="0" value="0" style="width:7em"></label>
<input id="which-slider" type="range" min="0" value="0"><label>and <input id="reach" type="number" value="10" min="1" max="200" style="width:5em"> on each side</label></div>
<div class="bar" id="kinds"></div>
"""
SCRIPT = """
const floats = p => new Float32Array(Uint8Array.from(atob(p.bdata), c => c.charCodeAt(0)).buffer);
const ints = p => new Int32Array(Uint8Array.from(atob(p.bdata), c => c.charCodeAt(0)).buffer);
const a = ints(net.a), b = ints(net.b), kind = ints(net.kind), sigma = floats(net.sigma), at = floats(net.at);
const which = document.getElementById("which"), slider = document.getElementById("which-slider"), reach = document.getElementById("reach");
which.max = slider.max = net.keyframes - 1;
const on = net.kinds.map((name, n) => {
  const label = document.createElement("label"), box = document.createElement("input");
  box.type = "checkbox"; box.checked = true; box.onchange = () => show();
  label.append(box, ` ${name}`); label.style.color = net.colours[n];
  document.getElementById("kinds").append(label);
  return box;
});
const show = () => {
  const k = Math.min(+which.value || 0, net.keyframes - 1), r = +reach.value || 1, near = n => n >= k - r && n <= k + r, traces = [], nodes = new Set();
  for (let n = Math.max(0, k - r); n <= Math.min(net.keyframes - 1, k + r); n++) nodes.add(n);
  for (let f = 0; f < a.length; f++) {
    if (!on[kind[f]].checked || !(near(a[f]) || near(b[f]))) continue;
    nodes.add(a[f]); nodes.add(b[f]);
    if (a[f] === b[f]) traces.push({ type: "scatter", mode: "markers", x: [at[2 * a[f]]], y: [at[2 * a[f] + 1]], showlegend: false, hoverinfo: "skip",
      marker: { symbol: "circle-open", size: 13 + Math.min(sigma[f], 6), color: net.colours[kind[f]] } });
    else traces.push({ type: "scatter", mode: "lines", x: [at[2 * a[f]], at[2 * b[f]]], y: [at[2 * a[f] + 1], at[2 * b[f] + 1]], showlegend: false,
      line: { color: net.colours[kind[f]], width: 1 + Math.min(sigma[f], 6) }, hoverinfo: "skip" });
    if (traces.length >= 3000) break;
  }
  const list = [...nodes], name = n => n < net.keyframes ? `keyframe ${n}` : `landmark ${net.landmarks[n - net.keyframes]}`;
  traces.push({ type: "scatter", mode: "markers", x: list.map(n => at[2 * n]), y: list.map(n => at[2 * n + 1]), text: list.map(name), showlegend: false,
    hovertemplate: "%{text}<extra></extra>", marker: { size: list.map(n => n === k ? 13 : 7), color: list.map(n => n < net.keyframes ? "#1f4e9c" : "#d9822b"),
    symbol: list.map(n => n < net.keyframes ? "circle" : "triangle-up") } });
  Plotly.react("neighbours", traces, figures.neighbours.layout, settings);
};
which.value = slider.value = net.start;
which.oninput = () => { slider.value = which.value; show(); };
slider.oninput = () => { which.value = slider.value; show(); };
reach.oninput = show;
ready.neighbours.then(show);
"""


def section(run: Subject) -> Section | None:
    edges = _edges(run)
    if not edges:
        return None
    a, b, named, sigma = zip(*edges[:MOST], strict=True)
    kinds = [kind for kind in KINDS if kind in named] + sorted(set(named) - KINDS.keys())
    colours = [KINDS.get(kind, OTHERS[n % len(OTHERS)]) for n, kind in enumerate(kinds)]
    names = list(run.landmarks)
    places = [
        run.trajectory.sevens[:, :2],
        np.array([run.landmarks[name][:2] for name in names]).reshape(-1, 2),
    ]
    first = max(edges, key=lambda edge: (edge[2] == "loop", edge[3]))[0]  # the loop that fits worst
    net = {
        "a": numbers(a), "b": numbers(b), "kind": numbers([kinds.index(each) for each in named]), "sigma": numbers(sigma),
        "at": numbers(np.concatenate(places)), "keyframes": len(run.trajectory), "landmarks": names,
        "kinds": kinds, "colours": colours, "start": first,
    }  # fmt: skip
    drawing = figure([], "x (m)", "y (m)", equal=True, height=520)
    return Section(
        "Factor graph", BODY + drawn("neighbours"), {"neighbours": drawing}, script_data("net", net) + SCRIPT
    )


def _edges(run: Subject) -> list[tuple[int, int, str, float]]:
    """The two ends of each factor (keyframes in order of stamp, then landmarks), its kind, its residual in standard deviations."""
    linear = run.linearized
    keys = [*(keyframe(index, 0).pose for index in run.indices.tolist()), *linear.landmarks]
    row_of = {key: row for row, key in enumerate(keys)}
    sigmas = np.sqrt(linear.chi_squares / linear.rows).tolist()
    edges = []
    for each, kind, sigma in zip(linear.keys, linear.kinds.tolist(), sigmas, strict=True):
        ends = [row_of[key] for key in each if key in row_of]
        if kind not in HOLDING and ends:
            edges.append((ends[0], ends[-1], kind, sigma))
    return edges
