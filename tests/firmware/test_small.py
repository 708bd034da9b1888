"""Controllers with one codec: they fit small processors, offer that codec alone, and play it to the same bits."""

import numpy as np
import pytest

from tests.firmware.boards import between_rests, coded, play_as_computed, session
from vibrocast.firmware.build import build, size
from vibrocast.harness.boards import cortex_m
from vibrocast.harness.boards.cortex_m import CortexM
from vibrocast.host.controller import ControllerError
from vibrocast.host.player import play
from vibrocast.output.actuator import PIEZO_STACK, Codes


@pytest.mark.parametrize(("name", "flash_bytes", "ram_bytes"), [("slp", 1 << 16, 1 << 14), ("mdct", None, 1 << 15)])
def test_a_controller_with_one_codec_fits(name: str, flash_bytes: int | None, ram_bytes: int) -> None:
    of = size(f"small-{name}")
    assert of.ram <= ram_bytes
    assert flash_bytes is None or of.flash <= flash_bytes


@pytest.mark.parametrize(("name", "other"), [("slp", "mdct"), ("mdct", "slp")])
def test_it_plays_its_codec_and_rejects_another(name: str, other: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cortex_m, "build", lambda core: build(f"small-{name}"))
    codes: list[Codes] = []
    device = CortexM("cortex-m4", on_dac=codes.append)
    link, host = session(device)
    assert [codec.name for codec in host.description.codecs] == [name]
    stream = coded(other, 0.2, channels=1)
    with pytest.raises(ControllerError, match="is needed, which this controller does not have"):
        play(host, stream)
    expected = play_as_computed(link, host, coded(name, 0.2, channels=1), PIEZO_STACK, capture=False)
    np.testing.assert_array_equal(between_rests(np.concatenate(codes)), between_rests(expected))
    assert device.processor.stack_bytes() < size(f"small-{name}").stack
