"""Every link is tapped: frames are kept within a limit, written as they pass, and a failed run leaves the last ones."""

import json
import re
from pathlib import Path

import pytest

from tests.command import fails, run, succeeds
from tests.conftest import noise, texture
from vibrocast import textures
from vibrocast.device_protocol.messages import HelloResponse
from vibrocast.device_protocol.trace import TracedFrame, Tracer, read_trace, tracer
from vibrocast.host import devices


def test_no_more_than_the_last_frames_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibrocast.device_protocol.trace.KEPT_BYTES", 1000)
    kept = Tracer()
    for number in range(100):
        kept.note(TracedFrame(number, True, "x", bytes(300)))
    assert [frame.time_ns for frame in kept.frames] == [97, 98, 99]
    assert len(kept.take()) == 3 and kept.frames == ()


@pytest.mark.parametrize("address", ["sim", "sim-usb"])
def test_every_address_is_tapped(address: str, tmp_path: Path) -> None:
    with tracer.writing(tmp_path / "trace.jsonl"), devices.connect(address) as controller:
        controller.request_status()
    found = [frame.message() for frame in read_trace(tmp_path / "trace.jsonl")]
    names = [type(each[1]).__name__ for each in found if each is not None]
    assert names == ["Hello", "HelloResponse", "StatusRequest", "Status"]


def test_any_command_writes_a_trace(tmp_path: Path) -> None:
    path = tmp_path / "trace.pcapng"
    succeeds("--trace", path, "status")
    hello, *_ = [found[1] for frame in read_trace(path) if not frame.from_host and (found := frame.message())]
    assert isinstance(hello, HelloResponse)
    assert "the name must end in .pcapng or .jsonl" in fails(2, "--trace", tmp_path / "trace.txt", "status")


def test_a_failed_run_leaves_a_trace_next_to_its_report(tmp_path: Path) -> None:
    bench, report = tmp_path / "bench.toml", tmp_path / "report.json"
    bench.write_text('[[controllers]]\nname = "it"\naddress = "sim"\n[limits]\nmin_gain = 9\n')
    textures.save(tmp_path / "short.wav", texture(noise(0.2, rms=5.0), "m/s^2"))
    arguments = ("play", tmp_path / "short.wav", "--report", report)
    succeeds(*arguments)
    assert not report.with_suffix(".pcapng").exists()
    failed = run(*arguments, "--bench", bench)
    assert re.search(r"^trace of the last frames: .*report\.pcapng$", failed.output, re.MULTILINE)
    assert any(frame.message() for frame in read_trace(report.with_suffix(".pcapng")))
    json.loads(report.read_text())
