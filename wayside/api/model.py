"""A signal that an ONNX model computes: the file, the inputs and the output."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.access import FilePath
from wayside.api.base import ATOMIC_LIST, Identifier, Model, ObjectName, PositiveDuration, map_list
from wayside.api.constraints import unique

TensorName = Annotated[str, Field(min_length=1, max_length=128)]
"""The name of an input or output in the model file."""


class ModelWindow(Model):
    """The latest values of signals over a stream: the newest samples, or a time span resampled at equal steps."""

    signals: list[Identifier] = Field(min_length=1, max_length=64, json_schema_extra=ATOMIC_LIST)
    """Signals of this rule that read a stream. The input consists of the values of their samples; their aggregates are
    ignored."""
    last: int | None = Field(default=None, ge=1, le=10_000)
    """The number of newest samples to use. The signal is unknown while there are fewer."""
    over: PositiveDuration | None = None
    """Instead of last: the time span up to now, resampled at `samples` equal steps."""
    samples: int | None = Field(default=None, ge=2, le=10_000)
    """With over: the number of values; the last one is at the current time. Between two samples, values are
    interpolated linearly; after the newest sample, its value is repeated. The signal is unknown while no sample is as
    old as the first step."""

    @model_validator(mode="after")
    def _complete(self) -> ModelWindow:
        if (self.last is None) == (self.over is None):
            raise ValueError("give exactly one of last and over")
        if (self.over is None) != (self.samples is None):
            raise ValueError("over needs samples, and samples needs over: give both, e.g. over: 5s and samples: 50")
        return self

    @property
    def steps(self) -> int:
        """The number of values of each signal."""
        return self.last or self.samples or 0


class Channels(StrEnum):
    """The channels of a pixel, in this order."""

    GRAY = "Gray"
    RGB = "Rgb"
    BGR = "Bgr"


class ImageLayout(StrEnum):
    """The order of an image's axes."""

    CHW = "Chw"
    HWC = "Hwc"


class ModelImage(Model):
    """The newest sensor_msgs/msg/Image of a stream. Each value is (pixel * scale - mean) / std of its channel."""

    stream: ObjectName
    """A stream of type sensor_msgs/msg/Image."""
    width: int = Field(ge=1, le=4096)
    """The width in pixels. An image of another size is resampled (nearest pixel)."""
    height: int = Field(ge=1, le=4096)
    """The height in pixels."""
    channels: Channels = Channels.RGB
    """The channels of a pixel: Gray, Rgb or Bgr. The image is converted to them."""
    layout: ImageLayout = ImageLayout.CHW
    """The order of the axes. Chw: channels, rows, columns. Hwc: rows, columns, channels."""
    scale: float = 1.0
    """The factor for each pixel value, e.g. 0.00392157 to map 0…255 to 0…1."""
    mean: list[float] = Field(default_factory=list, max_length=3, json_schema_extra=ATOMIC_LIST)
    """The values to subtract after scaling, one per channel. Default: 0."""
    std: list[Annotated[float, Field(gt=0)]] = Field(default_factory=list, max_length=3, json_schema_extra=ATOMIC_LIST)
    """The values to divide by after subtracting the mean, one per channel. Default: 1."""

    @model_validator(mode="after")
    def _one_for_each_channel(self) -> ModelImage:
        for name, values in (("mean", self.mean), ("std", self.std)):
            if values and len(values) != self.depth:
                raise ValueError(f"{name}: must have one value per channel, {self.depth} in total; got {len(values)}")
        return self

    @property
    def depth(self) -> int:
        """The number of channels."""
        return 1 if self.channels is Channels.GRAY else 3


class ModelPoints(Model):
    """The newest sensor_msgs/msg/PointCloud2 of a stream: `count` points, with the fields in this order."""

    stream: ObjectName
    """A stream of type sensor_msgs/msg/PointCloud2."""
    fields: list[Annotated[str, Field(min_length=1, max_length=64)]] = Field(
        default_factory=lambda: ["x", "y", "z"], min_length=1, max_length=16, json_schema_extra=ATOMIC_LIST
    )
    """The fields of each point, e.g. x, y, z and intensity."""
    count: int = Field(ge=1, le=1_000_000)
    """The number of points. A larger cloud is thinned to every n-th point; a smaller one is padded with zeros. Points
    with a NaN in a field or in x, y, z are omitted."""
    scale: list[float] = Field(default_factory=list, max_length=16, json_schema_extra=ATOMIC_LIST)
    """The factors for the fields, one per field. Default: 1."""

    @model_validator(mode="after")
    def _one_for_each_field(self) -> ModelPoints:
        if len(set(self.fields)) < len(self.fields):
            raise ValueError("fields: a field is given twice: give it once")
        if self.scale and len(self.scale) != len(self.fields):
            raise ValueError(
                f"scale: must have one value per field, {len(self.fields)} in total; got {len(self.scale)}"
            )
        return self


class ModelInput(Model):
    """One input of the model. It has exactly one of signals, window, image and points."""

    name: TensorName
    """The input's name in the model file."""
    signals: list[Identifier] = Field(default_factory=list, max_length=64, json_schema_extra=ATOMIC_LIST)
    """Signals of the rule. The input is a vector of their current values, numbers or booleans."""
    window: ModelWindow | None = None
    """The latest values of signals: a vector of one signal, or a matrix with one column per signal."""
    image: ModelImage | None = None
    """The newest image of a camera."""
    points: ModelPoints | None = None
    """The newest point cloud of a lidar, as a matrix with one row per point."""

    @model_validator(mode="after")
    def _exactly_one(self) -> ModelInput:
        given = [bool(self.signals), self.window is not None, self.image is not None, self.points is not None]
        if sum(given) != 1:
            raise ValueError("give exactly one of signals, window, image and points")
        return self

    @property
    def shape(self) -> tuple[int, ...]:
        """The input's shape for one client, without the model's first axis."""
        if self.window is not None:
            several = (len(self.window.signals),) if len(self.window.signals) > 1 else ()
            return (self.window.steps, *several)
        if self.image is not None:
            flat, depth = (self.image.height, self.image.width), self.image.depth
            return (depth, *flat) if self.image.layout is ImageLayout.CHW else (*flat, depth)
        if self.points is not None:
            return (self.points.count, len(self.points.fields))
        return (len(self.signals),)


class ModelSource(Model):
    """An ONNX model. Its first axis is the batch of clients, which are computed together."""

    constraints = (unique("inputs", wording="the name {!r} is used twice: give each input once"),)

    file: FilePath
    """The path of the .onnx file, e.g. on a volume: /models/risk.onnx. Events contain its SHA-256 digest."""
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$", max_length=64)
    """The expected SHA-256 digest of the file. A file with another digest is refused."""
    inputs: list[ModelInput] = Field(min_length=1, max_length=16, json_schema_extra=map_list("name"))
    """All inputs of the model."""
    output: TensorName | None = None
    """The output to use as the signal: a number, or a list if it has several values. Default: the only output, or a map
    of all outputs by name."""
