"""What a page is made of: figures, tables and text in sections, and the one HTML file around them, which needs no network."""

import json
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from gzip import compress
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Figure = dict[str, Any]  # data and layout, as plotly.js takes them
DTYPES = {"f": np.float32, "i": np.int32}
ABOVE, BELOW = 34, 48  # pixels of a figure for its buttons, and for the axis below
TITLED = 58  # of these for its numbers and title
CROWD = 2_000  # dots
AXIS = {"zeroline": False, "gridcolor": "#e4e7ec", "linecolor": "#c5cad3", "ticks": "outside"}


@dataclass(frozen=True, slots=True)
class Section:
    """title; body: HTML; figures: by the id of the element that they are drawn into; script: run once they are drawn."""

    title: str
    body: str
    figures: Mapping[str, Figure] = field(default_factory=dict)
    script: str = ""


def numbers(values: ArrayLike) -> dict[str, str]:
    """Numbers as plotly.js reads them fastest: bytes in base64, floats with 24 bits. NaN breaks a line."""
    array = np.asarray(values)
    packed = np.ascontiguousarray(
        array, dtype=np.uint8 if array.dtype == np.uint8 else DTYPES[array.dtype.kind]
    )
    return {"dtype": packed.dtype.str[1:], "bdata": b64encode(packed.tobytes()).decode()}


def drawer(count: int) -> str:
    """What draws so many dots, or pieces of a line. WebGL only for a crowd: it costs a figure three of a page's sixteen contexts, and a
    browser that runs out of them takes the first ones back, and leaves these figures empty.
    """
    return "scattergl" if count > CROWD else "scatter"


def line(name: str, colour: str, x: ArrayLike, y: ArrayLike, **more: Any) -> dict[str, Any]:
    return {
        "type": "scatter", "mode": "lines", "name": name, "x": numbers(x), "y": numbers(y),
        "line": {"color": colour, "width": 1.6}, **more,
    }  # fmt: skip


def dots(name: str, colour: str, x: ArrayLike, y: ArrayLike, **more: Any) -> dict[str, Any]:
    return {
        "type": drawer(len(np.asarray(x))), "mode": "markers", "name": name, "x": numbers(x), "y": numbers(y),
        "marker": {"color": colour, "size": 5}, **more,
    }  # fmt: skip


def figure(
    data: Sequence[Mapping[str, Any]], x: str, y: str, equal: bool = False, height: int = 420, **layout: Any
) -> Figure:
    """x, y: titles of the axes with their units; equal: one metre is as long in both."""
    vertical = {**AXIS, "title": {"text": y}, **({"scaleanchor": "x", "scaleratio": 1} if equal else {})}
    return {
        "data": list(data),
        "layout": {
            "height": height,
            "margin": {"l": 60, "r": 16, "t": ABOVE, "b": BELOW},
            "paper_bgcolor": "white",
            "plot_bgcolor": "white",
            "hovermode": "closest",
            "legend": {"orientation": "h", "yanchor": "top", "y": -TITLED / (height - ABOVE - BELOW)},
            "xaxis": {**AXIS, "title": {"text": x}},
            "yaxis": vertical,
            **layout,
        },
    }


def drawn(name: str) -> str:
    """The element that the figure of that name is drawn into."""
    return f'<div class="figure" id="{name}"></div>'


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Everything but the first column is set as numbers."""
    top = "".join(f"<th>{escape(each)}</th>" for each in head)
    lines = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>'


def said(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def script_data(name: str, data: object) -> str:
    """Data for a section's script, as the constant of that name."""
    return f"const {name} = {_json(data)};"


def html(title: str, sections: Sequence[Section]) -> str:
    package = files("slam_backend.lab.report")
    plotly = (files("plotly") / "package_data/plotly.min.js").read_bytes()
    links = "".join(f'<a href="#s{n}">{escape(s.title)}</a>' for n, s in enumerate(sections))
    bodies = "\n".join(
        f'<section id="s{n}"><h2>{escape(s.title)}</h2>\n{s.body}\n</section>' for n, s in enumerate(sections)
    )
    figures = {name: each for section in sections for name, each in section.figures.items()}
    scripts = "\n".join(f"(() => {{ {section.script} }})();" for section in sections if section.script)
    parts = {
        "__TITLE__": escape(title),
        "__LINKS__": links,
        "__BODIES__": bodies,
        "__FIGURES__": _json(figures),
        "__SCRIPTS__": scripts,
        "__PLOTLY__": b64encode(compress(plotly, mtime=0)).decode(),  # a third of its size: most of the page
    }
    template = (package / "page.html").read_text(encoding="utf-8")
    return re.sub("|".join(parts), lambda found: parts[found.group()], template)


def _json(data: object) -> str:
    """Safe inside a script element."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
