"""The rotation of channels of `mdct`: core against documentation, damage, the encoder's choice."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vibrocast
from tests.codec.reference_decoder import ReferenceDecoder
from tests.codec.signals import RATE_HZ, difference, played, texture
from vibrocast import codec, textures
from vibrocast.codec import Choice, CodecError, Framing, core, mdct
from vibrocast.codec.rotation import BANDS, COMMON, OWN, Rotation, angles_of, matrix
from vibrocast.codec.stream import Stream


@st.composite
def rotations(draw: st.DrawFn) -> Rotation:
    count = draw(st.integers(2, 5))
    delays = draw(st.lists(st.integers(0, 63), min_size=count - 1, max_size=count - 1))
    states = draw(st.lists(st.integers(0, OWN), min_size=BANDS, max_size=BANDS).filter(any))
    pairs = count * (count - 1) // 2
    angles = st.tuples(*[st.integers(0, 63)] * pairs)
    common = draw(angles) if COMMON in states else ()
    return Rotation((*delays, 0), tuple(states), common, tuple(draw(angles) for _ in range(states.count(OWN))))


def moving_together(samples: int, channels: int, delay: int = 0, noise: float = 0.05) -> codec.Signal:
    """Return a texture that reaches each channel `delay` samples later; each has noise of its own."""
    drive = texture(samples + delay * channels, 1)[:, 0]
    starts = [delay * (channels - 1 - channel) for channel in range(channels)]
    wave = np.stack([drive[start : start + samples] for start in starts], axis=1)
    own: codec.Signal = wave + noise * texture(samples, channels, seed=7)
    return own


def decoded(configuration: bytes, packets: list[bytes], channels: int) -> codec.Decoded:
    return played(mdct.MdctDecoder(configuration, channels), packets)


@given(rotations())
def test_a_section_is_read_as_written(rotation: Rotation) -> None:
    assert Rotation.unpack(rotation.pack(), rotation.channels) == rotation


@given(st.binary(max_size=30), st.integers(1, 5))
def test_core_and_package_agree_on_every_section(section: bytes, channels: int) -> None:
    configuration = mdct.configuration(32, 4, [500] * channels)
    try:
        expected = Rotation.unpack(section, channels)
    except CodecError:
        with pytest.raises(CodecError):
            mdct.MdctDecoder(configuration + b"\x02" + section, channels)
        return
    decoder = mdct.MdctDecoder(configuration + b"\x02" + section, channels)
    assert decoder.delay_samples == 32 + expected.delay_samples


@given(rotations(), st.integers(0, 7), st.booleans())
def test_damaged_sections_are_rejected(rotation: Rotation, state: int, rate_controlled: bool) -> None:
    section, channels = rotation.pack(), rotation.channels
    plain = mdct.configuration(32, 4, [500] * channels)
    features = bytes((2 | rate_controlled,))
    mdct.MdctDecoder(plain + features + section, channels)
    for wrong in (section[:-1], section + b"\0"):
        with pytest.raises(CodecError, match="configuration"):
            mdct.MdctDecoder(plain + features + wrong, channels)
        with pytest.raises(CodecError, match="rotation"):
            Rotation.unpack(wrong, channels)
    for flags in (0, 4 | features[0], 0x80 | features[0]):
        with pytest.raises(CodecError, match="configuration"):
            mdct.MdctDecoder(plain + bytes((flags,)) + section, channels)


@pytest.mark.parametrize("flaw", ["no band", "unknown state", "needless delay", "padding"])
def test_inconsistent_sections_are_rejected(flaw: str) -> None:
    states = {"no band": (0, 0, 0, 0), "unknown state": (1, 3, 0, 0)}.get(flaw, (1, 0, 0, 0))
    delays = (1, 2) if flaw == "needless delay" else (0, 2)
    section = Rotation(delays, states, (9,) if any(states) else (), ()).pack()
    if flaw == "padding":
        section = section[:-1] + bytes((section[-1] | 1,))
    with pytest.raises(CodecError):
        Rotation.unpack(section, 2)
    with pytest.raises(CodecError):
        mdct.MdctDecoder(mdct.configuration(32, 4, [500] * 2) + b"\x02" + section, 2)


@given(st.integers(2, 8), st.integers(0, 1000))
@settings(max_examples=40)
def test_angles_come_near_any_orthogonal_matrix(channels: int, seed: int) -> None:
    """To the rounding of the angles, and but for the signs of columns; the matrix itself is orthogonal."""
    target = np.linalg.qr(np.random.default_rng(seed).standard_normal((channels, channels)))[0]
    found = matrix(angles_of(target), channels)
    np.testing.assert_allclose(found.T @ found, np.eye(channels), atol=1e-12)
    likeness = np.abs(np.sum(found * target, axis=0))
    assert likeness.min() > 1 - 0.01 * channels


@given(
    rotations(), st.sampled_from(core.HOPS), st.booleans(), st.sampled_from([None, (0, 1.5, 1.2, 1.2, 2.9, 5.2, 5.2)])
)
@settings(max_examples=25, deadline=None)
def test_core_agrees_with_the_documented_decoder(
    rotation: Rotation, hop: int, rate_controlled: bool, shape: tuple[float, ...] | None
) -> None:
    channels = rotation.channels
    offsets = itertools.cycle([0, -8, 20, 4])
    encoder = mdct.MdctEncoder(
        [0.05 * 1.5**channel for channel in range(channels)],
        RATE_HZ,
        Framing(2 * hop, 3),
        hop=hop,
        rotation=rotation,
        shape=shape,
        noise_filling=1 / 8,
        rate_control=(lambda trial: Choice(next(offsets))) if rate_controlled else None,
    )
    packets = encoder.encode(texture(300, channels)) + encoder.finish()
    reference = ReferenceDecoder(encoder.configuration, channels, mdct.built_in_tables())
    assert difference(reference, packets, decoded(encoder.configuration, packets, channels)) < 0.6


@given(rotations(), st.sampled_from(core.HOPS))
@settings(max_examples=25, deadline=None)
def test_any_rotation_keeps_the_signal(rotation: Rotation, hop: int) -> None:
    """The decoder turns back what the encoder turned, delays included; each channel's error is that of its own step."""
    signal = 0.5 * texture(700, rotation.channels)
    encoder = mdct.MdctEncoder([0.002] * rotation.channels, RATE_HZ, Framing(512, 0), hop=hop, rotation=rotation)
    packets = encoder.encode(signal) + encoder.finish()
    samples = decoded(encoder.configuration, packets, rotation.channels) / 32768
    error = samples[encoder.delay_samples :][: len(signal)] - signal
    assert np.max(np.sqrt(np.mean(np.square(error), axis=0))) < 0.002


def test_shorter_packets_hold_the_same_signal() -> None:
    signal = moving_together(4000, 3, delay=3)
    setting = {"step": 0.2, "noise_filling": 0}
    stream = codec.encode(signal, RATE_HZ, setting)
    short = stream.repacked(256)
    assert short.packet_samples <= 256
    np.testing.assert_array_equal(short.decode(), stream.decode())
    assert Stream.from_bytes(bytes(short)) == short


@pytest.mark.parametrize(("channels", "delay"), [(2, 0), (2, 9), (4, 4), (8, 8)])
def test_a_wave_takes_much_less_than_its_channels(channels: int, delay: int) -> None:
    """About the bits of one channel, at the same quality in each."""
    signal = moving_together(8000, channels, delay, noise=0.01)
    source = codec.Source.of(signal, RATE_HZ)
    stream = codec.encode_to_snr(source, 12.0)
    plain = codec.encode_to_snr(source, 12.0, {"rotation": "none"})
    assert stream.size_bytes < (1 / channels + 0.12) * plain.size_bytes
    rotation = Rotation.unpack(bytes.fromhex(str(source.resolved({})["rotation"])), channels)
    assert rotation.delays == tuple(delay * channel for channel in range(channels))
    assert stream.delay_samples - plain.delay_samples == delay * (channels - 1)


@pytest.mark.parametrize("channels", [2, 4, 16])
def test_unrelated_channels_lose_next_to_nothing(channels: int) -> None:
    signal = np.hstack([texture(5600, 1, seed) for seed in range(channels)])
    sizes = [
        codec.encode(signal, RATE_HZ, {"step": 0.3, "rotation": rotation}).size_bytes for rotation in ("auto", "none")
    ]
    assert sizes[0] <= 1.005 * sizes[1]


def test_sixteen_channels_fit_a_stream() -> None:
    signal = moving_together(3000, 16, 2)
    stream = codec.encode(signal, RATE_HZ, {"step": 0.5})
    plain = codec.encode(signal, RATE_HZ, {"step": 0.5, "rotation": "none"})
    assert stream.size_bytes < 0.4 * plain.size_bytes
    assert np.array_equal(Stream.from_bytes(bytes(stream)).decode(), stream.decode())


def test_a_live_stream_has_the_rotation_that_you_give() -> None:
    signal = moving_together(3000, 2)
    rotation = Rotation((0, 0), (COMMON,) * 4, (48,), ()).pack().hex()
    sizes = {
        given: sum(map(len, codec.encode(signal, RATE_HZ, {"step": 0.3, "rotation": given}, live=True).packets))
        for given in ("auto", "none", rotation)
    }
    assert sizes["auto"] == sizes["none"]
    assert sizes[rotation] < 0.75 * sizes["none"]


@pytest.mark.parametrize(
    ("text", "channels"),
    [
        *((text, 2) for text in ("some", "zz", "00", "f" * 400)),
        (Rotation((0, 0), (COMMON,) * 4, (48,), ()).pack().hex(), 1),
    ],
)
def test_a_rotation_that_is_none_is_rejected(text: str, channels: int) -> None:
    with pytest.raises(CodecError, match="rotation"):
        codec.encode(texture(500, channels), RATE_HZ, {"step": 0.5, "rotation": text})


def test_the_simulated_controller_plays_a_rotated_stream() -> None:
    recording = textures.from_array(moving_together(5600, 2, 4), RATE_HZ, "m/s^2")
    stream = vibrocast.encode(recording.samples, rate_hz=RATE_HZ, unit="m/s^2", snr_db=12)
    assert stream.delay_samples % 16 == 4, "it has the delays of the wave"
    with vibrocast.connect("sim") as controller:
        report = controller.play(stream)
    assert report.decoded_equals_offline


def test_a_silent_channel_between_others_stays_silent() -> None:
    signal = np.insert(moving_together(3000, 2), 1, 0.0, axis=1)
    source = codec.Source.of(signal, RATE_HZ)
    assert source.resolved({})["rotation"] != "none"
    assert not np.any(source.encode({"step": 0.5}).decode()[:, 1])


@pytest.mark.parametrize("samples", [1, 40, 94, 95, 200])
def test_a_signal_shorter_than_a_block_is_coded(samples: int) -> None:
    signal = moving_together(samples, 3)
    coded_signal = codec.encode(signal, RATE_HZ, {"step": 0.1})
    assert coded_signal.decode().shape == signal.shape
