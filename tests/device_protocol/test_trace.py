"""Traces: what was written is read again, whatever the frames; other files are rejected; tshark names the fields."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.frames import FrameSplitter, write_frame
from vibrocast.device_protocol.messages import (
    ActuatorDescription,
    CodecDescription,
    Configure,
    Error,
    HelloResponse,
    Limits,
    Message,
    State,
    Status,
    StreamData,
    pack,
)
from vibrocast.device_protocol.trace import SUFFIXES, TracedFrame, read_trace, writer
from vibrocast.errors import InputError
from vibrocast.harness.dissector import DISSECTOR

frames = st.lists(
    st.builds(
        TracedFrame,
        st.integers(0, 2**63 - 1),
        st.booleans(),
        st.sampled_from(["sim", "serial:/dev/tty 1", "ü"]),
        st.binary(min_size=1, max_size=300),
    )
)
HELLO = HelloResponse(
    "b1",
    "board",
    Limits(4096, 4084, 32768, 0, 8, 100, 96000, 2000),
    ActuatorDescription("lra", 80.5, 150, 0, 270, 0, 16, 48000),
    (CodecDescription(1, "mdct"), CodecDescription(11, "parametric")),
    serial_number="0042",
)
STATUS = Status(State.PLAYING, 7, 1 << 40, 64, 6400, 320, 1, 2, 3, 4, 5, 6, 7, 8, 9, True)


def traced(message: Message, sequence: int = 0, from_host: bool = False) -> TracedFrame:
    return TracedFrame(1_800_000_000_123_456_789, from_host, "sim", write_frame(pack(message, sequence))[:-1])


def write(path: Path, written: list[TracedFrame]) -> Path:
    with path.open("wb") as file:
        writing = writer(file, path.suffix)
        for frame in written:
            writing.write(frame)
    return path


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(written=frames)
def test_frames_are_read_as_they_were_written(
    suffix: str, tmp_path_factory: pytest.TempPathFactory, written: list[TracedFrame]
) -> None:
    path = write(tmp_path_factory.mktemp("trace") / f"trace{suffix}", written)
    if written or suffix == ".pcapng":
        assert list(read_trace(path)) == written


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_trace_that_was_cut_gives_what_came_before(suffix: str, tmp_path: Path) -> None:
    written = [traced(HELLO, 1), traced(STATUS, 2), traced(Error(9, "no"), 3)]
    whole = write(tmp_path / f"trace{suffix}", written).read_bytes()
    for length in range(40, len(whole)):
        path = tmp_path / f"cut{suffix}"
        path.write_bytes(whole[:length])
        found = list(read_trace(path))
        assert found == written[: len(found)]


@given(st.binary(max_size=200), st.sampled_from([b"", b"{", bytes.fromhex("0a0d0d0a1c0000004d3c2b1a01000000")]))
def test_any_other_file_is_rejected_or_read_without_harm(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, head: bytes
) -> None:
    path = tmp_path_factory.mktemp("trace") / "trace"
    path.write_bytes(head + data)
    try:
        for frame in read_trace(path):
            frame.as_json()
    except InputError as error:
        assert "; " in str(error)


@given(st.lists(st.binary(max_size=90_000), max_size=4))
def test_bytes_are_split_at_delimiters_in_bounded_memory(chunks: list[bytes]) -> None:
    splitter = FrameSplitter()
    found = [frame for chunk in chunks for frame in splitter.feed(chunk)]
    assert b"" not in found and not any(0 in frame for frame in found)
    assert b"".join(chunks).replace(b"\x00", b"").startswith(b"".join(found))


def test_messages_are_json_with_their_fields() -> None:
    document = json.loads(json.dumps(traced(HELLO, 5).as_json(), allow_nan=False))
    assert (document["from"], document["link"], document["message"]) == ("controller", "sim", "HelloResponse")
    assert document["fields"]["actuator"]["stroke_um"] == 80.5
    assert document["fields"]["codecs"][1] == {"identifier": 11, "name": "parametric"}
    assert traced(STATUS).as_json()["fields"]["state"] == "PLAYING"
    damaged = TracedFrame(0, True, "sim", traced(STATUS).encoded[:-1])
    assert damaged.as_json()["message"] is None


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_tshark_names_every_field(tmp_path: Path) -> None:
    configure = Configure(3, bytes(range(9)), 5120, packets=300, gain=0.5)
    data = StreamData(7, 300, (b"one", b"three"))
    damaged = bytearray(traced(STATUS, 8).encoded)
    damaged[5] ^= 1
    path = write(
        tmp_path / "trace.pcapng",
        [
            traced(configure, 4, from_host=True),
            traced(HELLO, 5),
            traced(STATUS, 6),
            traced(data, from_host=True),
            traced(Error(9, "too much"), 7),
            TracedFrame(0, False, "sim", bytes(damaged)),
        ],
    )

    def tshark(*arguments: str) -> list[str]:
        done = subprocess.run(
            ["tshark", "-X", f"lua_script:{DISSECTOR}", "-r", path, *arguments],
            capture_output=True,
            text=True,
            check=True,
        )
        assert "Lua" not in done.stderr, done.stderr
        return done.stdout.splitlines()

    named = ["configure.gain", "hello_response.serial_number", "limits.watchdog_ms", "status.position"]
    named += ["stream_data.iteration", "error.text"]
    columns = [part for name in named for part in ("-e", f"vibrocast.{name}")]
    rows = [line.split("\t") for line in tshark("-T", "fields", *columns)]
    known = [{name: value for name, value in zip(named, row, strict=True) if value} for row in rows]
    assert known == [
        {"configure.gain": "0.5"},
        {"hello_response.serial_number": "0042", "limits.watchdog_ms": "2000"},
        {"status.position": "64"},
        {"stream_data.iteration": "300"},
        {"error.text": "too much"},
        {},
    ]
    shown = "\n".join(tshark("-V"))
    assert "state: PLAYING (3)" in shown and "damaged frame" in shown and "name: parametric" in shown
