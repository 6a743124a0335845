"""ROS point clouds as PCD files (binary, version 0.7): all fields, in their places.

Sources: sensor_msgs/msg/PointField for the datatypes, the Point Cloud Library's description of PCD for the header.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

_TYPES = {1: ("I", 1), 2: ("U", 1), 3: ("I", 2), 4: ("U", 2), 5: ("I", 4), 6: ("U", 4), 7: ("F", 4), 8: ("F", 8)}
"""PCD's type and size in bytes, by the datatype of a PointField."""


def pcd(cloud: Mapping[str, Any]) -> bytes | None:
    """A sensor_msgs/msg/PointCloud2 as PCD; None if its fields overlap or do not fit into its data.

    Bytes between the fields become fields named `_`, so that the points stay as they were sent. Spaces in the names of
    fields are replaced by `_`.
    """
    width, height = int(cloud["width"]), int(cloud["height"])
    step, row, data = int(cloud["point_step"]), int(cloud["row_step"]), cloud["data"]
    if not step or row < width * step or len(data) < row * height:
        return None
    columns: list[tuple[str, str, int, int]] = []
    swaps: list[tuple[int, int, int]] = []
    reached = 0
    for field in sorted(cloud["fields"], key=lambda each: float(each["offset"])):
        known = _TYPES.get(int(field["datatype"]))
        offset, count = int(field["offset"]), int(field["count"]) or 1
        if known is None or offset < reached:
            return None
        if offset > reached:
            columns.append(("_", "U", 1, offset - reached))
        columns.append(("_".join(field["name"].split()) or "_", *known, count))
        swaps.append((offset, known[1], count))
        reached = offset + known[1] * count
    if reached > step or not columns:
        return None
    if reached < step:
        columns.append(("_", "U", 1, step - reached))
    points = np.frombuffer(data, np.uint8, row * height).reshape(height, row)[:, : width * step].reshape(-1, step)
    if cloud.get("is_bigendian"):
        points = points.copy()
        for offset, size, count in swaps:
            part = slice(offset, offset + size * count)
            points[:, part] = points[:, part].reshape(-1, count, size)[:, :, ::-1].reshape(-1, size * count)
    header = "\n".join(
        (
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            "FIELDS " + " ".join(name for name, _, _, _ in columns),
            "SIZE " + " ".join(str(size) for _, _, size, _ in columns),
            "TYPE " + " ".join(kind for _, kind, _, _ in columns),
            "COUNT " + " ".join(str(count) for _, _, _, count in columns),
            f"WIDTH {width}",
            f"HEIGHT {height}",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {width * height}",
            "DATA binary\n",
        )
    )
    return header.encode("utf-8", "replace") + points.tobytes()
