"""The fields of the standard ROS 2 messages in the file are those that rosbags knows."""

from __future__ import annotations

from pathlib import Path

from rosbags.typesys import Stores, get_typestore

import detector.streams.codecs.ros as module
from detector.streams.codecs.ros import release_fields
from tests.ros_definitions import text


def test_the_file_is_up_to_date() -> None:
    written = Path(module.__file__).with_name("jazzy.json").read_text(encoding="utf-8")
    assert written == text(), "run: python -m tests.ros_definitions > detector/streams/codecs/jazzy.json"


def test_all_types_have_the_fields_of_rosbags() -> None:
    types = get_typestore(Stores.ROS2_JAZZY).fielddefs
    assert release_fields() == {name: fields for name, (_, fields) in types.items()}
