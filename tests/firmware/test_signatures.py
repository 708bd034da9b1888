"""Controllers with a key: they need a verifier to start, and take only what it calls signed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from tests.firmware.native import ffi, native
from vibrocast import models
from vibrocast.device_protocol.model_image import ModelError, ModelImage
from vibrocast.device_protocol.transports import SerialTransport, TransportError
from vibrocast.firmware import build as building
from vibrocast.firmware import keys
from vibrocast.firmware.build import build
from vibrocast.harness.boards import cortex_m
from vibrocast.harness.boards.host_process import HostProcess
from vibrocast.host import uploader
from vibrocast.host.controller import Controller as Host
from vibrocast.host.controller import ControllerError
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.actuator_constants import constants
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.memory_link import MemoryLink

PRIVATE_KEY = bytes(range(32))
KEY = keys.public_key(PRIVATE_KEY)
IMAGE = models.find("eva-16-4").image
SIGNED = uploader.signed(IMAGE, PRIVATE_KEY, 3)
KNOWN = (Path(__file__).with_name("known_signature.c"),)
"""The sources of a verifier that knows the signature of SIGNED alone."""
INSTALLED = tuple(map(Path, filter(None, os.environ.get("VIBROCAST_VERIFIER", "").split(os.pathsep))))
"""Those of a whole one, such as Monocypher with firmware/examples/monocypher_verifier.c."""
needs_installed = pytest.mark.skipif(not INSTALLED, reason="VIBROCAST_VERIFIER names no C sources of a verifier")


@contextmanager
def controller(name: str, verifier: tuple[Path, ...], patch: pytest.MonkeyPatch) -> Iterator[Host]:
    """Start a controller with KEY, and yield its host."""
    if name == "host":
        with HostProcess(public_key=KEY, verifier=verifier) as process, Host(SerialTransport(process.name)) as host:
            yield host
        return
    patch.setattr(cortex_m, "build", lambda core: build(core, public_key=KEY, verifier=verifier))
    link = MemoryLink(Controller(Settings(public_key=KEY)) if name == "sim" else cortex_m.CortexM(name))
    yield Host(link, link.clock, link.sleep)


@pytest.mark.parametrize(
    ("name", "verifier"),
    [
        pytest.param("sim", (), id="sim"),
        pytest.param("host", KNOWN, id="host"),
        pytest.param("cortex-m4", KNOWN, id="cortex-m4", marks=pytest.mark.slow),
        pytest.param("cortex-m4", INSTALLED, id="cortex-m4-installed", marks=needs_installed),
    ],
)
def test_a_controller_with_a_key_takes_only_what_its_verifier_calls_signed(
    name: str, verifier: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    with controller(name, verifier, monkeypatch) as host:
        assert (host.description.public_key, host.request_status().signed_images) == (KEY, True)
        with pytest.raises(ModelError, match="no signature"):
            uploader.flash(host, IMAGE)
        with monkeypatch.context() as patch:
            patch.setattr(uploader, "check_signature", lambda image, key: ModelImage.unpack(image))
            for place in (len(IMAGE), -1):  # the number, the signature
                changed = bytearray(SIGNED)
                changed[place] ^= 1
                with pytest.raises(ControllerError, match="not by this controller's key"):
                    uploader.flash(host, bytes(changed))
        assert uploader.flash(host, SIGNED).number == 3


def test_a_controller_with_a_key_and_no_verifier_does_not_start() -> None:
    key = ffi.new("uint8_t[]", KEY)
    memory = ffi.new("int64_t[]", native.vc_controller_size() // 8)
    name = ffi.new("char[]", b"a")
    actuator = ffi.new("vc_actuator *", constants(PIEZO_STACK))
    named = {"build": name, "hardware": name, "actuator": actuator, "watchdog_ms": 2000}
    settings = ffi.new("vc_controller_settings *", {**named, "public_key": key})
    controller = ffi.cast("vc_controller *", memory)
    status = native.vc_controller_init(controller, settings, ffi.NULL, ffi.NULL, 0)
    assert status == native.VC_NO_VERIFIER
    assert b"build it with --verifier" in ffi.string(native.vc_status_text(status))
    assert not any(memory)


def test_a_process_with_a_key_and_no_verifier_says_what_it_lacks() -> None:
    with pytest.raises(TransportError, match=r"did not start: .* build it with --verifier"):
        HostProcess(public_key=KEY)


def test_the_command_builds_no_controller_with_a_key_and_no_verifier(tmp_path: Path) -> None:
    path = tmp_path / "key.pub.pem"
    keys.write_public_key(path, KEY)
    done = CliRunner().invoke(building.main, ["host", "--public-key", str(path)])
    assert done.exit_code == 2 and "give the C sources for that as --verifier" in done.output
    done = CliRunner().invoke(building.main, ["host", "--public-key", str(path), "--verifier", str(KNOWN[0])])
    assert done.exit_code == 0, done.output
    assert str(build("host", public_key=KEY, verifier=KNOWN)) in done.output
