"""The codec `dct`: quantisers, threshold cut, entropy coders, the core against a second decoder, hostile bytes."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.fft import dct as reference_dct

from tests.codec.dct_reference_decoder import ReferenceDecoder
from tests.codec.signals import RATE_HZ, difference, edge_signals, in_turn, played, texture
from vibrocast import codec
from vibrocast.codec import CodecError, Decoder, Framing, Setting, Signal, SignalFormat, dct
from vibrocast.codec.dct import MAX_CODE, canonical_codes, code_lengths
from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.textures.generate import rough

EVERY_CODER = [(quantiser, entropy) for quantiser in ("linear", "log") for entropy in ("huffman", "range")]


def coded(signal: Signal, setting: Setting, unit: str = "m/s^2", live: bool = False) -> codec.Stream:
    return codec.encode(signal, RATE_HZ, setting, codec="dct", unit=unit, live=live)


def coefficients(signal: Signal, block: int = 512) -> Signal:
    """Orthonormal DCT-II of whole blocks of one channel: (blocks, block)."""
    padded = np.pad(signal[:, 0], (0, -len(signal) % block)).reshape(-1, block)
    return np.asarray(reference_dct(padded, axis=1, norm="ortho"))


def kept(signal: Signal, setting: Setting, unit: str = "m/s^2", block: int = 512) -> tuple[Signal, Signal]:
    """Coefficients before and after coding; the last block is whole."""
    signal = signal[: len(signal) // block * block]
    stream = coded(signal, {**setting, "block": str(block)}, unit)
    return coefficients(signal, block), coefficients(stream.decode(), block)


def sine(amplitude: float, frequency_hz: float, samples: int = 2048) -> Signal:
    """A cosine that fits blocks of 512 where 2 * 512 * F / 2800 is a whole number: (samples, 1)."""
    time_s = (np.arange(samples) + 0.5) / RATE_HZ
    return amplitude * np.cos(2 * np.pi * frequency_hz * time_s)[:, None]


@pytest.mark.parametrize(("quantiser", "entropy"), EVERY_CODER)
@pytest.mark.parametrize(("block", "levels", "channels"), [(64, 5, 1), (256, 14, 3), (1024, 4001, 1), (512, 65535, 1)])
def test_core_agrees_with_the_documented_decoder(
    quantiser: str, entropy: str, block: int, levels: int, channels: int
) -> None:
    setting: Setting = {"quantiser": quantiser, "entropy": entropy, "block": str(block), "levels": levels}
    signal = texture(1500, channels)
    signal[block : 2 * block, -1] = 0  # zero as a value of its own
    stream = codec.encode(signal, RATE_HZ, setting, codec="dct")
    reference = ReferenceDecoder(stream.header.configuration, channels)
    assert difference(reference, stream.packets, stream.decode_integers()) < 0.55


@pytest.mark.parametrize(("quantiser", "entropy"), EVERY_CODER)
def test_whole_transforms_agree_with_the_documented_decoder(quantiser: str, entropy: str) -> None:
    setting: Setting = {"quantiser": quantiser, "entropy": entropy, "block": "whole", "levels": 100}
    stream = codec.encode(texture(777, 2), RATE_HZ, setting, codec="dct")
    assert len(stream.packets) == 1
    # The roundings of 777 amplitudes add up, which the weights of shorter blocks keep small.
    reference = ReferenceDecoder(stream.header.configuration, 2)
    assert difference(reference, stream.packets, stream.decode_integers()) < 1


@pytest.mark.parametrize(
    ("samples", "transforms", "length"),
    [(1, 1, 64), (1001, 1, 1001), (20_001, 1, 20_001), (29_999, 1, 29_999), (30_001, 2, 15_001), (50_000, 2, 25_000)],
)
def test_a_file_is_one_transform_or_equal_ones_near_the_length_of_the_paper(
    samples: int, transforms: int, length: int
) -> None:
    heights = rough(seed=1, seconds=samples / 1e5, rate_hz=1e5).samples[:samples]
    stream = codec.encode(heights, 100_000, {"block": "whole", "levels": 200}, codec="dct", unit="um")
    assert len(stream.packets) == transforms
    assert codec.decoder(dct.IDENTIFIER, stream.header.configuration, 1).packet_samples == length
    assert stream.decode().shape == heights.shape
    assert all(len(packet) < 400 for packet in stream.packets), "160 coefficients lie below 400 Hz"


@pytest.mark.parametrize(("samples", "transforms"), [(640, 1), (1919, 1), (1921, 2), (6400, 5)])
def test_a_profile_over_position_is_cut_into_transforms_near_10_mm(samples: int, transforms: int) -> None:
    """A profile has a length, although its packets are those of a live stream."""
    heights = texture(samples)
    setting: Setting = {"block": "whole", "levels": 200}
    stream = codec.encode(heights, 128_000, setting, codec="dct", unit=PROFILE_UNIT, live=True)
    assert len(stream.packets) == transforms
    assert stream.decode().shape == heights.shape


def test_few_levels_that_raise_the_peak_clip_nothing() -> None:
    heights = rough(seed=1, seconds=0.2, rate_hz=1e5).samples
    stream = codec.encode(heights, 100_000, {"block": "whole", "levels": 4, "quantiser": "log"}, codec="dct", unit="um")
    peak = np.max(np.abs(stream.decode_integers().astype(int))) / 32768 * stream.header.gains[0]
    assert np.max(np.abs(heights)) < peak < stream.header.gains[0]


def test_the_greatest_coefficient_of_the_longest_transform_fits() -> None:
    """A cosine of full scale: its orthonormal coefficient would exceed the core's range."""
    heights = np.cos(np.pi * (np.arange(20_000)[:, None] + 0.5) * 40 / 20_000)
    stream = codec.encode(heights, 100_000, {"block": "whole", "levels": 5}, codec="dct", unit="um")
    assert (codec.snr_db(heights, stream.decode()) or 0) > 40


def test_whole_transforms_are_for_files_and_some_thousand_coefficients() -> None:
    for refused in (
        lambda: coded(texture(600), {"block": "whole"}, live=True),
        lambda: dct.DctEncoder(
            dct.CODEC.complete({"block": "whole"}), SignalFormat(RATE_HZ, "um", (1.0,), (0.5,)), Framing(64, 1)
        ),
    ):
        with pytest.raises(CodecError, match="choose a block of 64 to 1024"):
            refused()
    with pytest.raises(CodecError, match=r"3000 coefficients .* limit_hz of at most 477"):
        coded(texture(3000), {"block": "whole"})
    coded(texture(3000), {"block": "whole", "limit_hz": 477})


def test_damaged_whole_packets_are_rejected_and_concealed() -> None:
    stream = coded(texture(600), {"block": "whole"})
    decoder = codec.decoder(dct.IDENTIFIER, stream.header.configuration, 1)
    assert np.any(decoder.decode(stream.packets[0]))
    with pytest.raises(CodecError, match="damaged"):
        decoder.decode(stream.packets[0][:3])
    assert np.any(decoder.conceal())
    assert not np.any(decoder.conceal()[64:])


def test_a_least_magnitude_below_the_smallest_range_code() -> None:
    stream = coded(np.abs(texture(1500)), {"quantiser": "log", "smallest": 1e-12, "block": "64"})
    assert stream.header.configuration[-2:] == bytes(2)
    reference = ReferenceDecoder(stream.header.configuration, 1)
    assert difference(reference, stream.packets, stream.decode_integers()) < 0.55


@given(
    seed=st.integers(0, 99),
    samples=st.integers(1, 900),
    channels=st.integers(1, 3),
    levels=st.integers(4, 300) | st.integers(301, 65535),
    quantiser=st.sampled_from(["linear", "log"]),
    block=st.sampled_from(dct.BLOCKS),
    edge=st.sampled_from([None, *edge_signals()]),
)
@settings(max_examples=60)
def test_any_signal_at_any_setting(
    seed: int, samples: int, channels: int, levels: int, quantiser: str, block: int, edge: str | None
) -> None:
    """Both entropy coders decode to the same, and no coefficient is further from its own than the levels around it."""
    signal = texture(samples, channels, seed) if edge is None else edge_signals()[edge]
    setting: Setting = {"levels": levels, "quantiser": quantiser, "block": str(block)}
    streams = [coded(signal, {**setting, "entropy": entropy}) for entropy in ("huffman", "range")]
    decoded = streams[0].decode()
    np.testing.assert_array_equal(decoded, streams[1].decode())
    assert decoded.shape == signal.shape
    before, after = coefficients(signal, block), coefficients(decoded, block)
    if quantiser == "linear" and len(signal) % block == 0 and np.max(np.abs(decoded)) < 0.99:
        step = (max(float(np.max(before)), 0.0) - min(float(np.min(before)), 0.0)) / (levels - 1)
        # A range code widens the range by up to 2^(1/256); samples are rounded to 16 bits.
        assert np.max(np.abs(before - after)) <= 0.502 * step + math.sqrt(block) / 32768


@given(st.integers(4, 400) | st.integers(401, 65535), st.floats(0, 2e8), st.floats(1, 2e8))
@example(6, 1e6, 1e6)
def test_linear_levels_are_the_multiples_of_the_step_nearest_to_the_extremes(
    levels: int, below: float, above: float
) -> None:
    """Equation (2): multiples of (max C - min C) / (L - 1), in L levels, or L + 1 where both ends lie between two."""
    codes = dct.range_code(below), dct.range_code(above)
    lowest, highest = (min(round(2 ** (code / 256)), 2**28) if code else 0 for code in codes)
    assert lowest <= max(1, below) * 1.0028 + 0.5
    assert highest <= above * 1.0028 + 0.5
    step = (lowest + highest) / (levels - 1)
    reconstructed = dct.reconstruction_levels(False, levels, 0, *codes)
    assert reconstructed[0] == 0, "the value 0 is zero"
    counts = np.arange(len(reconstructed)) - np.count_nonzero(reconstructed < 0)
    if step >= 1:  # a step below the core's unit has levels that are equal
        np.testing.assert_allclose(np.sort(reconstructed), np.clip(counts * step, None, 2**28), atol=1, rtol=1e-4)
        assert np.max(reconstructed) >= min(highest - step / 2, 2**28) - 1
        assert np.min(reconstructed) <= -lowest + step / 2 + 1
    assert len(reconstructed) in ((levels, levels + 1) if lowest == highest and levels % 2 == 0 else (levels,))


@given(st.integers(4, 400), st.floats(2, 2e8), st.floats(2, 2e8), st.floats(1, 2e8))
def test_logarithmic_levels_rise_by_equal_factors_from_the_smallest(
    levels: int, below: float, above: float, smallest: float
) -> None:
    """The paper's: L / 2 levels on each side, L / 2 - 1 steps from S to the maximum; S is never above the maximum."""
    codes = [dct.range_code(magnitude) for magnitude in (smallest, below, above)]
    least, lowest, highest = (2 ** (code / 256) for code in codes)
    reconstructed = np.sort(dct.reconstruction_levels(True, levels, *codes))
    sides = (-reconstructed[: levels // 2][::-1], lowest), (reconstructed[levels // 2 :], highest)
    for magnitudes, top in sides:
        np.testing.assert_allclose(magnitudes, np.geomspace(min(least, top), top, len(magnitudes)), rtol=1e-5, atol=1)


@pytest.mark.parametrize(("quantiser", "entropy"), EVERY_CODER)
@given(
    quantiser_offsets=st.lists(st.integers(-60, 60) | st.integers(-300, 300), min_size=1, max_size=6),
    channels=st.integers(1, 2),
)
@settings(max_examples=8, deadline=None)
def test_core_agrees_with_the_documented_decoder_on_any_quantiser_offsets(
    quantiser: str, entropy: str, quantiser_offsets: list[int], channels: int
) -> None:
    setting = dct.CODEC.complete({"quantiser": quantiser, "entropy": entropy, "block": "64"})
    signal_format = SignalFormat(RATE_HZ, "full scale", (1.0,) * channels, (0.5,) * channels)
    encoder = dct.DctEncoder(setting, signal_format, Framing(128, 1), None, in_turn(quantiser_offsets))
    packets = encoder.encode(texture(600, channels)) + encoder.finish()
    reference = ReferenceDecoder(encoder.configuration, channels)
    samples = played(dct.make_decoder(encoder.configuration, channels), packets)
    assert difference(reference, packets, samples) < 0.55


def test_left_open_streams_are_huffman_coded_and_rate_controlled_ones_range_coded() -> None:
    """Rate-controlled, since Huffman's code of a bit a coefficient at least leaves low rates nothing but silence."""
    signal = texture(4096)
    assert coded(signal, {}) == coded(signal, {"entropy": "huffman"})
    policy, framing = codec.ConstantRate(500), Framing(2048, 2)
    source = codec.Source.of(signal, RATE_HZ, codec="dct", unit="m/s^2", live=True)
    stream = codec.encode_rate_controlled(source, {}, policy, framing)
    assert (codec.snr_db(signal, stream.decode()) or 0.0) > 1.0


def test_nothing_is_dropped_by_default() -> None:
    """A sine 30 dB below what is felt stays, and recordings keep all frequencies and their mean."""
    setting: Setting = {"levels": dct.MAX_LEVELS}
    for unit in ("full scale", "m/s^2"):
        assert (codec.snr_db(texture(4096) + 0.2, coded(texture(4096) + 0.2, setting, unit).decode()) or 0) > 70
    felt, unfelt = sine(20.0, 175.0), sine(0.3, 21.875)
    decoded = coded(felt + unfelt, setting, "um").decode()
    assert (codec.snr_db(unfelt, decoded - felt) or 0) > 40


def test_heights_lose_what_is_above_400_hz_and_recordings_do_not() -> None:
    """A DCT-II index k is k rate / (2 N): 2.73 Hz apart, index 146 is 399.2 Hz and 147 is 401.95 Hz."""
    noise = np.random.default_rng(1).standard_normal((2048, 1))
    setting: Setting = {"levels": dct.MAX_LEVELS}
    _, heights = kept(noise, setting, "um")
    assert np.max(np.abs(heights[:, :147])) > 1
    assert np.max(np.abs(heights[:, 147:])) < 1e-2
    _, everything = kept(noise, setting, "m/s^2")
    assert np.max(np.abs(everything[:, 147:])) > 1
    before, below_100 = kept(noise, {**setting, "limit_hz": 100, "dc": "drop"}, "m/s^2")
    np.testing.assert_allclose(below_100[:, 1:37], before[:, 1:37], atol=1e-2)
    assert np.max(np.abs(below_100[:, [0, *range(37, 512)]])) < 1e-2


def test_a_limit_that_leaves_nothing_is_rejected() -> None:
    with pytest.raises(CodecError, match=r"limit_hz of at least 2\.73"):
        coded(texture(600), {"limit_hz": 2, "dc": "drop"})
    coded(texture(600), {"limit_hz": 2.74, "dc": "drop"})


@pytest.mark.parametrize(("unit", "scale"), [("um", 1.0), ("m/s^2", 1e-6 * (2 * np.pi * 175) ** 2)])
def test_the_threshold_cuts_what_is_below_it(unit: str, scale: float) -> None:
    """At 175 Hz, index 64; the same displacement is cut or kept whichever unit states it."""
    felt_um = threshold_amplitude(read_threshold(), np.array([175.0]), "um")[0]
    for b0_db in (-8.0, 0.0, 12.0):
        setting: Setting = {"levels": dct.MAX_LEVELS, "threshold": "on", "b0_db": b0_db}
        for excess_db, stays in ((-0.5, False), (0.5, True)):
            amplitude = felt_um * scale * 10 ** ((b0_db + excess_db) / 20)
            decoded = coded(sine(amplitude, 175.0), setting, unit).decode()
            assert np.any(decoded) == stays


def test_another_threshold_takes_its_place(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("# Source: this test.\nfrequency_hz,threshold_db_re_1um_peak\n10,0\n1000,40\n")
    assert threshold_amplitude(read_threshold(path), np.array([1.0, 10, 100, 2000]), "um") == pytest.approx(
        [1, 1, 10, 100]
    )
    setting: Setting = {"threshold": str(path), "b0_db": 0.0}
    assert np.any(coded(sine(18.0, 175.0), setting, "um").decode())
    assert not np.any(coded(sine(10.0, 175.0), setting, "um").decode())


@pytest.mark.parametrize(
    "text", ["", "frequency_hz,level\n", "f,l\n10,1\n5,2\n", "f,l\n0,1\n", "f,l\n1,nan\n", "f\n1\n", "f,l\nx,y\n"]
)
def test_files_that_hold_no_threshold_are_rejected(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(CodecError, match="threshold"):
        coded(texture(600), {"threshold": str(path)})
    with pytest.raises(CodecError, match=r"missing\.csv"):
        coded(texture(600), {"threshold": str(tmp_path / "missing.csv")})


def test_a_threshold_needs_a_physical_unit() -> None:
    with pytest.raises(CodecError, match=r"`unit` and `full_scale`"):
        coded(texture(600), {"threshold": "on"}, "full scale")


LINEAR, LOG, RANGE = 32, 8, 16


def decoder_of(head: int, levels: int = 14, first: int = 0, end: int = 64, blocks: int = 1) -> Decoder:
    fields = b"".join(number.to_bytes(2, "little") for number in (blocks, levels, first, end))
    return dct.make_decoder(bytes((head,)) + fields + bytes(2 if head & LOG else 0), 1)


@given(head=st.integers(0, 63) | st.integers(0, 255), numbers=st.lists(st.integers(0, 2000), min_size=4, max_size=4))
def test_any_configuration_is_read_or_rejected(head: int, numbers: list[int]) -> None:
    blocks, levels, first, end = numbers
    size, samples = head & 7, blocks * (64 << (head & 7))
    fits = (levels == 0 or levels >= 4) and head < 64 and head & (LINEAR | LOG) in (LINEAR, LOG) and first < end
    if size == 7:
        fits, samples = fits and blocks >= 64 and end <= min(blocks, 1024), blocks
    else:
        fits = fits and size < 5 and 1 <= blocks <= 4095 and samples <= 2**18 and end <= 64 << size
    try:
        decoder = decoder_of(head, levels, first, end, blocks)
    except CodecError:
        assert not fits
    else:
        assert fits
        assert len(decoder.conceal()) == decoder.packet_samples == samples


def test_linear_streams_of_before_equation_2_are_rejected() -> None:
    """Their levels began at the least coefficient; the golden streams of logarithmic levels are as they were."""
    assert decoder_of(LINEAR).packet_samples == decoder_of(LOG).packet_samples == 64
    for head in (0, RANGE, LINEAR | LOG):
        with pytest.raises(CodecError, match="another version"):
            decoder_of(head)


@given(
    head=st.sampled_from([LINEAR, LOG, LINEAR | RANGE, LOG | RANGE, LINEAR | RANGE | 4, LOG | RANGE | 4]),
    levels=st.sampled_from([4, 5, 300, 65535]),
    ranges=st.binary(min_size=4, max_size=4) | st.just(b"\xff" * 4) | st.just(b"\x00\x10\x00\x10"),
    payloads=st.lists(st.binary(max_size=300), min_size=1, max_size=4),
)
@settings(max_examples=150)
def test_any_payload_decodes_safely(head: int, levels: int, ranges: bytes, payloads: list[bytes]) -> None:
    decoder = decoder_of(head, levels)
    for payload in payloads:
        try:
            samples = decoder.decode(b"\x01" + ranges + payload)
        except CodecError:
            assert not head & RANGE, "any bits are a meaning for the range decoder"
            samples = decoder.conceal()
        assert samples.shape == (64 << (head & 7), 1)


@given(
    damage=st.lists(st.tuples(st.integers(5, 400), st.integers(1, 255)), max_size=4),
    entropy=st.sampled_from(["huffman", "range"]),
)
def test_damage_stays_within_the_loudness_that_the_packet_states(damage: list[tuple[int, int]], entropy: str) -> None:
    """No coefficient is above the ranges: what their energy cannot give, a damaged packet cannot either."""
    stream = coded(0.01 * texture(512), {"entropy": entropy, "levels": 30}, live=True)
    packet = bytearray(stream.packets[0])
    for position, flip in damage:
        packet[position % (len(packet) - 5) + 5] ^= flip
    decoder = dct.make_decoder(stream.header.configuration, 1)
    try:
        samples = decoder.decode(bytes(packet))
    except CodecError:
        return
    peak = np.max(np.abs(coefficients(stream.decode()))) / stream.header.gains[0] * 32768
    assert np.sum(np.square(samples.astype(float))) <= 1.1 * 512 * peak**2


def bits(*parts: tuple[int, int]) -> bytes:
    """Numbers of these lengths in bits, joined."""
    text = "".join(f"{value:0{count}b}" for value, count in parts)
    return bytes(int(text[start : start + 8].ljust(8, "0"), 2) for start in range(0, len(text), 8))


RANGES = b"\x00\x10\x00\x10"
TABLES = {
    "of one symbol": ((0, 7), (1, 4)),
    "that holds too many codes": ((2, 7), (1, 4), (1, 4), (1, 4)),
    "that holds too few codes": ((2, 7), (2, 4), (2, 4), (2, 4)),
    "without any code": ((1, 7), (0, 4), (0, 4)),
    "of 128 symbols": ((127, 7), *((7, 4),) * 128),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_that_are_no_code_are_rejected(name: str) -> None:
    with pytest.raises(CodecError, match="damaged"):
        decoder_of(LINEAR).decode(b"\x01" + RANGES + bits(*TABLES[name]))
    with pytest.raises(CodecError, match="damaged"):
        decoder_of(LOG).decode(b"\x01" + RANGES + bits((0, 1), *TABLES[name]))


@pytest.mark.parametrize(
    ("levels", "packet"),
    [
        *((14, packet) for packet in (b"", b"\x00" + RANGES, b"\x01", b"\x01" + RANGES[:3], b"\x80" * 9)),
        *((0, packet) for packet in (b"\x01\xe7" + RANGES, b"\x01\xff" + RANGES, b"\x01", b"\x01\xe6" + RANGES[:3])),
    ],
)
def test_packets_without_head_levels_or_ranges_are_rejected(levels: int, packet: bytes) -> None:
    decoder = decoder_of(LINEAR | RANGE, levels)
    assert decoder.decode(b"\x01" + (b"" if levels else b"\xe6") + RANGES).shape == (64, 1)
    with pytest.raises(CodecError, match="damaged"):
        decoder.decode(packet)


@given(st.lists(st.integers(0, 10_000), min_size=2, max_size=120).filter(any))
def test_huffman_codes_are_complete_and_near_the_entropy(counts: list[int]) -> None:
    """Within a bit of the entropy (Huffman 1952), unless that one bit is all that a code can have."""
    lengths = code_lengths(counts)
    assert sum(2.0**-length for length in lengths if length) == 1
    total = sum(counts)
    entropy = -sum(count * math.log2(count / total) for count in counts if count)
    assert entropy - 1e-6 <= sum(map(int.__mul__, counts, lengths)) <= entropy + total
    codes = {f"{code:0{length}b}" for code, length in zip(canonical_codes(lengths), lengths, strict=True) if length}
    assert len(codes) == sum(length > 0 for length in lengths)
    assert not any(long != short and long.startswith(short) for long in codes for short in codes)


def test_huffman_codes_are_never_too_long() -> None:
    counts = [1, 1]
    while len(counts) < 40:
        counts.append(counts[-1] + counts[-2])
    assert max(code_lengths(counts)) == MAX_CODE


@given(st.lists(st.integers(0, 65_536), min_size=1))
def test_symbols_and_low_bits_give_the_value_back(values: list[int]) -> None:
    symbols, low_bits = dct.symbols_of(np.array(values))
    assert np.all(symbols < 120)
    for value, symbol, count in zip(values, symbols.tolist(), low_bits.tolist(), strict=True):
        assert value == symbol if symbol < 16 else value >> count == 8 + symbol % 8 and count == symbol // 8 - 1
