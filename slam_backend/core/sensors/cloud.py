"""sensor_msgs/PointCloud2 as named columns: how tables of observations travel without custom messages."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BadMessage
from ..measurement import Array, Message

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def columns(message: Message) -> dict[str, NDArray[Any]]:
    """Field name -> (N,) array, or (N, count) where the field's count exceeds 1."""
    points, step = int(message.width) * int(message.height), int(message.point_step)
    data = np.frombuffer(memoryview(message.data), dtype=np.uint8)
    if points * step > data.size:
        raise BadMessage(
            f"point cloud holds {data.size} bytes where {points} points of {step} bytes are announced"
        )
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        if field.datatype not in _TYPES:
            raise BadMessage(f"point field '{field.name}' has the unknown datatype {field.datatype}")
        form = np.dtype(order + _TYPES[field.datatype])
        count = max(int(field.count), 1)
        if field.offset + form.itemsize * count > step:
            raise BadMessage(f"point field '{field.name}' reaches beyond the point step of {step} bytes")
        names.append(field.name)
        formats.append((form, (count,)) if count > 1 else form)
        offsets.append(int(field.offset))
    if len(set(names)) < len(names):
        raise BadMessage("point cloud names a field twice")
    if not names:
        return {}
    try:
        layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    except ValueError as error:
        raise BadMessage(f"point cloud has fields that cannot be: {error}") from None
    table = np.frombuffer(data[: points * step].tobytes(), dtype=layout)
    return {name: table[name] for name in names}


def scalars(table: Mapping[str, NDArray[Any]], names: Sequence[str]) -> Array:
    """(N, len(names)): columns side by side; BadMessage where a field holds more than one number per point."""
    for name in names:
        if table[name].ndim != 1:
            raise BadMessage(f"point field '{name}' holds {table[name].shape[1]} numbers where one is needed")
    return np.stack([table[name] for name in names], axis=1).astype(np.float64)
