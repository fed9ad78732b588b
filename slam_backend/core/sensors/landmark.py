"""Landmarks with known ids, seen from the robot: position, bearing and range, bearing alone."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import BadMessage
from ..measurement import Array, Decoder, Measurement, Message, frozen, parse_frame, stamp_of

Form = Literal["position", "bearing_range", "bearing"]


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkObservation(Measurement):
    """One sighting of one landmark from `frame` (empty: the base).

    form      value                           covariance
    position  x y z (m)                       3x3
    bearing_range  azimuth elevation range    3x3
    bearing   azimuth elevation (rad)         2x2
    NaN on the diagonal of the covariance means: use the configured default. In 2-D z and elevation are not used.
    """

    frame: str
    landmark: str
    form: Form
    value: Array
    covariance: Array


def decode_points(message: Message, source: str) -> Iterable[LandmarkObservation]:
    """sensor_msgs/msg/PointCloud2: one observation per point; the fields `id` and `x y [z]`,
    `range azimuth [elevation]` or `azimuth [elevation]`; noise by `cov` or `sigma_*`.
    """
    from .cloud import columns

    table = columns(message)
    if "id" not in table:
        raise BadMessage("point cloud of landmarks lacks the field 'id'")
    frame, _ = parse_frame(message.header.frame_id)
    stamp, count = stamp_of(message), len(table["id"])
    zero = np.zeros(count)
    form: Form
    axes: tuple[str, ...]
    if "x" in table and "y" in table:
        form = "position"
        axes = ("x", "y", "z")
        fields = [table["x"], table["y"], table.get("z", zero)]
    elif "azimuth" in table:
        fields = [table["azimuth"], table.get("elevation", zero)]
        form, axes = "bearing", ("azimuth", "elevation")
        if "range" in table:
            form, axes, fields = "bearing_range", (*axes, "range"), [*fields, table["range"]]
    else:
        raise BadMessage("point cloud of landmarks has neither 'x' and 'y' nor 'azimuth'")
    values = np.stack(fields, axis=1).astype(np.float64)
    for n in range(count):
        yield LandmarkObservation(
            stamp, source, frame, _name(table["id"][n]), form,
            frozen(values[n]), frozen(_covariance(table, n, axes)),
        )  # fmt: skip


def _name(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def _covariance(table: dict[str, Array], n: int, axes: tuple[str, ...]) -> Array:
    size = len(axes)
    if "cov" in table:
        given = np.asarray(table["cov"][n], dtype=np.float64).ravel()
        if given.size != size * size:
            raise BadMessage(f"'cov' has {given.size} numbers where {size * size} are needed")
        return given.reshape(size, size)
    sigmas = np.full(size, np.nan)
    for k, axis in enumerate(axes):
        common = "sigma_position" if axis in "xyz" else "sigma_range" if axis == "range" else "sigma_bearing"
        for name in (f"sigma_{axis}", common, "sigma"):
            if name in table:
                sigmas[k] = table[name][n]
                break
    return np.diag(sigmas**2)


DECODERS: Mapping[str, Decoder] = {"sensor_msgs/msg/PointCloud2": decode_points}
