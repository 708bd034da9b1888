"""A controller with little memory: sizes that are compiled in, the pool of coded packets, streams that do not fit.

The conformance suite states how it plays.
"""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.firmware.native import load
from tests.simulated_device.bench import Bench, stream
from vibrocast.codec import mdct
from vibrocast.device_protocol.messages import (
    PACKET_OVERHEAD_BYTES,
    CaptureData,
    CaptureRead,
    Configure,
    Error,
    ErrorCode,
    Hello,
    HelloResponse,
    Start,
    State,
    Status,
    StreamData,
    Tap,
    pack,
)

# A microcontroller with 128 KiB of memory: the STM32F405 has 64 KiB more.
BOARD = {
    "VC_CHANNELS": 2,
    "VC_MAX_CHANNELS": 2,
    "VC_BUFFER_SAMPLES": 4096,
    "VC_PACKET_SAMPLES": 2048,
    "VC_PROFILE_SAMPLES": 4096,
    "VC_BUFFER_PACKETS": 128,
    "VC_BUFFER_BYTES": 8192,
    "VC_CAPTURE_SAMPLES": 2048,
    "VC_MAX_PAYLOAD_BYTES": 1024,
    "VC_RATE_RATIO": 4,
}
PACKET_BYTES = BOARD["VC_MAX_PAYLOAD_BYTES"] - PACKET_OVERHEAD_BYTES


def board() -> Bench:
    return Bench(firmware=load(**BOARD))


def test_controller_of_a_small_board_fits_its_memory_and_says_its_limits() -> None:
    controller = board().controller
    # With pointers of eight bytes, where the board has four.
    print(f"{controller.memory_bytes} bytes of memory")
    assert controller.memory_bytes < 112 * 1024
    hello = board().ask(Hello())
    assert isinstance(hello, HelloResponse)
    limits = hello.limits
    assert (limits.channels, limits.buffer_samples, limits.capture_samples) == (2, 4096, 2048)
    assert (limits.max_payload_bytes, limits.max_packet_bytes) == (1024, PACKET_BYTES)
    assert limits.max_rate_hz == 4 * hello.actuator.dac_rate_hz


def test_stream_whose_packets_have_no_room_on_a_small_board_is_rejected() -> None:
    bench = board()
    bench.ask(Hello())
    long = replace(stream().header, samples=None, configuration=mdct.configuration(64, 33, [600]))
    answer = bench.ask(Configure(7, long.pack(), 0))
    assert isinstance(answer, Error) and answer.code == ErrorCode.BEYOND_LIMITS


def padded(packet: bytes, length: int) -> bytes:
    """Return a packet made longer: a decoder reads no further than it needs."""
    return packet + bytes(max(0, length - len(packet)))


@settings(max_examples=20, deadline=None)
@given(
    lengths=st.lists(st.integers(1, PACKET_BYTES), min_size=44, max_size=44)
    | st.just([PACKET_BYTES] * 44)
    | st.just([1] * 44),
    seed=st.integers(0, 99),
)
def test_what_credit_has_granted_always_has_room(lengths: list[int], seed: int) -> None:
    played = stream(2.0)
    assert len(played.packets) == len(lengths)
    order = np.random.default_rng(seed)
    bench = board()
    answer = bench.configure(played)
    assert isinstance(answer, Status)
    status = answer
    # As many of the longest packets as the pool holds.
    assert status.credit_until == BOARD["VC_BUFFER_BYTES"] // PACKET_BYTES * played.packet_samples
    unsent = list(range(len(played.packets)))

    def send_granted() -> None:
        nonlocal status
        while granted := [n for n in unsent if (n + 1) * played.packet_samples <= status.credit_until]:
            number = int(order.choice(granted))
            unsent.remove(number)
            packet = padded(played.packets[number], lengths[number])
            bench.send_payload(pack(StreamData(7, 0, (packet,))))
            before, status = status, bench.status()
            assert status.buffered_samples == before.buffered_samples + played.packet_samples
            assert status.credit_until >= before.credit_until

    send_granted()
    assert unsent  # the pool or the buffer is full
    assert isinstance(bench.ask(Start()), Status)
    while status.state != State.FINISHED:
        bench.run(10)
        status = bench.status()
        send_granted()
    assert (status.underruns, status.lost_packets) == (0, 0)
    kept = bench.ask(CaptureRead(Tap.DECODED, len(played.decoded) - 400, 400))
    assert isinstance(kept, CaptureData)
    assert kept.data == played.decoded[-400:].astype("<i2").tobytes()


def test_playing_begins_when_no_more_of_the_prebuffer_has_room() -> None:
    played = stream(2.0)
    bench = board()
    bench.configure(played, prebuffer_samples=BOARD["VC_BUFFER_SAMPLES"])
    bench.ask(Start())
    for number in range(8):
        bench.run(1)
        assert bench.status().state == State.ARMED
        packet = padded(played.packets[number], PACKET_BYTES)
        bench.send_payload(pack(StreamData(7, 0, (packet,))))
    bench.run(1)
    assert bench.status().state == State.PLAYING
