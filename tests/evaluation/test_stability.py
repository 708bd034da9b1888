"""Tests of the stability maps: rules of outcomes, trials that raise, crash or hang, every map, the page."""

import csv
import dataclasses
import math
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.colors import to_rgb

from tests.codec.eva_models import tiny_model
from vibrocast import codec
from vibrocast.codec.interface import Codec, Decoded
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.errors import InputError
from vibrocast.evaluation.cli import stability_page
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.evaluation.stability import (
    actuators,
    entropy,
    filters,
    float_parity,
    hand_speed,
    learned_signals,
    maps,
    model_images,
    page,
    peers,
    pictures,
    rate_point_sets,
    recordings,
    signals,
    transport,
)
from vibrocast.evaluation.stability import all_maps as report
from vibrocast.evaluation.stability.all_maps import MAPS
from vibrocast.evaluation.stability.cell_files import read_cells, write_cells
from vibrocast.evaluation.stability.known_causes import explanation, known_causes
from vibrocast.evaluation.stability.maps import Map, RatePoint, Scope, methods
from vibrocast.evaluation.stability.transport import CLEAR_ERRORS
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict, attempt, run
from vibrocast.host.cli.command_line import main
from vibrocast.output.actuator import LRA, PIEZO_STACK
from vibrocast.textures import Recording, save
from vibrocast.textures.generate import wood

MDCT = codec.CODECS["mdct"]
STEP = RatePoint("mdct", {"step": 0.25})
TINY = tiny_model()
QUICK = Scope(methods(["mdct", "dct", "slp", "eva"], [TINY]), quick=True, recordings=(wood(0, 0.5),))
LEARNED = RatePoint("eva", {"level": 2.0}, TINY)


def hold() -> Measured:
    return Measured(Outcome.HOLDS, {"snr_db": 12.345678})


def reject() -> Measured:
    raise codec.CodecError("too loud;\nturn it down")


def stumble() -> Measured:
    raise ZeroDivisionError("oh")


def hang() -> Measured:
    while True:
        pass


def wait() -> Measured:
    time.sleep(1.5)
    return hold()


def trial(measure: object, to_be_rejected: bool = False) -> Trial:
    return Trial("signals", "fake", "a case", "low: ", None, measure, to_be_rejected)  # type: ignore[arg-type]


def cell(outcome: Outcome, case: str = "a case", value: float | None = None, method: str = "fake") -> Verdict:
    return Verdict("signals", method, case, "low: step=1", value, outcome, {"snr_db": 3.0, "bits": None}, "an effect")


def test_what_happens_in_a_trial_is_its_outcome() -> None:
    assert attempt(trial(hold)).figures == {"snr_db": 12.3457}
    rejected = attempt(trial(reject))
    assert (rejected.outcome, rejected.effect, rejected.sound) == (Outcome.REJECTED, "too loud; turn it down", False)
    crashed = attempt(trial(stumble))
    assert (crashed.outcome, crashed.effect) == (Outcome.FAILS, "CRASH: ZeroDivisionError: oh")
    assert explanation(crashed).remedy == "Report it"


def test_what_must_be_rejected_is_sound_only_then() -> None:
    assert attempt(trial(reject, to_be_rejected=True)).sound
    accepted = attempt(trial(hold, to_be_rejected=True))
    assert (accepted.outcome, accepted.sound) == (Outcome.FAILS, False)
    assert "must be rejected" in accepted.effect


@pytest.mark.slow
def test_a_trial_that_hangs_costs_only_its_cell() -> None:
    told: list[float] = []
    cells = run([trial(hang), trial(reject), trial(wait)], 1.0, lambda part, _: told.append(part))
    # A busy machine that keeps a trial waiting does not end it.
    assert [each.outcome for each in cells] == [Outcome.FAILS, Outcome.REJECTED, Outcome.HOLDS]
    assert "longer than 1 s" in cells[0].effect
    assert told[-1] == 1.0


def fake(decode: object) -> Codec:
    """Return mdct with a decoder whose samples go through `decode`."""

    class Decoder:
        def __init__(self, configuration: bytes, channels: int, tables: bytes | None) -> None:
            self._decoder = MDCT.make_decoder(configuration, channels, tables)
            self.channels, self.packet_samples = channels, self._decoder.packet_samples
            self.delay_samples = self._decoder.delay_samples

        def decode(self, packet: bytes) -> Decoded:
            samples: Decoded = decode(self._decoder.decode(packet))  # type: ignore[operator]
            return samples

        def conceal(self) -> Decoded:
            return self._decoder.conceal()

    return dataclasses.replace(MDCT, make_decoder=Decoder)


def raising(samples: Decoded) -> Decoded:
    raise IndexError("no such bin")


@pytest.mark.parametrize(
    ("decode", "outcome"),
    [
        (lambda samples: samples, Outcome.HOLDS),
        (lambda samples: -samples, Outcome.FAILS),
        (lambda samples: 0 * samples, Outcome.DEGRADED),
        (raising, Outcome.FAILS),
    ],
)
def test_a_codec_that_returns_garbage_is_classified_so(
    decode: object, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codec.registry, "BUILT_IN", {"mdct": fake(decode)})
    monkeypatch.setattr(signals, "texture_snr_db", lambda rate_point: 17.0)
    measured = attempt(trial(partial(signals.measure, STEP, "texture")))
    assert measured.outcome is outcome
    assert measured.effect.startswith("CRASH: IndexError") == (decode is raising)


SINE = 0.5 * np.sin(np.arange(1000)).reshape(-1, 1)


@pytest.mark.parametrize(
    ("heard", "texture_snr_db", "outcome"),
    [
        (SINE, 20.0, Outcome.HOLDS),
        (1.1 * SINE, 25.0, Outcome.HOLDS),
        (1.1 * SINE, 30.0, Outcome.DEGRADED),
        (1.9 * SINE, 5.0, Outcome.DEGRADED),
        (2.1 * SINE, 5.0, Outcome.FAILS),
        (0.05 * SINE, 5.0, Outcome.DEGRADED),
        (-0.1 * SINE, 5.0, Outcome.FAILS),
        (-0.001 * SINE, 5.0, Outcome.DEGRADED),
        (np.where(SINE > 0.49, np.nan, SINE), 5.0, Outcome.FAILS),
        (1.001 * SINE, 90.0, Outcome.HOLDS),
    ],
)
def test_rules_for_signals(heard: np.ndarray, texture_snr_db: float, outcome: Outcome) -> None:
    assert signals.judge(SINE, heard, texture_snr_db).outcome is outcome


@pytest.mark.parametrize(("peak", "outcome"), [(0, Outcome.HOLDS), (1e-3, Outcome.DEGRADED), (0.02, Outcome.FAILS)])
def test_rules_for_silence(peak: float, outcome: Outcome) -> None:
    assert signals.judge(0 * SINE, 2 * peak * SINE, 20.0).outcome is outcome


def test_conditions_are_what_their_names_say() -> None:
    made = {name: condition.make() for name, condition in signals.CONDITIONS.items()}
    assert made["texture on 16 channels"].shape == (5600, 16)
    assert made["texture at 1000 Hz"].shape == (2000, 1)
    assert len(made["31 samples"]) == 31
    assert len(np.unique(made["texture of 4 bits"])) <= 16
    assert np.isnan(made["a NaN"]).sum() == 1
    quiet = made["texture 60 dB below a click"][signals.CONDITIONS["texture 60 dB below a click"].judged_from :]
    assert np.abs(quiet).max() == pytest.approx(1e-3, rel=0.2)


@pytest.mark.parametrize("name", signals.DRIFTING)
def test_an_offset_or_a_drift_is_far_greater_than_the_texture_and_counts_not(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, texture = signals.CONDITIONS[name].make(), signals.texture()
    assert np.std(made - texture) > 3 * np.std(texture) or np.mean(made - texture) > 9
    np.testing.assert_allclose(signals.tactile_part(made), signals.tactile_part(texture), atol=0.02)
    # Whether the offset comes through or is left out before coding, a good codec holds.
    for heard in (made, texture):
        monkeypatch.setattr(signals, "decoded", lambda *_, heard=heard: (heard, coding_stub()))
        monkeypatch.setattr(signals, "texture_snr_db", lambda rate_point: 12.0)
        assert signals.measure(STEP, name).outcome is Outcome.HOLDS
    monkeypatch.setattr(signals, "decoded", lambda *_: (made - texture, coding_stub()))
    assert signals.measure(STEP, name).outcome is Outcome.DEGRADED


@pytest.mark.parametrize("name", signals.DRIFTING)
def test_a_high_pass_before_coding_is_the_remedy(name: str) -> None:
    rate_point = RatePoint("mdct", {"step": 0.5})
    assert attempt(trial(partial(signals.measure, rate_point, name))).outcome is not Outcome.HOLDS
    assert attempt(trial(partial(signals.measure, rate_point, f"{name}, high-passed"))).outcome is Outcome.HOLDS


def coding_stub() -> object:
    return type("Stream", (), {"size_bytes": 100})()


def test_recordings_of_ones_own_are_a_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "run", lambda trials, progress: [attempt(made) for made in trials])
    (tmp_path / "own" / "deep").mkdir(parents=True)
    save(tmp_path / "own" / "deep" / "plank.wav", wood(3, 0.5, rate_hz=8000))
    save(tmp_path / "own" / "silent.wav", Recording(np.zeros((900, 1)), 1000.0, "um", "silent"))
    (tmp_path / "own" / "bare.csv").write_text("1\n2\n")
    (tmp_path / "own" / "notes.md").touch()
    arguments = ["--out", str(tmp_path / "out"), "--codecs", "flac", "--maps", "recordings"]
    result = CliRunner().invoke(main, ["stability", *arguments, "--recordings", str(tmp_path / "own")])
    assert result.exit_code == 0, result.output
    assert "skipped 1 file: notes.md" in result.stderr and "left out: bare: " in result.stderr
    with (tmp_path / "out" / "stability" / "recordings.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["case"] for row in rows} == {"deep/plank", "silent"} and len(rows) == 6
    assert {row["outcome"] for row in rows} == {"holds"}
    assert "## Your recordings" in (tmp_path / "out" / "stability.md").read_text()
    assert recordings.RECORDINGS.trials(Scope(methods(["mdct"], ()), quick=False)) == []


def test_pre_echo_falls_with_a_finer_setting() -> None:
    coarse, fine = (signals.measure_onset(RatePoint("mdct", {"step": step})) for step in (0.5, 0.01))
    assert coarse.figures["pre_echo_5ms_db"] > fine.figures["pre_echo_5ms_db"]  # type: ignore[operator]
    assert (coarse.outcome, fine.outcome) == (Outcome.DEGRADED, Outcome.HOLDS)


def test_an_hour_is_measured_by_its_last_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "HOUR_S", 120)
    assert signals.measure_hour(RatePoint("flac", {})).outcome is Outcome.HOLDS


def test_a_fall_on_the_way_up_a_rate_point_set_is_marked() -> None:
    snrs_db = [1.0, 5.0, 4.0, 4.95, 7.0, math.nan]
    cells = [dataclasses.replace(cell(Outcome.HOLDS), figures={"snr_db": each}) for each in snrs_db]
    judged = rate_point_sets.falls(cells)
    assert [each.outcome.letter for each in judged] == list("HHDHHH")
    assert judged[2].effect == "SNR 4.0 dB, 1.0 dB less than at a coarser setting"
    assert [each.outcome.letter for each in rate_point_sets.near_best(cells[:5])] == list("DHHHH")
    assert [each.outcome.letter for each in rate_point_sets.half_left(cells[:2])] == list("DH")


@pytest.fixture
def played_once(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(transport, "LOOPS", 1)
    transport._stream.cache_clear()
    yield
    transport._stream.cache_clear()


def test_rules_for_playbacks() -> None:
    wanted = np.round(1000 * np.sin(np.arange(1000) / 5)).reshape(-1, 1)
    assert transport.rate_codes(wanted, wanted, 0, 0, 0).outcome is Outcome.HOLDS
    for half_periods, outcome in ((2, Outcome.HOLDS), (20, Outcome.DEGRADED), (50, Outcome.FAILS)):
        lost = wanted * (np.arange(1000)[:, None] > half_periods * np.pi * 5)
        measured = transport.rate_codes(wanted, lost, 1, 2, 0)
        assert measured.outcome is outcome
        assert measured.figures["off_share"] == pytest.approx(half_periods * np.pi / 200, abs=0.01)
    click = wanted.copy()
    click[500] = 3000
    assert transport.rate_codes(wanted, click, 0, 0, 0).outcome is Outcome.FAILS
    assert transport.rate_codes(wanted, wanted[:100], 0, 0, 0).outcome is Outcome.FAILS


@pytest.mark.usefixtures("played_once")
def test_a_longer_stall_than_the_buffer_is_heard_and_a_shorter_is_not() -> None:
    short, long = (transport.measure(STEP, transport.LinkFaults(stall_s=stall_s), 0.3) for stall_s in (0.05, 1.0))
    assert (short.outcome, short.figures["off_share"]) == (Outcome.HOLDS, 0)
    assert long.figures["underruns"] > 0  # type: ignore[operator]


def test_speed_of_the_hand_matters_to_what_is_cut_at_one_speed() -> None:
    rate_point = RatePoint("dct", {"levels": 320})
    slow, coded, fast = (hand_speed.measure(rate_point, "sandpaper", speed) for speed in (25.0, 50.0, 100.0))
    assert slow.outcome is Outcome.FAILS
    assert coded.outcome is fast.outcome is Outcome.HOLDS
    assert slow.figures["upper_octave_level_db"] < -10  # type: ignore[operator]


def test_only_the_direct_form_is_unstable_at_few_bits() -> None:
    assert filters.measure("direct form", 12, 5).outcome is Outcome.FAILS
    assert filters.measure("reflection coefficients", 12, 5).outcome is Outcome.HOLDS


def test_what_entropy_coding_costs_beyond_the_entropy() -> None:
    assert entropy.judge(1.1, 1.0).outcome is Outcome.HOLDS
    assert entropy.judge(2.0, 1.0).outcome is Outcome.DEGRADED
    assert entropy.judge(4.0, 0.0).outcome is Outcome.FAILS
    assert entropy.needed_bits(np.array([1.0, -1.0, 1.0, -1.0]), 4) == 1.0
    floor = entropy.measure("huffman", "all the same").figures["bits_per_sample"]
    assert floor is not None and 1.0 <= floor < 1.2


def test_a_source_with_its_own_pace_runs_dry_by_the_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "PACED_S", 4.0)
    assert transport.measure_paced(STEP, -10_000).outcome is Outcome.HOLDS
    late = transport.measure_paced(STEP, 50_000)
    assert late.outcome is not Outcome.HOLDS
    # 0.1 s at one part in twenty.
    assert late.figures["first_underrun_s"] == pytest.approx(2, abs=1)


def test_a_trained_model_is_tested_like_a_codec() -> None:
    assert [method.name for method in QUICK.learned] == ["tiny"]
    assert signals.measure(LEARNED, "texture").outcome is Outcome.HOLDS
    assert RatePoint("eva", {"level": 2.0}, tiny_model()) == LEARNED != RatePoint("eva", {"level": 2.5}, TINY)
    assert hash(RatePoint("eva", {"level": 2.0}, tiny_model())) == hash(LEARNED)


@pytest.mark.usefixtures("played_once")
def test_a_controller_with_the_model_plays_it_and_one_without_rejects() -> None:
    assert transport.measure(LEARNED, transport.LinkFaults()).outcome is Outcome.HOLDS
    for image in (None, dataclasses.replace(ModelImage.unpack(TINY.image), version="another").pack()):
        tried = trial(partial(model_images.measure_on_controller, LEARNED, image), to_be_rejected=True)
        rejected = attempt(dataclasses.replace(tried, clear_errors=CLEAR_ERRORS))
        assert rejected.sound and "does not run here" in rejected.effect


def test_a_wrong_or_damaged_image_is_rejected_while_something_vouches_for_it() -> None:
    for measure in (model_images.measure_crc, model_images.measure_hash, model_images.measure_missing):
        assert attempt(trial(partial(measure, LEARNED), to_be_rejected=True)).sound
    assert attempt(trial(partial(model_images.measure_cut, LEARNED, 90.0), to_be_rejected=True)).sound
    outcomes = {
        attempt(trial(partial(model_images.measure_changed, LEARNED, runtime, percent))).outcome
        for runtime in codec.RUNTIMES
        for percent in (0.0, 1.0, 45.0, 99.0)
    }
    assert Outcome.FAILS not in outcomes and Outcome.REJECTED in outcomes


def test_what_a_model_needs_beyond_mdct_is_measured_in_bits() -> None:
    rate_point_set = [RatePoint("mdct", {"step": 2 ** (exponent / 2)}) for exponent in range(4, -14, -1)]
    same = learned_signals.measure_kind(rate_point_set, "wood")
    assert same.outcome is Outcome.HOLDS
    assert same.figures["ratio"] == pytest.approx(1.0)
    coarse = learned_signals.measure_kind(rate_point_set[:2], "wood")
    assert (coarse.outcome, coarse.effect) == (Outcome.FAILS, "10 dB are not reached")


def test_a_quiet_passage_is_measured_alone() -> None:
    alike, quieter = (learned_signals.measure_quiet(LEARNED, quieter_db) for quieter_db in (0.0, 60.0))
    assert alike.outcome is Outcome.HOLDS
    assert quieter.outcome is not Outcome.HOLDS


def test_a_wrong_level_costs_quality_in_either_runtime() -> None:
    for runtime in codec.RUNTIMES:
        right, wrong = (
            learned_signals.measure_level(RatePoint("eva", {"level": level}, TINY), runtime, "texture")
            for level in (1.0, 0.001)
        )
        assert right.outcome is Outcome.HOLDS
        assert wrong.figures["snr_db"] < right.figures["snr_db"] - 3  # type: ignore[operator]


def test_the_same_graph_run_otherwise_gives_nearly_the_same() -> None:
    for measure in (float_parity.measure_analysis, float_parity.measure_synthesis):
        for way in ("no optimisation", "in pieces"):
            assert measure(LEARNED, way).outcome is Outcome.HOLDS
    values = np.ones((1, 2, 3), np.float32)
    assert float_parity._judged(values, values + np.float32(1e-4), {}).outcome is Outcome.DEGRADED
    assert float_parity.measure_core(LEARNED).outcome is Outcome.HOLDS


def test_a_sharper_resonance_bears_less_shift() -> None:
    lra = LRA
    assert actuators.measure_shift(lra, 0).outcome is Outcome.HOLDS
    errors_db = [
        actuators.measure_shift(dataclasses.replace(lra, quality=quality), 5).figures["error_db"]
        for quality in (2.0, 30.0)
    ]
    assert errors_db[0] < errors_db[1]  # type: ignore[operator]


def test_the_inverse_filter_asks_for_more_than_the_voltage_at_high_frequencies() -> None:
    low, high = (actuators.measure_sine(PIEZO_STACK, frequency_hz, 40, True) for frequency_hz in (50, 400))
    assert low.outcome is Outcome.HOLDS
    assert high.outcome is not Outcome.HOLDS
    assert low.figures["clipped_share"] < high.figures["clipped_share"]  # type: ignore[operator]


PEERS_CSV = """input,codec,setting,status,SNR_dB,maxabs_out,finite
silence,one,a,ok,nan,0.0,True
silence,one,b,ok,nan,0.5,True
dc,one,a,ok,20,0.5,True
dc,one,b,ok,1.5,0.9,True
dc,two,a,ok,-2,0.9,True
len1,two,a,RuntimeError: rc=-11 /some/where,,,
len2,two,a,RuntimeError: rc=1 /some/where: no samples,,,
"""


def test_peers_are_measured_and_no_paths_of_theirs_are_kept(tmp_path: Path) -> None:
    file = tmp_path / "edge.csv"
    file.write_text(PEERS_CSV)
    cells = peers.read_peers(file)
    assert [each.outcome.letter for each in cells] == list("HFHDFFR")
    assert not any("/some" in each.effect for each in cells)


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", PEERS_CSV.replace("20,0.5", "x,0.5"), "\0"])
def test_other_files_are_no_peers(text: str, tmp_path: Path) -> None:
    file = tmp_path / "edge.csv"
    file.write_text(text)
    with pytest.raises(InputError):
        peers.read_peers(file)


def test_ranges_join_neighbours_only() -> None:
    assert maps.ranges([0.1, 0.2, 1.0], [0.0, 0.1, 0.2, 0.5, 1.0]) == "0.1 to 0.2, 1"


def test_no_more_than_some_cases_are_named_and_the_others_counted() -> None:
    cells = [cell(Outcome.FAILS, f"case {number}") for number in range(9)]
    assert page.boundary(signals.SIGNALS, cells[:3], cells) == "fails: case 0, case 1, case 2"
    assert page.boundary(signals.SIGNALS, cells[:4], cells) == "fails: case 0, case 1, 2 more"
    assert page.boundary(signals.SIGNALS, cells[:5], cells) == "fails: 5 of 9 cases"


LETTERS = {outcome.letter: outcome for outcome in Outcome}


def losses(outcomes: dict[str, str]) -> list[Verdict]:
    """Return cells of the map of lost frames: letters of the outcomes at 1, 3 and 10 %, by method."""
    return [
        dataclasses.replace(
            cell(LETTERS[letter], transport.USUAL_BUFFER, value, method), map="loss", figures={"off_share": 0.25}
        )
        for method, row in outcomes.items()
        for letter, value in zip(row, (1.0, 3.0, 10.0), strict=True)
    ]


def test_the_page_begins_with_the_failures_their_limits_and_remedies(tmp_path: Path) -> None:
    cells = losses({"mdct": "HHD", "dct": "HHH", "slp": "HDF", "opus": "HHD"})
    (failure,) = page.write(tmp_path, [transport.LOSS], cells, "vibrocast stability --quick")
    assert (failure.methods, failure.boundary) == ("mdct, slp and opus", "fails: 10 %; degraded: 3 %")
    text = (tmp_path / "stability.md").read_text()
    row = (
        "| Lost frames silence the texture | mdct, slp and opus | fails: 10 %; degraded: 3 % | "
        f"{explanation(cells[2]).remedy} | [map](#lost-frames), [CSV](stability/loss.csv) |"
    )
    assert row in text.splitlines()
    assert "8 of 12 conditions end as required" in text
    assert "`vibrocast stability --quick`" in text
    assert "![Most codecs bear up to 3 % of lost frames](stability/loss.svg)" in text
    with (tmp_path / "stability" / "boundaries.csv").open(newline="") as file:
        rows = {(row["method"], row["outcome"]): row for row in csv.DictReader(file)}
    assert rows["slp", "fails"]["where"] == "10 %"
    assert (rows["mdct", "holds"]["conditions"], rows["mdct", "holds"]["all_conditions"]) == ("2", "3")


@pytest.mark.parametrize(
    ("bad", "good", "words"),
    [
        (["mdct", "slp"], [], "both"),
        (["mdct", "slp", "dct"], [], "all 3"),
        (["mdct", "dct", "slp", "opus"], ["flac"], "all but flac"),
        (["eva-1", "eva-2", "eva-3"], ["mdct", "dct"], "eva-*"),
        (["eva-1", "eva-2"], ["eva-3", "mdct"], "eva-1 and eva-2"),
        ([*"abcdef"], [*"ghijkl"], "6 of 12"),
    ],
)
def test_methods_are_named_briefly(bad: list[str], good: list[str], words: str) -> None:
    cells = losses({**dict.fromkeys(bad, "HHD"), **dict.fromkeys(good, "HHH")})
    (failure,) = page.failures([(transport.LOSS, cells)])
    assert failure.methods == words


def test_a_crash_comes_first() -> None:
    crashed = dataclasses.replace(losses({"flac": "HHF"})[2], effect="CRASH: KeyError: 1")
    first, second = page.failures([(transport.LOSS, [*losses({"slp": "HHF"}), crashed])])
    assert (first.methods, first.remedy, second.methods) == ("flac", "Report it", "slp")


def test_cells_are_read_again_as_they_were_written(tmp_path: Path) -> None:
    cells = losses({"mdct": "HHD"})
    rejected = dataclasses.replace(cells[0], outcome=Outcome.REJECTED, required=Outcome.REJECTED, figures={})
    write_cells(tmp_path / "loss.csv", transport.LOSS, [*cells, rejected])
    again = read_cells(tmp_path / "loss.csv", transport.LOSS)
    assert again == [*cells, dataclasses.replace(rejected, figures={"off_share": None})]
    with pytest.raises(InputError, match=r"run `vibrocast stability` again"):
        read_cells(tmp_path / "loss.csv", transport.STALLS)


def test_what_cells_show_is_said_in_words() -> None:
    cells = losses({"mdct": "HHD", "dct": "HHH", "slp": "HDF"})
    assert maps.with_methods(cells) == "with dct only"
    assert maps.with_methods(cells[3:6]) == "with every codec"
    assert maps.with_methods(cells[6:]) == "with no codec"
    assert maps.sound_values(cells) == [1.0]
    assert maps.most_hold_up_to(cells) == 3.0
    assert maps.most_hold_up_to(losses({"mdct": "DHH"})) is None
    hard = [
        cell(Outcome.FAILS, "a click"),
        cell(Outcome.FAILS, "a click", method="b"),
        cell(Outcome.DEGRADED, "a ramp"),
    ]
    assert maps.hardest(hard) == "a click (2 of 2 codecs) and a ramp (1)"


def test_figures_have_no_negative_zero() -> None:
    small = attempt(trial(partial(Measured, Outcome.HOLDS, {"louder_db": -0.00001})))
    assert str(small.figures["louder_db"]) == "0.0"
    assert signals.judge(SINE, -0.001 * SINE, 5.0).effect.startswith("SNR 0.0 dB")


def test_a_page_of_other_origin_is_kept(tmp_path: Path) -> None:
    (tmp_path / "stability.md").write_text("mine")
    result = CliRunner().invoke(main, ["stability", "--out", str(tmp_path), "--codecs", "flac", "--quick"])
    assert (result.exit_code, (tmp_path / "stability.md").read_text()) == (2, "mine")
    assert "choose another --out" in result.output


@pytest.mark.parametrize("each", [*report.MAPS, peers.PEERS], ids=lambda each: str(each.name))
def test_every_map_has_its_words(each: Map) -> None:
    assert len(each.tried) > 40 and all(each.rule)
    assert bool(each.value_name) == bool(each.varied) == ("{}" in each.varied)


def test_titles_are_links() -> None:
    titles = [each.title for each in (*report.MAPS, peers.PEERS)]
    assert len({*titles, *maps.Group}) == len(titles) + len(maps.Group)
    assert all(title.replace(" ", "").isalpha() for title in titles)


def test_causes_are_about_maps_that_there_are() -> None:
    names = {each.name for each in MAPS} | {peers.PEERS.name}
    assert {cause.map for cause in known_causes()} <= names
    for outcome in (Outcome.REJECTED, Outcome.DEGRADED, Outcome.FAILS):
        assert explanation(cell(outcome)).remedy
    assert explanation(cell(Outcome.HOLDS)) == ("", "", "")


def test_a_failure_has_one_remedy() -> None:
    remedies = {(cause.map, cause.failure, cause.remedy) for cause in known_causes() if cause.failure}
    assert len(remedies) == len({(name, failure) for name, failure, _ in remedies})


@pytest.mark.slow
@pytest.mark.usefixtures("played_once")
def test_every_map_on_a_tiny_grid(tmp_path: Path) -> None:
    for each in MAPS:
        trials = each.trials(QUICK)
        assert trials and all(made.map == each.name for made in trials)
        cells = [attempt(made) for made in trials[:1]]
        assert not any(made.effect.startswith("CRASH") for made in cells)
        assert pictures.write(tmp_path, each, cells) == f"{each.name}.svg"
        assert "<svg" in (tmp_path / f"{each.name}.svg").read_text()


def test_a_picture_that_would_be_large_is_no_vector_graphic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = losses({"mdct": "HHD"})
    pictures.write(tmp_path, transport.LOSS, cells)
    monkeypatch.setattr(pictures, "MAX_SVG_BYTES", 1000)
    assert pictures.write(tmp_path, transport.LOSS, cells) == "loss.png"
    assert [path.name for path in tmp_path.iterdir()] == ["loss.png"]


def test_colours_differ_in_grey() -> None:
    def lightness(colour: str) -> float:
        return float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))

    greys = sorted(lightness(shade) for shade, _ in pictures.COLOURS.values())
    assert min(np.diff(greys)) > 0.08
    assert all(abs(lightness(shade) - lightness(ink)) > 0.4 for shade, ink in pictures.COLOURS.values())


def test_names_of_curves_do_not_collide(tmp_path: Path) -> None:
    same = [Curve(f"curve {number}", [1, 2], [5, 5], [False, True]) for number in range(12)]
    curves(tmp_path / "same.png", [Panel("", "", "", same, lines=(5,))])
    assert (tmp_path / "same.png").stat().st_size > 1000


def test_all_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = (signals.SIGNALS, actuators.RESONANCE)
    monkeypatch.setattr(report, "MAPS", drawn)
    monkeypatch.setattr(report, "run", lambda trials, progress: [attempt(made) for made in trials])
    peers_file = tmp_path / "edge.csv"
    peers_file.write_text(PEERS_CSV)
    arguments = ["--out", str(tmp_path / "docs"), "--codecs", "mdct", "--quick", "--peers-edge", str(peers_file)]
    result = CliRunner().invoke(main, ["stability", *arguments])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "docs" / "stability.md").read_text()
    assert result.stdout.splitlines()[-1] == f"page: {tmp_path / 'docs' / 'stability.md'}"
    assert "  remedy: " in result.stdout
    for name in ("signals", "resonance", "peers"):
        assert f"](stability/{name}.svg)" in text
        with (tmp_path / "docs" / "stability" / f"{name}.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert rows and {row["outcome"] for row in rows} <= {str(outcome) for outcome in Outcome}
    written = {path.name: path.read_bytes() for path in (tmp_path / "docs" / "stability").iterdir()}
    for path in (tmp_path / "docs" / "stability").glob("*.svg"):
        path.unlink()
    monkeypatch.setattr(stability_page, "MAPS", drawn)
    assert CliRunner().invoke(stability_page.main, [str(tmp_path / "docs")]).exit_code == 0
    assert (tmp_path / "docs" / "stability.md").read_text() == text
    assert {path.name: path.read_bytes() for path in (tmp_path / "docs" / "stability").iterdir()} == written


def test_only_what_was_measured_is_drawn_again(tmp_path: Path) -> None:
    result = CliRunner().invoke(stability_page.main, [str(tmp_path)])
    assert result.exit_code == 1
    assert "description.csv: No such file or directory; give the --out of a stability run" in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ["--codecs", "nonsense"],
        ["--codecs", ","],
        ["--peers-edge", "missing.csv"],
        ["--maps", "nonsense"],
        ["--maps", "recordings"],
        ["--recordings", "missing"],
    ],
)
def test_bad_arguments_are_rejected(arguments: list[str], tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["stability", "--out", str(tmp_path), *arguments])
    assert result.exit_code != 0
