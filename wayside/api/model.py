"""A signal that an ONNX model computes: the file, what goes in and what comes out."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator
from pydantic.config import JsonDict

from wayside.api.base import Identifier, Model, ObjectName, PositiveDuration

_ATOMIC: JsonDict = {"x-kubernetes-list-type": "atomic"}

TensorName = Annotated[str, Field(min_length=1, max_length=128)]
"""The name of an input or output, as the model file has it."""


class ModelWindow(Model):
    """The latest values of signals over a stream: the newest ones, or a time drawn again at equal steps."""

    signals: list[Identifier] = Field(
        min_length=1,
        max_length=64,
        description="Signals of this rule over a stream, whose samples are taken; their aggregates say nothing here.",
        json_schema_extra=_ATOMIC,
    )
    last: int | None = Field(
        default=None, ge=1, le=10_000, description="The newest so many samples; unknown while there are fewer."
    )
    over: PositiveDuration | None = Field(
        default=None, description="Instead of last: the time up to now, read at `samples` equal steps."
    )
    samples: int | None = Field(
        default=None,
        ge=2,
        le=10_000,
        description="With over: so many values, the last one at now. Between samples they lie on a straight line, "
        "after the newest one they stay; unknown while no sample is as old as the first.",
    )

    @model_validator(mode="after")
    def _complete(self) -> ModelWindow:
        if (self.last is None) == (self.over is None):
            raise ValueError("give exactly one of last and over (with samples)")
        if (self.over is None) != (self.samples is None):
            raise ValueError("over and samples go together: give both, e.g. over: 5s and samples: 50")
        return self

    @property
    def steps(self) -> int:
        """How many values there are of each signal."""
        return self.last or self.samples or 0


class Channels(StrEnum):
    """What a pixel holds, in this order."""

    GRAY = "Gray"
    RGB = "Rgb"
    BGR = "Bgr"


class Layout(StrEnum):
    """The order of an image's axes."""

    CHW = "Chw"
    HWC = "Hwc"


class ModelImage(Model):
    """The newest sensor_msgs/msg/Image of a stream: (pixel * scale - mean) / std of each channel."""

    stream: ObjectName = Field(description="A stream of type sensor_msgs/msg/Image.")
    width: int = Field(ge=1, le=4096, description="Pixels. An image of another size is drawn again, nearest pixel.")
    height: int = Field(ge=1, le=4096, description="Pixels.")
    channels: Channels = Field(default=Channels.RGB, description="Gray, Rgb or Bgr; the image is converted.")
    layout: Layout = Field(
        default=Layout.CHW, description="Chw: channels, rows, columns. Hwc: rows, columns, channels."
    )
    scale: float = Field(default=1.0, description="E.g. 0.00392157 for pixels of 0 to 255 as 0 to 1.")
    mean: list[float] = Field(
        default_factory=list,
        max_length=3,
        description="Subtracted after scaling, one for each channel; default 0.",
        json_schema_extra=_ATOMIC,
    )
    std: list[Annotated[float, Field(gt=0)]] = Field(
        default_factory=list,
        max_length=3,
        description="Divided by, one for each channel; default 1.",
        json_schema_extra=_ATOMIC,
    )

    @model_validator(mode="after")
    def _one_for_each_channel(self) -> ModelImage:
        for name, values in (("mean", self.mean), ("std", self.std)):
            if values and len(values) != self.depth:
                raise ValueError(f"{name}: {len(values)} values for {self.depth} channels: give one for each")
        return self

    @property
    def depth(self) -> int:
        """How many channels there are."""
        return 1 if self.channels is Channels.GRAY else 3


class ModelPoints(Model):
    """The newest sensor_msgs/msg/PointCloud2 of a stream: so many points, with the fields in this order."""

    stream: ObjectName = Field(description="A stream of type sensor_msgs/msg/PointCloud2.")
    fields: list[Annotated[str, Field(min_length=1, max_length=64)]] = Field(
        default_factory=lambda: ["x", "y", "z"],
        min_length=1,
        max_length=16,
        description="The fields of each point, e.g. x, y, z and intensity.",
        json_schema_extra=_ATOMIC,
    )
    count: int = Field(
        ge=1,
        le=1_000_000,
        description="Of more points, every so many-th is taken; fewer are filled up with zeros. Points with a NaN in a "
        "field or in x, y, z are left out.",
    )
    scale: list[float] = Field(
        default_factory=list,
        max_length=16,
        description="What each field is multiplied by; default 1.",
        json_schema_extra=_ATOMIC,
    )

    @model_validator(mode="after")
    def _one_for_each_field(self) -> ModelPoints:
        if len(set(self.fields)) < len(self.fields):
            raise ValueError("fields: give each once")
        if self.scale and len(self.scale) != len(self.fields):
            raise ValueError(f"scale: {len(self.scale)} values for {len(self.fields)} fields: give one for each")
        return self


class ModelInput(Model):
    """One input of the model: exactly one of signals, window, image and points."""

    name: TensorName = Field(description="The input's name in the model file.")
    signals: list[Identifier] = Field(
        default_factory=list,
        max_length=64,
        description="The current values of these signals of the rule, numbers or booleans, as a vector.",
        json_schema_extra=_ATOMIC,
    )
    window: ModelWindow | None = Field(
        default=None, description="The latest values of signals: a vector, or with several signals a matrix of rows."
    )
    image: ModelImage | None = Field(default=None, description="A camera's newest image.")
    points: ModelPoints | None = Field(default=None, description="A lidar's newest points, a matrix of rows.")

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
            return (depth, *flat) if self.image.layout is Layout.CHW else (*flat, depth)
        if self.points is not None:
            return (self.points.count, len(self.points.fields))
        return (len(self.signals),)


class ModelSource(Model):
    """An ONNX model. Its first axis is the clients', which are computed together."""

    file: str = Field(
        min_length=1,
        max_length=1024,
        description="The .onnx file, e.g. on a volume: /models/risk.onnx. Its sha256 is in the events.",
    )
    sha256: str | None = Field(
        default=None, pattern=r"^[0-9a-f]{64}$", max_length=64, description="Refuse the file if it is another one."
    )
    inputs: list[ModelInput] = Field(
        min_length=1,
        max_length=16,
        description="Every input that the model needs.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    output: TensorName | None = Field(
        default=None,
        description="The output that is the signal: a number, or a list where it has several. "
        "Default: the only one, or a map of all by name.",
    )

    @model_validator(mode="after")
    def _unique_names(self) -> ModelSource:
        names = [each.name for each in self.inputs]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"inputs: the name {twice[0]!r} is used twice: give each input once")
        return self
