"""The example of docs/reference/protocol.md is what the code packs; test_generate.py holds the tables."""

import re
from pathlib import Path

import pytest

from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import pack, unpack

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "protocol.md").read_text(encoding="utf-8")
EXAMPLE = re.findall(r"^\| (\w+)(?:, (?:sequence (\w+)|[\w ]+))? \| `([0-9a-f ]+ 00)` \|$", PAGE, re.MULTILINE)


def test_the_example_has_every_kind_of_frame() -> None:
    assert [name for name, _, _ in EXAMPLE] == [
        *("Hello", "Error", "Configure", "Status", "StreamData", "SinglePacket"),
        *("Start", "Status", "StatusRequest", "Stop"),
    ]


@pytest.mark.parametrize(("name", "sequence", "row"), EXAMPLE)
def test_example_frames_are_what_the_code_packs(name: str, sequence: str, row: str) -> None:
    frame = bytes.fromhex(row)
    (payload,) = FrameReader().feed(frame)
    found, message = unpack(payload)
    assert (type(message).__name__, found) == (name, int(sequence or "0", 16))
    assert frame == write_frame(pack(message, found))
