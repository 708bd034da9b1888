"""Controllers by their address: what those made of the firmware need, and what they cannot do."""

import sys

import pytest

from vibrocast.device_protocol.transports import TransportError
from vibrocast.firmware import build
from vibrocast.host import devices


@pytest.mark.parametrize("address", ["host", "cortex-m4", "cortex-m7", "cortex-m33", "stm32f405"])
def test_firmware_is_greeted_at_its_address(address: str) -> None:
    assert address in devices.available()
    with devices.connect(address) as controller:
        assert controller.description.build.startswith("vibrocast firmware")


def test_firmware_decodes_by_the_integer_core_alone() -> None:
    assert devices.decoding_runtime("cortex-m4", None) == "core"
    assert devices.decoding_runtime("sim", None) is None
    assert devices.decoding_runtime("serial:/dev/ttyACM0", "onnx") == "onnx"
    with pytest.raises(TransportError, match="leave out `runtime`"), devices.connect("host", "onnx"):
        pass


def test_without_the_emulator_or_the_compiler_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (
        "unicorn",
        "vibrocast.simulated_device.cortex_m",
        "vibrocast.simulated_device.emulator",
        "vibrocast.simulated_device.stm32f405",
    ):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, "unicorn", None)
    with pytest.raises(TransportError, match=r"pip install .vibrocast\[firmware\]"), devices.connect("cortex-m4"):
        pass
    monkeypatch.setattr(build, "find_spec", lambda name: None)
    with pytest.raises(TransportError, match=r"pip install .vibrocast\[firmware\]"), devices.connect("host"):
        pass
