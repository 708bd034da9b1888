"""Duties of every codec: take any signal, state its packets, survive damage and loss, control its rate, and play."""

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.eva_models import model_with, tiny_model
from tests.codec.signals import RATE_HZ, edge_signals, in_turn, played, texture
from vibrocast import codec, textures
from vibrocast.codec import CodecError, Decoder, Framing, Signal
from vibrocast.codec.core import CoreDecoder
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.interface import Choice, Encoder, RateControl, Trial
from vibrocast.codec.rotation import COMMON, OWN, Rotation
from vibrocast.codec.source import Source
from vibrocast.host import playback, uploader
from vibrocast.host.controller import Controller
from vibrocast.host.devices import session_with
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.memory_link import MemoryLink

every_codec = pytest.mark.parametrize("name", list(codec.CODECS))
waveform_codec = pytest.mark.parametrize("name", [name for name, known in codec.CODECS.items() if known.keeps_waveform])
RATE_CONTROLLED = [name for name, known in codec.CODECS.items() if known.controls_rate]
every_rate_controlled_codec = pytest.mark.parametrize("name", RATE_CONTROLLED)
RATE_POINTS = {rate_point_set: name for name, known in codec.CODECS.items() for rate_point_set in known.rate_point_sets}


# Codecs without built-in tables need a model.
MODELS = {"eva": tiny_model()}


def tables_of(name: str) -> bytes | None:
    return MODELS[name].tables if name in MODELS else None


def middle_setting(name: str) -> codec.Setting:
    rate_point_set = codec.CODECS[name].rate_points
    return rate_point_set[len(rate_point_set) // 2]


def coded(name: str, signal: Signal, live: bool = False, setting: codec.Setting | None = None) -> codec.Stream:
    chosen = setting or middle_setting(name)
    return codec.encode(signal, RATE_HZ, chosen, codec=name, unit="um", live=live, model=MODELS.get(name))


FRAMING = Framing(128, 5)


def encoder_of(
    name: str,
    signal: Signal,
    rate_control: RateControl | None = None,
    setting: codec.Setting | None = None,
    framing: Framing = FRAMING,
) -> Encoder:
    rms = tuple(float(np.sqrt(np.mean(channel**2))) or 1.0 for channel in signal.T)
    signal_format = codec.SignalFormat(RATE_HZ, "full scale", (1.0,) * signal.shape[1], rms)
    complete = codec.CODECS[name].complete({**middle_setting(name), **(setting or {})})
    return codec.CODECS[name].make_encoder(complete, signal_format, framing, MODELS.get(name), rate_control)


@dataclass(frozen=True)
class Case:
    """A codec at a setting. `rises`: samples after a gap until its samples are those of a stream without one."""

    name: str
    rises: int
    setting: codec.Setting = field(default_factory=dict)
    channels: int = 1
    runtime: str = "core"

    def encoder(self, signal: Signal, steered: bool = False) -> Encoder:
        """Return an encoder of packets of 128 samples; if `steered`, at quantiser offsets that differ."""
        return encoder_of(self.name, signal, in_turn([-20, 5, 33, 7, 7, 60, -3]) if steered else None, self.setting)

    def decoder(self, configuration: bytes) -> Decoder:
        identifier = codec.CODECS[self.name].identifier
        return codec.decoder(identifier, configuration, self.channels, tables_of(self.name), self.runtime)

    @property
    def unlike(self) -> int:
        """By how much samples may differ: ONNX Runtime may sum in another order."""
        return int(self.runtime == "onnx")


ROTATION = Rotation((0, 11, 3), (COMMON, OWN, COMMON, 0), (5, 20, 33), ((7, 8, 9),)).pack().hex()
CASES = {
    "mdct": Case("mdct", 32),
    "mdct, rotated": Case("mdct", 32 + 11, {"rotation": ROTATION}, 3),
    "dct": Case("dct", 64, {"block": "64"}),
    "slp": Case("slp", 64),
    "eva": Case("eva", 56),
    "eva by ONNX Runtime": Case("eva", 56, runtime="onnx"),
}
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@cache
def live_stream(name: str) -> tuple[bytes, list[bytes], codec.Decoded]:
    """Return the configuration of a case, 40 packets, and what they decode to."""
    case = CASES[name]
    signal = texture(40 * 128 - 64, case.channels)
    encoder = case.encoder(signal)
    packets = [*encoder.encode(signal), *encoder.finish()][:40]
    return encoder.configuration, packets, played(case.decoder(encoder.configuration), packets).astype(int)


def check_decoded(samples: codec.Decoded, decoder: Decoder) -> None:
    assert samples.shape == (decoder.packet_samples, decoder.channels)
    assert samples.dtype == np.int16


def test_names_and_numbers_are_their_own() -> None:
    identifiers = [known.identifier for known in codec.CODECS.values()]
    assert len(set(identifiers)) == len(identifiers)
    assert all(1 <= identifier <= 15 for identifier in identifiers)
    assert len(RATE_POINTS) == sum(len(known.rate_point_sets) for known in codec.CODECS.values())


@pytest.mark.parametrize("rate_point_set", RATE_POINTS)
def test_the_top_of_a_rate_point_set_is_better_than_its_bottom_and_takes_more(rate_point_set: str) -> None:
    known = codec.CODECS[RATE_POINTS[rate_point_set]]
    rate_points = known.rate_point_sets[rate_point_set].settings
    assert all(known.checked(rate_point) == rate_point for rate_point in rate_points)
    signal = 20 * texture(2800)
    streams = [coded(known.name, signal, setting=rate_point) for rate_point in (rate_points[0], rate_points[-1])]
    sizes = [sum(map(len, stream.packets)) for stream in streams]
    assert len(rate_points) == 1 or sizes[1] > sizes[0]
    if known.keeps_waveform and len(rate_points) > 1:
        worst_db, best_db = (codec.snr_db(signal, stream.decode()) or 0.0 for stream in streams)
        assert best_db > worst_db


@every_codec
@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("signal_name", edge_signals())
def test_edge_inputs_are_decoded(name: str, live: bool, signal_name: str) -> None:
    signal = edge_signals()[signal_name]
    stream = coded(name, signal, live)
    decoder = stream.decoder()
    assert len(stream.packets) == -(-(len(signal) + decoder.delay_samples) // decoder.packet_samples)
    decoded = stream.decode()
    assert decoded.shape == signal.shape
    assert np.all(np.isfinite(decoded))
    assert np.max(np.abs(decoded)) <= 2 * np.max(np.abs(signal)) + 1e-4  # where G.723.1 is never quite silent


@every_codec
def test_channels_are_kept_apart(name: str) -> None:
    signal = np.hstack([texture(2800), np.zeros((2800, 1)), texture(2800, seed=5)])
    decoded = coded(name, signal).decode()
    assert not np.any(np.abs(decoded[:, 1]) > 1e-3)
    if codec.CODECS[name].keeps_waveform:
        snrs_db = codec.channel_snrs_db(signal, decoded)
        assert all(snr_db is None or snr_db > 1 for snr_db in snrs_db)
    np.testing.assert_allclose(np.std(decoded, axis=0), np.std(signal, axis=0), rtol=0.3, atol=1e-3)


@every_codec
@given(samples=st.integers(1, 900), channels=st.integers(1, 3), seed=st.integers(0, 99), live=st.booleans())
@settings(max_examples=10)
def test_any_length_has_just_the_packets_that_hold_it(
    name: str, samples: int, channels: int, seed: int, live: bool
) -> None:
    stream = coded(name, texture(samples, channels, seed), live)
    decoder = stream.decoder()
    assert len(stream.packets) == -(-(samples + decoder.delay_samples) // decoder.packet_samples)
    assert stream.decode().shape == (samples, channels)


@pytest.mark.parametrize("steered", [False, True])
@pytest.mark.parametrize("name", [name for name in CASES if "ONNX" not in name] + ["parametric"])
@given(seed=st.integers(0, 3), lengths=st.lists(st.integers(1, 400), min_size=1, max_size=8))
@settings(max_examples=12, deadline=None)
def test_packets_do_not_depend_on_how_samples_arrive(name: str, steered: bool, seed: int, lengths: list[int]) -> None:
    case = CASES.get(name) or Case(name, 0)
    steered = steered and codec.CODECS[case.name].controls_rate
    signal = texture(sum(lengths), case.channels, seed)
    one, other = (case.encoder(signal, steered) for _ in range(2))
    whole = one.encode(signal) + one.finish()
    packets = [packet for part in np.split(signal, np.cumsum(lengths)[:-1]) for packet in other.encode(part)]
    assert packets + other.finish() == whole
    assert one.configuration == other.configuration


@pytest.mark.parametrize("name", CASES)
@given(lost=st.sets(st.integers(0, 39), max_size=39))
@settings(max_examples=25, deadline=None)
def test_a_lost_packet_costs_at_most_the_time_to_the_next_refresh(name: str, lost: set[int]) -> None:
    """From some samples after the refresh on, the samples are those of a stream without a gap."""
    case, (configuration, packets, clean) = CASES[name], live_stream(name)
    decoder = case.decoder(configuration)
    playing = True
    for index, packet in enumerate(packets):
        part = (decoder.conceal() if index in lost else decoder.decode(packet)).astype(int)
        before, playing = playing, index not in lost and (playing or bool(packet[0] & 1))
        if playing:
            rises = 0 if before else case.rises
            expected = clean[index * 128 : (index + 1) * 128]
            np.testing.assert_allclose(part[rises:], expected[rises:], rtol=0, atol=case.unlike)
        assert np.max(np.abs(part)) <= 4 * np.max(np.abs(clean))


@pytest.mark.parametrize("steered", [False, True])
@every_case
def test_decoding_that_begins_at_a_refresh_gives_the_same_samples(case: Case, steered: bool) -> None:
    """The noise in place of zeros and the quantiser offset are the same, too."""
    signal = texture(3000, case.channels)
    encoder = case.encoder(signal, steered)
    packets = encoder.encode(signal)
    whole, late = (played(case.decoder(encoder.configuration), part).astype(int) for part in (packets, packets[10:]))
    np.testing.assert_allclose(late[case.rises :], whole[1280 + case.rises :], rtol=0, atol=case.unlike)


@pytest.mark.parametrize("name", [name for name in CASES if name != "dct"])
def test_a_packet_out_of_order_is_not_played(name: str) -> None:
    configuration, packets, _ = live_stream(name)
    decoder = CASES[name].decoder(configuration)
    assert not np.any(decoder.decode(packets[1])), "the first packet must be a refresh"
    for index in (0, 3, 4):
        decoder.decode(packets[index])
    assert not np.any(decoder.decode(packets[6]))


@every_codec
def test_lengths_of_packets_that_no_stream_has_are_rejected(name: str) -> None:
    for samples in (0, 2**25):
        with pytest.raises(CodecError, match="are not possible"):
            encoder_of(name, texture(100), framing=Framing(samples, 1))


FINEST: list[tuple[str, codec.Setting]] = [
    ("mdct", {"step": 2.0**-17}),
    ("dct", {"levels": 65_535, "entropy": "huffman"}),
    ("dct", {"levels": 65_535, "entropy": "range"}),
    ("slp", {"quality": 31, "order": 0}),
]


@pytest.mark.parametrize(("name", "setting"), FINEST)
def test_a_packet_that_does_not_fit_is_rejected(name: str, setting: codec.Setting) -> None:
    noise = np.random.default_rng(1).uniform(-1, 1, (2**14, 16))
    with pytest.raises(CodecError, match="shorter packets"):
        encoder_of(name, noise, setting=setting, framing=Framing(2**14, 0)).encode(noise)


@every_codec
@given(data=st.data())
@settings(max_examples=20)
def test_damaged_packets_decode_safely(name: str, data: st.DataObject) -> None:
    stream = coded(name, texture(1500), live=True)
    decoder = stream.decoder()
    for packet in stream.packets:
        damaged = bytearray(packet)
        for _ in range(data.draw(st.integers(0, 3))):
            damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
        shortened = bytes(damaged[: data.draw(st.integers(0, len(damaged)))])
        try:
            samples = decoder.decode(shortened)
        except CodecError:
            samples = decoder.conceal()
        check_decoded(samples, decoder)


@every_codec
@given(packets=st.lists(st.binary(max_size=300), max_size=6), channels=st.sampled_from([1, 2, 16]))
@settings(max_examples=40, deadline=None)
def test_any_bytes_decode_safely(name: str, packets: list[bytes], channels: int) -> None:
    """At the coarsest steps, where they are the loudest."""
    coarsest = codec.CODECS[name].rate_points[0]
    decoder = coded(name, np.sign(texture(300, channels)), live=True, setting=coarsest).decoder()
    for packet in [b"\x01", *packets, *(b"\x01" + packet for packet in packets)]:
        try:
            check_decoded(decoder.decode(packet), decoder)
        except CodecError:
            check_decoded(decoder.conceal(), decoder)


@every_codec
@given(configuration=st.binary(max_size=40), channels=st.integers(-1, 20))
@settings(max_examples=60)
def test_any_configuration_is_read_or_rejected(name: str, configuration: bytes, channels: int) -> None:
    try:
        decoder = codec.decoder(codec.CODECS[name].identifier, configuration, channels, tables_of(name))
    except CodecError:
        return
    assert decoder.packet_samples >= 1
    assert decoder.packet_samples * channels <= 2**24
    check_decoded(decoder.conceal(), decoder)


@every_codec
def test_a_gap_fades_and_a_refresh_ends_it(name: str) -> None:
    """Loss is heard as a fade to silence and a rise, never as a step beyond those of the signal."""
    signal = texture(14_000)
    stream = coded(name, signal, live=True)
    clean = stream.decode_integers().astype(int)
    decoder = stream.decoder()
    count = len(stream.packets)
    lost = {count // 3, count // 3 + 1}
    heard = np.concatenate(
        [decoder.conceal() if index in lost else decoder.decode(packet) for index, packet in enumerate(stream.packets)]
    ).astype(int)
    start = min(lost) * decoder.packet_samples
    np.testing.assert_array_equal(heard[:start], clean[:start])
    assert np.max(np.abs(np.diff(heard, axis=0))) <= 1.5 * np.max(np.abs(np.diff(clean, axis=0)))
    before, fading = heard[:start], heard[start : start + decoder.packet_samples]
    assert np.any(fading)
    assert np.std(fading[-len(fading) // 4 :]) < 0.5 * np.std(before[-decoder.packet_samples :])
    silent = heard[start + decoder.packet_samples : (max(lost) + 1) * decoder.packet_samples]
    assert not np.any(silent[len(silent) // 2 :])
    assert np.any(heard[(max(lost) + 1) * decoder.packet_samples :])
    end = slice(-2000, None)
    assert (codec.snr_db(clean[end].astype(float), heard[end].astype(float)) or math.inf) > 10


@pytest.mark.parametrize("runtime", codec.RUNTIMES)
@pytest.mark.parametrize("name", ["mdct", "dct", "slp", "eva", "parametric"])
def test_a_copied_decoder_goes_on_by_itself(name: str, runtime: str) -> None:
    stream = coded(name, texture(3000, 2), live=True)
    identifier = codec.codec_by_name(name).identifier
    untouched, copied = (
        codec.decoder(identifier, stream.header.configuration, 2, tables_of(name), runtime) for _ in range(2)
    )
    assert isinstance(copied, CoreDecoder)
    for packet in stream.packets[:7]:
        np.testing.assert_array_equal(copied.decode(packet), untouched.decode(packet))
    twin = copy(copied)
    copied.conceal()
    for packet in stream.packets[7:]:
        np.testing.assert_array_equal(twin.decode(packet), untouched.decode(packet))


@every_codec
def test_bad_signals_and_settings_are_rejected(name: str) -> None:
    for signal in (
        *(np.zeros(shape) for shape in ((0, 1), (100,), (10, 0), (10, 17))),
        *(np.full((100, 1), number) for number in (math.nan, math.inf)),
    ):
        with pytest.raises(CodecError):
            codec.encode(signal, RATE_HZ, middle_setting(name), codec=name, model=MODELS.get(name))
    with pytest.raises(CodecError, match="no parameter softness"):
        codec.encode(texture(100), RATE_HZ, {"softness": 1.0}, codec=name, model=MODELS.get(name))
    for parameter, described in codec.CODECS[name].parameters.items():
        assert described.checked(parameter, described.default) == described.default
        numbers = (math.nan, math.inf, described.low - 1) if described.fractional else ()
        for value in ("\x00 nothing of the kind", *numbers):
            with pytest.raises(CodecError, match=parameter):
                codec.encode(texture(100), RATE_HZ, {parameter: value}, codec=name, model=MODELS.get(name))
        if not described.per_channel:
            with pytest.raises(CodecError, match=parameter):
                codec.encode(texture(100, 2), RATE_HZ, {parameter: (14, 16)}, codec=name, model=MODELS.get(name))


@every_codec
def test_tables_are_rejected_where_none_are_taken(name: str) -> None:
    with pytest.raises(CodecError, match=r"image|tables"):
        codec.encode(texture(100), RATE_HZ, middle_setting(name), codec=name, model=model_with(bytes(10)))


@every_codec
def test_a_controller_plays_what_was_decoded_here(name: str) -> None:
    recording = textures.Recording(20 * texture(2000, 2), 2800.0, "um", "texture")
    encoding = encode_recording(
        recording, codec_name=name, setting=middle_setting(name), live=True, model=MODELS.get(name)
    )
    link = MemoryLink(SimulatedController())
    controller = Controller(link, link.clock, link.sleep)
    if encoding.stream.image is not None:
        uploader.flash(controller, encoding.stream.image)
    report = playback.play(session_with(controller, "memory"), "texture", encoding.stream, encoding, loops=2).report
    assert report.codec == name
    assert report.underruns == report.lost_packets == 0
    assert report.decoded_equals_offline is True
    assert report.dac_equals_offline is True


@waveform_codec
def test_a_quality_is_met_from_above_or_rejected(name: str) -> None:
    recording = textures.Recording(texture(2800), 2800.0, "um", "texture")
    try:
        encoding = encode_recording(recording, codec_name=name, snr_db=8.0, model=MODELS.get(name))
    except CodecError as error:
        assert "cannot be met" in str(error) or not codec.CODECS[name].parameters
        return
    assert encoding.quality.snr_db is not None
    assert encoding.quality.snr_db >= 8.0 - codec.SNR_TOLERANCE_DB
    assert (encoding.quality.note is None) == (abs(encoding.quality.snr_db - 8.0) <= codec.SNR_TOLERANCE_DB)


RATE_POINT_CODECS = [
    name
    for name, known in codec.CODECS.items()
    if known.parameters
    and known.keeps_waveform
    and not any(known.parameters[varied].fractional for varied in middle_setting(name))
]


@pytest.mark.parametrize("target_db", [3.0, 12.0])
@pytest.mark.parametrize("name", RATE_POINT_CODECS)
def test_a_search_finds_the_best_rate_point_without_trying_all(
    name: str, target_db: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal = texture(1400)
    rate_points = codec.CODECS[name].rate_points
    coded_by_rate_point = [
        codec.encode(signal, RATE_HZ, rate_point, codec=name, model=MODELS.get(name)) for rate_point in rate_points
    ]
    snrs_db = [codec.snr_db(signal, each.decode()) or 0.0 for each in coded_by_rate_point]
    trials: list[codec.Setting] = []
    encode = Source.encode

    def counted(source: Source, setting: codec.Setting) -> codec.Stream:
        trials.append(setting)
        return encode(source, setting)

    monkeypatch.setattr(Source, "encode", counted)
    enough = [snr_db for snr_db in snrs_db if snr_db >= target_db - codec.SNR_TOLERANCE_DB]
    if not enough:
        with pytest.raises(CodecError, match=f"reaches {max(snrs_db):.1f} dB"):
            codec.encode_to_snr(codec.Source.of(signal, RATE_HZ, codec=name, model=MODELS.get(name)), target_db)
        return
    found = codec.encode_to_snr(codec.Source.of(signal, RATE_HZ, codec=name, model=MODELS.get(name)), target_db)
    nearest = min(
        range(len(rate_points)),
        key=lambda rate_point: (snrs_db[rate_point] not in enough, abs(snrs_db[rate_point] - target_db)),
    )
    assert found.packets == coded_by_rate_point[nearest].packets
    assert len(trials) <= min(len(rate_points), 12)


def steered(name: str, signal: Signal, rate_control: RateControl) -> tuple[Encoder, list[bytes]]:
    encoder = encoder_of(name, signal, rate_control)
    return encoder, encoder.encode(signal) + encoder.finish()


def decoded(name: str, encoder: Encoder, packets: list[bytes], channels: int) -> codec.Decoded:
    return played(Case(name, 0, channels=channels).decoder(encoder.configuration), packets)


def at_places(places: list[int], min_bytes: int = 0) -> RateControl:
    """Choose the quantiser offsets at these places, in 1/64 of all that can be chosen, one after the other."""
    count = 0

    def rate_control(trial: Trial) -> Choice:
        nonlocal count
        count += 1
        place = places[count % len(places)] * (len(trial.quantiser_offsets) - 1) // 64
        return Choice(trial.quantiser_offsets[place], min_bytes)

    return rate_control


@every_rate_controlled_codec
def test_trials_change_no_state_and_equal_the_coded_packet(name: str) -> None:
    signal = texture(2000, 2)
    choose = at_places([20, 25, 40, 22])
    packets: list[bytes] = []
    previous = 0

    def rate_control(trial: Trial) -> Choice:
        nonlocal previous
        assert trial.previous == previous
        choice = choose(trial)
        sizes = [len(trial.packet(quantiser_offset)) for quantiser_offset in trial.quantiser_offsets[::40]]
        assert sizes[-1] <= sizes[0]
        packets.append(trial.packet(choice.quantiser_offset))
        previous = choice.quantiser_offset
        return choice

    assert steered(name, signal, rate_control)[1] == packets
    assert steered(name, signal, at_places([20, 25, 40, 22]))[1] == packets


@every_rate_controlled_codec
def test_coarser_takes_fewer_bytes_and_errs_more(name: str) -> None:
    signal = texture(2800)
    results = []
    for place in range(0, 65, 8):
        encoder, packets = steered(name, signal, at_places([place]))
        heard = decoded(name, encoder, packets, 1)[encoder.delay_samples :][: len(signal)] / 32768
        results.append((sum(map(len, packets)), float(np.sqrt(np.mean((heard - signal) ** 2)))))
    sizes, errors = np.array(results).T
    assert np.all(np.diff(sizes) <= 0.02 * sizes[:-1])
    assert sizes[-1] < 0.5 * sizes[0]
    assert errors[-1] > 3 * errors[0]


@every_rate_controlled_codec
def test_the_samples_of_a_trial_are_what_its_packet_stands_for(name: str) -> None:
    wanted: list[Signal] = []

    def finest(trial: Trial) -> Choice:
        wanted.append(trial.samples)
        return Choice(trial.quantiser_offsets[0])

    signal = texture(2000, 2)
    encoder, packets = steered(name, signal, finest)
    assert {part.shape for part in wanted} == {(encoder.packet_samples, 2)}
    heard = decoded(name, encoder, packets, 2) / 32768
    expected = np.concatenate(wanted)
    assert (codec.snr_db(expected[:2000], heard[:2000]) or 0) > 5
    delayed = np.concatenate([np.zeros((encoder.delay_samples, 2)), signal])
    np.testing.assert_allclose(expected[: len(delayed)], delayed[: len(expected)], atol=1e-3)


@every_rate_controlled_codec
@given(places=st.lists(st.integers(0, 64), min_size=1, max_size=6), padding=st.integers(0, 300))
@settings(max_examples=6)
def test_padding_changes_nothing_but_the_length(name: str, places: list[int], padding: int) -> None:
    signal = texture(900, 2)
    encoder, packets = steered(name, signal, at_places(places))
    _, padded = steered(name, signal, at_places(places, padding))
    assert [len(packet) for packet in padded] == [max(len(packet), padding) for packet in packets]
    assert all(long.rstrip(b"\0") == short.rstrip(b"\0") for long, short in zip(padded, packets, strict=True))
    np.testing.assert_array_equal(decoded(name, encoder, padded, 2), decoded(name, encoder, packets, 2))


@every_rate_controlled_codec
@pytest.mark.parametrize(
    "choose",
    [
        lambda trial: Choice(trial.quantiser_offsets[0] - 1),
        lambda trial: Choice(trial.quantiser_offsets[-1] + 1),
        lambda trial: Choice(0, 65_536),
        lambda trial: Choice(0, len(trial.packet(trial.quantiser_offsets[-1] + 1))),
    ],
)
def test_choices_that_no_packet_can_have_are_rejected(name: str, choose: Callable[[Trial], Choice]) -> None:
    with pytest.raises(CodecError, match=r"it must choose|; choose"):
        steered(name, texture(1000), choose)
