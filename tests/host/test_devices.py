"""Controllers by their address: the needs of those made of the firmware, and their limits."""

import sys

import pytest

from vibrocast.device_protocol.transports import TransportError
from vibrocast.extras import MissingExtraError
from vibrocast.harness.boards.stm32f405 import UNIQUE_NUMBER
from vibrocast.host import devices

OTHERS = ("host", "cortex-m7", "cortex-m33", "stm32f405", "rp2040")


@pytest.mark.parametrize(
    "address", ["cortex-m4", *(pytest.param(address, marks=pytest.mark.slow) for address in OTHERS)]
)
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
    for module, address in (("unicorn", "cortex-m4"), ("ziglang", "host")):
        monkeypatch.setitem(sys.modules, module, None)
        message = rf"needs {module}; install the extra \[firmware\]: "
        with pytest.raises(MissingExtraError, match=message), devices.connect(address):
            pass


@pytest.mark.slow
def test_a_board_states_its_serial_number() -> None:
    with devices.connect("stm32f405") as controller:
        assert controller.description.serial_number == UNIQUE_NUMBER.hex()
        assert devices.facts(controller)["serial_number"] == UNIQUE_NUMBER.hex()
    with devices.connect("sim") as controller:
        assert devices.facts(controller)["serial_number"] == "none"
