"""The costs of codecs: times by a clock of the test itself, delay as streamed, memory, shipped sizes of decoders."""

import sys
from collections.abc import Iterator
from itertools import repeat

import numpy as np
import pytest

from tests.codec.eva_models import tiny_model
from vibrocast import codec
from vibrocast.codec import Framing, SignalFormat, timing
from vibrocast.evaluation import cost
from vibrocast.models import Model

MODELS = {"eva": tiny_model()}


def test_times_are_of_a_million_samples_and_the_median_of_runs_but_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock stands still but for the work, and is read in steps of 1 ms."""
    now_s = 0.0

    def time_s(encoding: Iterator[float], decoding_s: float, samples: int) -> tuple[float, float]:
        def work(seconds: float) -> float:
            nonlocal now_s
            now_s += seconds
            return decoding_s

        return timing.time_coding(lambda: work(next(encoding)), work, samples, repeats=3)

    monkeypatch.setattr("time.process_time", lambda: round(now_s, 3))
    assert time_s(iter([9.0, 1.0, 7.0, 3.0]), 0.5, 2_000_000) == (1.5, 0.25)
    assert time_s(repeat(2e-5), 4e-4, 1_000_000) == pytest.approx((2e-5, 4e-4), rel=0.1)


@pytest.mark.parametrize("name", list(codec.CODECS))
def test_delay_is_the_longest_that_a_sample_waits(name: str) -> None:
    """Fed one sample at a time: what has come in by the time that a sample can be played."""
    with pytest.raises(codec.CodecError, match="no codec"):
        cost.delay_ms("none", {}, 2800)
    rate_hz = 2800
    plug_in = codec.CODECS[name]
    model = MODELS.get(name)
    signal_format = SignalFormat(rate_hz, "full scale", (1.0,), (0.3,))
    encoder = plug_in.make_encoder(plug_in.complete({}), signal_format, Framing(1, 1), model, None)
    packets = longest = 0
    for fed, value in enumerate(np.random.default_rng(0).normal(0, 0.3, 6 * encoder.packet_samples), 1):
        longest = max(longest, fed - packets * encoder.packet_samples + encoder.delay_samples)
        packets += len(encoder.encode(np.array([[value]])))
    assert 1e3 * longest / rate_hz == pytest.approx(cost.delay_ms(name, {}, rate_hz, model=model))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not tell")
def test_memory_is_that_of_coding_alone() -> None:
    """Not that of the process which asks: 160 MB more in this one would hide what a child adds, were it inherited."""
    ballast = np.ones(20_000_000)
    added = cost.peak_memory_bytes("mdct")
    decoded_bytes = 8 * cost.MEMORY_SECONDS * cost.MEMORY_RATE_HZ
    assert added is not None and decoded_bytes <= added < ballast.nbytes


def test_costs_of_a_codec_that_fails_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def peak_memory_bytes(name: str, model: Model | None) -> int:
        if name == "broken":
            raise codec.CodecError("no such library")
        return 7

    monkeypatch.setattr(cost, "peak_memory_bytes", peak_memory_bytes)
    broken, mdct = cost.measure_costs({"broken": ("broken", []), "mdct": ("mdct", [])})
    assert (broken.decoder_bytes, broken.peak_memory_bytes) == (None, None)
    assert broken.note == "decoder not counted; memory not measured: no such library"
    assert (mdct.codec, mdct.decoder_bytes, mdct.peak_memory_bytes) == ("mdct", cost.decoder_size("mdct").bytes, 7)
    assert "Cortex-M4" in mdct.note
