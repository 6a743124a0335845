"""Camera images and point clouds as arrays, directly from a message's bytes, without a list of a million numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.ros import standard

IMAGE = "sensor_msgs/msg/Image"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"

_PIXELS: dict[str, tuple[str, str]] = {
    "mono8": ("u1", "v"),
    "8UC1": ("u1", "v"),
    "mono16": ("u2", "v"),
    "16UC1": ("u2", "v"),
    "32FC1": ("f4", "v"),
    "rgb8": ("u1", "rgb"),
    "8UC3": ("u1", "bgr"),
    "bgr8": ("u1", "bgr"),
    "rgba8": ("u1", "rgba"),
    "bgra8": ("u1", "bgra"),
}
"""By ROS encoding: the number type of a pixel, and its channels in order (v: one for all). OpenCV's 8UC3 is BGR."""

_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""By sensor_msgs/msg/PointField.datatype."""

_GRAY = (0.299, 0.587, 0.114)
"""Red, green and blue to brightness (ITU-R BT.601)."""


def image(payload: bytes) -> NDArray[np.float32]:
    """The pixels of a sensor_msgs/msg/Image as (height, width, 3) in the order R, G, B, or (height, width, 1) if gray.

    Raises:
        DecodeError: invalid message, unknown encoding, or fewer bytes than it declares.
    """
    message = _message(payload, IMAGE)
    if message.encoding not in _PIXELS:
        raise DecodeError(f"image encoding {message.encoding!r} is not supported; use one of {', '.join(_PIXELS)}")
    kind, channels = _PIXELS[message.encoding]
    height, width, depth = int(message.height), int(message.width), len(channels)
    number = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    row = width * depth * number.itemsize
    step = int(message.step) or row
    if height == 0 or width == 0 or step < row or len(message.data) < step * (height - 1) + row:
        size = len(message.data)
        raise DecodeError(f"image of {width} x {height} {message.encoding} with step {step} does not fit {size} bytes")
    rows = np.lib.stride_tricks.as_strided(message.data, (height, row), (step, 1))
    pixels = np.ascontiguousarray(rows).view(number).reshape(height, width, depth).astype(np.float32)
    return pixels if depth == 1 else pixels[:, :, [channels.index(name) for name in "rgb"]]


def gray(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """The brightness of (height, width, 3) as (height, width, 1)."""
    return pixels if pixels.shape[2] == 1 else (pixels @ np.array(_GRAY, np.float32))[:, :, None]


def points(payload: bytes, fields: list[str]) -> NDArray[np.float64]:
    """The points of a sensor_msgs/msg/PointCloud2 as (points, fields), without points that have a NaN in a field or in
    their position.

    Raises:
        DecodeError: invalid message, missing field, or fewer bytes than it declares.
    """
    message = _message(payload, POINT_CLOUD)
    described = {field.name: field for field in message.fields}
    missing = [name for name in fields if name not in described]
    if missing:
        raise DecodeError(f"the points have no field {missing[0]}; their fields are {', '.join(described) or 'none'}")
    height, width, step, row = (
        int(each) for each in (message.height, message.width, message.point_step, message.row_step)
    )
    order = ">" if message.is_bigendian else "<"
    columns = []
    read = dict.fromkeys([*fields, *(name for name in "xyz" if name in described)])
    for name in read:
        field = described[name]
        if field.datatype not in _POINT_TYPES:
            raise DecodeError(f"field {name} of the points has the unknown datatype {field.datatype}; 1 to 8 are known")
        kind = np.dtype(order + _POINT_TYPES[field.datatype])
        columns.append((kind, int(field.offset)))
    if height * width == 0:
        return np.zeros((0, len(fields)))
    last = (height - 1) * row + (width - 1) * step
    if any(last + offset + kind.itemsize > len(message.data) for kind, offset in columns) or step == 0:
        size = len(message.data)
        raise DecodeError(f"{width} x {height} points of {step} bytes in rows of {row} do not fit {size} bytes")
    found = np.empty((height * width, len(read)))
    for index, (kind, offset) in enumerate(columns):
        at = np.ndarray((height, width), kind, message.data, offset, (row, step))
        found[:, index] = at.reshape(-1)
    return found[~np.isnan(found).any(axis=1)][:, : len(fields)]


def _message(payload: bytes, kind: str) -> Any:
    try:
        return standard().store.deserialize_cdr(payload, kind)
    except Exception as error:  # rosbags raises the errors of its generated code: struct's, numpy's, assertions
        raise DecodeError(f"not a valid {kind}: {error}") from error
