"""The firmware as a process behind its own pseudo-terminal: plays, keeps images in a file, ends when it should."""

import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from tests.simulated_device.bench import stream
from vibrocast import models
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.transports import SerialTransport, TransportError
from vibrocast.firmware.build import build
from vibrocast.harness.boards.host_process import HostProcess
from vibrocast.host import uploader
from vibrocast.host.controller import ConnectionLost
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import PlaybackSettings, play
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import render

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")


def test_stream_is_played_as_computed_and_goes_to_the_file_of_codes(tmp_path: Path) -> None:
    played = stream(0.3, channels=2)
    with HostProcess("--dac", tmp_path / "codes") as process, Host(SerialTransport(process.name)) as host:
        result = play(host, played, PlaybackSettings(capture=True))
    expected, _ = render(played.header, played.decoded, played.delay_samples, PIEZO_STACK)
    assert result.state == State.FINISHED
    np.testing.assert_array_equal(result.decoded, played.decoded)
    np.testing.assert_array_equal(result.dac_codes, expected)
    np.testing.assert_array_equal(np.fromfile(tmp_path / "codes", np.int16).reshape(-1, 2), expected)


def test_images_are_kept_in_the_flash_file(tmp_path: Path) -> None:
    image = models.find("eva-16-4").image
    with HostProcess("--flash", tmp_path / "flash") as process, Host(SerialTransport(process.name)) as host:
        kept = uploader.flash(host, image)
    with HostProcess("--flash", tmp_path / "flash") as process, Host(SerialTransport(process.name)) as host:
        running = uploader.running(host)
    assert running is not None and running.sha256 == kept.sha256


def test_name_and_hardware_are_as_requested_and_the_name_goes_with_the_process(tmp_path: Path) -> None:
    link = tmp_path / "controller"
    with HostProcess("--link", link, "--hardware", "bench 3"), Host(SerialTransport(str(link))) as host:
        assert host.description.hardware == "bench 3"
    assert not link.is_symlink()


@pytest.mark.parametrize("by_signal", [False, True])
def test_it_ends_with_its_input_and_by_sigterm(by_signal: bool) -> None:
    with subprocess.Popen([build("host")], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline()
        if by_signal:
            process.terminate()
        else:
            process.stdin.close()
        assert process.wait(10) == 0


def test_a_file_of_images_is_of_one_process(tmp_path: Path) -> None:
    with HostProcess("--flash", tmp_path / "flash"), pytest.raises(TransportError, match="another process"):
        HostProcess("--flash", tmp_path / "flash")
    HostProcess("--flash", tmp_path / "flash").close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_an_error_and_leaves_no_link(tmp_path: Path) -> None:
    played, link = stream(0.3), tmp_path / "link"
    process = HostProcess("--dac", "/dev/full", "--link", link)
    with Host(SerialTransport(process.name)) as host, suppress(TransportError, ConnectionLost):
        play(host, played, PlaybackSettings(reconnect_s=0))
    with pytest.raises(TransportError, match="DAC codes: No space"):
        process.close()
    assert not link.is_symlink()


def test_options_that_cannot_be_are_rejected_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "flash").write_bytes(b"too short")
    for options, reason in (
        (("--flash", tmp_path / "flash"), "delete it"),
        (("--flash", tmp_path / "none" / "flash"), "No such file"),
        (("--dac", tmp_path), "directory"),
        (("--link", tmp_path), "exists.*delete it"),
        (("--drift",), "usage"),
        (("--drift-ppm", "fast"), "usage"),
        (("--drift-ppm", "100001"), "usage"),
        (("--hardware", 64 * "x"), "usage"),
    ):
        with pytest.raises(TransportError, match=reason):
            HostProcess(*options)
