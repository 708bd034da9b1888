"""Decoders in Python behind the controller in C: a codec of another package, and what callbacks raise."""

from typing import Any

import numpy as np
import pytest

from tests.simulated_device.bench import RATE_HZ, Bench, Stream, stream
from vibrocast import codec
from vibrocast.codec import plugins, registry
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.messages import Configure, Error, ErrorCode, Hello, HelloResponse, Start, State, Tap
from vibrocast.output.actuator import Codes
from vibrocast.simulated_device.controller import Controller


class Coarse:
    name, summary, block_samples, qualities = "coarse", "samples of 8 bits", 16, (1.0,)

    def encode(self, samples: Any, quality: float) -> bytes:
        return bytes(np.rint(samples * 127).astype(np.int8))

    def decode(self, data: bytes, samples: int, channels: int, quality: float) -> Any:
        return np.frombuffer(data, np.int8).reshape(samples, channels) / 128


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> Stream:
    """Register the codec of another package; return a stream of it."""
    monkeypatch.setattr(registry, "CODECS", registry.Codecs())
    monkeypatch.setattr(codec, "CODECS", registry.CODECS)
    registry.CODECS.add(codec.as_codec(Coarse()))
    signal = np.random.default_rng(2).uniform(-1, 1, (1000, 2))
    coded = codec.encode(signal, RATE_HZ, {"quality": 1}, codec="coarse", live=True)
    header = StreamHeader(plugins.IDENTIFIER, RATE_HZ, 1000, "um", coded.header.gains, coded.header.configuration)
    decoder = codec.decoder(plugins.IDENTIFIER, coded.header.configuration, 2)
    return Stream(header, coded.packets, coded.decode_integers(), decoder.packet_samples, decoder.delay_samples)


def test_codec_of_another_package_plays_and_conceals_what_is_lost(coarse: Stream) -> None:
    bench = Bench()
    hello = bench.ask(Hello())
    assert isinstance(hello, HelloResponse)
    assert (plugins.IDENTIFIER, "coarse") in hello.codecs
    bench.configure(coarse, loops=2)
    packets = len(coarse.packets)
    bench.send(coarse, range(packets))
    bench.send(coarse, range(1, packets), iteration=1)
    bench.ask(Start())
    bench.run(1000)
    status = bench.status()
    assert (status.state, status.lost_packets) == (State.FINISHED, 1)
    captured = bench.captured(Tap.DECODED)
    np.testing.assert_array_equal(captured[: len(coarse.decoded)], coarse.decoded)
    # Each iteration begins with a fresh decoder, which has no last sound to fade out.
    silent = coarse.packet_samples
    assert not captured[len(coarse.decoded) :][:silent].any()
    np.testing.assert_array_equal(captured[len(coarse.decoded) :][silent:], coarse.decoded[silent:])


def test_packet_that_its_codec_cannot_decode_counts_as_lost(coarse: Stream) -> None:
    bench = Bench()
    cut = Stream(coarse.header, (coarse.packets[0][:-1], *coarse.packets[1:]), coarse.decoded, coarse.packet_samples, 0)
    bench.start_all(cut)
    bench.run(700)
    assert (bench.status().state, bench.status().lost_packets) == (State.FINISHED, 1)


def test_stream_of_a_codec_that_is_not_installed_is_rejected_by_its_name(
    coarse: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "CODECS", registry.Codecs())
    monkeypatch.setattr(codec, "CODECS", registry.CODECS)
    bench = Bench()
    bench.ask(Hello())
    answer = bench.ask(Configure(7, coarse.header.pack(), 0))
    assert isinstance(answer, Error)
    assert answer.code == ErrorCode.UNKNOWN_CODEC
    assert "install the package that brings it" in answer.text
    assert "coarse" in answer.text


def test_the_receiver_of_codes_may_raise() -> None:
    def fail(codes: Codes) -> None:
        raise ZeroDivisionError

    bench = Bench()
    bench.controller = Controller(on_dac=fail)
    bench.start_all(stream())
    with pytest.raises(ZeroDivisionError):
        bench.run(100)
