"""Emulated boards for tests: each by its name, the streams that it plays, and what must come out of it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.coded_stream import unpack_file
from vibrocast.device_protocol.messages import State
from vibrocast.harness.boards import cortex_m, rp2040, stm32f405
from vibrocast.harness.boards.cortex_m import CortexM
from vibrocast.harness.boards.rp2040 import Rp2040
from vibrocast.harness.boards.stm32f405 import Stm32F405
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import PlaybackSettings, play
from vibrocast.output.actuator import PIEZO_STACK, Actuator, Codes
from vibrocast.output.rendering import render
from vibrocast.simulated_device.flash import FlashMemory
from vibrocast.simulated_device.memory_link import MemoryLink

LEARNED = "eva-16-4"
MODELS = {"eva": LEARNED}
PIEZO_12_BITS = replace(PIEZO_STACK, dac_bits=12)
FLASH_BYTES = {"stm32f405": stm32f405.FLASH_BYTES, "rp2040": rp2040.FLASH_BYTES}
BOARDS = {"stm32f405": Stm32F405, "rp2040": Rp2040}
GOLDEN = Path(__file__).parents[1] / "codec"
AnyBoard = CortexM | Stm32F405 | Rp2040


@cache
def coded(codec_name: str, seconds: float = 0.3, channels: int = 2) -> Stream:
    """Return a texture at some 12 dB if there is an SNR to ask for, with refresh packets."""
    recording = textures.GENERATORS["rough"](3, seconds)
    recording = replace(recording, samples=np.tile(recording.samples, (1, channels)))
    model = models.find(MODELS[codec_name]) if codec_name in MODELS else None
    snr_db = 12 if codec.codec_by_name(codec_name).keeps_waveform else None
    coded = encode_recording(recording, codec_name=codec_name, snr_db=snr_db, model=model, live=True)
    return replace(coded.stream, runtime="core")


def rate_controlled(codec_name: str) -> Stream:
    """Return a golden stream of mdct, dct, slp or eva whose packets differ in their quality, with its model image."""
    path = GOLDEN / f"golden_{'eva_static' if codec_name == 'eva' else codec_name}_steered.vct"
    header, packets = unpack_file(path.read_bytes())
    image = (GOLDEN / "golden_eva_static.vcmi").read_bytes() if codec_name == "eva" else None
    return Stream(header, tuple(packets), image, "core" if image else None)


def board(name: str, flash: FlashMemory | None = None, on_dac: Callable[[Codes], None] | None = None) -> AnyBoard:
    return BOARDS[name](flash, on_dac) if name in BOARDS else CortexM(name, flash, on_dac)


def session(device: AnyBoard) -> tuple[MemoryLink, Host]:
    link = MemoryLink(device)
    return link, Host(link, link.clock, link.sleep)


def flash_of(name: str) -> FlashMemory:
    return FlashMemory(FLASH_BYTES.get(name, cortex_m.FLASH_BYTES))


def begin(host: Host, stream: Stream, start_us: int = 0) -> None:
    """Configure a stream, send its first packets, and start it at a time of the controller."""
    host.request(messages.Configure(1, stream.header.pack(), 280, packets=len(stream.packets)), messages.Status)
    host.send(messages.StreamData(1, 0, stream.packets[:12]))
    host.request(messages.Start(start_us), messages.Status)


def between_rests(codes: Codes) -> Codes:
    """Return what is played, without rest before and after, and without the way up to rest at the boot of a board."""
    booted = np.flatnonzero(~codes.any(axis=1))[0]
    sound = booted + np.flatnonzero(codes[booted:].any(axis=1))
    return codes[sound[0] : sound[-1] + 1]


def play_as_computed(
    link: MemoryLink, host: Host, stream: Stream, actuator: Actuator = PIEZO_12_BITS, capture: bool = True
) -> Codes:
    """Play a stream and read it back: nothing may be lost or differ. Return the codes that the DAC must have got."""
    decoded = stream.decode_integers()
    result = play(host, stream, PlaybackSettings(capture=capture))
    link.sleep(0.2)
    assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)
    expected, _ = render(stream.header, decoded, stream.delay_samples, actuator)
    if capture:
        np.testing.assert_array_equal(result.decoded, decoded)
        np.testing.assert_array_equal(result.dac_codes, expected)
    return expected
