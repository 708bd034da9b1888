"""Tests of the stability maps: rules of outcomes, trials that raise, crash or hang, every map, the page."""

import csv
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from click.testing import CliRunner

from tests.codec.eva_models import tiny_model
from tests.command import run as run_command
from tests.command import succeeds
from vibrocast import codec
from vibrocast.errors import InputError, VibrocastError
from vibrocast.evaluation.cells import RatePoint
from vibrocast.evaluation.cli import stability_page
from vibrocast.evaluation.stability import (
    all_maps,
    filters,
    float_parity,
    learned_signals,
    model_images,
    output,
    page,
    peers,
    pictures,
    settings,
    signals,
    transport,
)
from vibrocast.evaluation.stability.known_causes import explanation
from vibrocast.evaluation.stability.maps import Cells, Scope, explained, methods, table
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, attempt, run
from vibrocast.textures import Recording, save
from vibrocast.textures.generate import wood

HOLDS, REJECTED, DEGRADED, FAILS = Outcome
STEP = RatePoint("mdct", {"step": 0.25})
TINY = tiny_model()
QUICK = Scope(methods(["mdct", "dct", "slp", "eva"], [TINY]), quick=True, recordings=(wood(0, 0.5),))
LEARNED = RatePoint("eva", {"level": 2.0}, TINY)


def hold(trial: Trial) -> Measured:
    return Measured(HOLDS, {"snr_db": 12.345678, "louder_db": -0.00001})


def reject(trial: Trial) -> Measured:
    raise codec.CodecError("too loud;\nturn it down")


def stumble(trial: Trial) -> Measured:
    raise ZeroDivisionError("oh")


def hang(trial: Trial) -> Measured:
    while True:
        pass


def wait(trial: Trial) -> Measured:
    time.sleep(1.5)
    return hold(trial)


def fake(measure: Callable[[Trial], Measured], to_be_rejected: bool = False) -> Trial:
    return Trial("fake", "a case", measure=measure, to_be_rejected=to_be_rejected)


def tried(measure: Callable[[Trial], Measured], to_be_rejected: bool = False) -> Cells:
    """Return the explained cell of one trial."""
    trial = fake(measure, to_be_rejected)
    return explained("fake", table([trial], [attempt(trial)]))


def at(rate_point: RatePoint, case: str = "", value: float = math.nan, method: str = "", of_map: str = "") -> Trial:
    return Trial(method, case, value=value, rate_points=(rate_point,), map=of_map)


def here(trials: list[Trial], progress: object) -> list[Measured]:
    """Run trials in this process."""
    return [attempt(trial) for trial in trials]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_what_happens_in_a_trial_is_its_outcome() -> None:
    cell = tried(hold)
    assert (cell["snr_db"][0], str(cell["louder_db"][0])) == (12.3457, "0.0")  # no negative zero
    columns = ("outcome", "effect", "sound")
    assert tried(reject).select(columns).row(0) == ("rejected", "too loud; turn it down", False)
    crashed = tried(stumble)
    assert crashed.select(columns).row(0) == ("fails", "CRASH: ZeroDivisionError: oh", False)
    assert crashed["remedy"][0] == "Report it"
    assert tried(reject, to_be_rejected=True)["sound"].all()
    accepted = tried(hold, to_be_rejected=True)
    assert accepted.select(columns).row(0) == ("fails", "accepted, though it must be rejected", False)


@pytest.mark.slow
def test_a_trial_that_hangs_costs_only_its_cell() -> None:
    told: list[float] = []
    trials = [fake(measure) for measure in (hang, reject, wait)]
    cells = run(trials, 1.0, lambda part, _: told.append(part))
    # A busy machine that keeps a trial waiting does not end it.
    assert [each.outcome for each in cells] == [FAILS, REJECTED, HOLDS]
    assert "longer than 1 s" in cells[0].effect
    assert told[-1] == 1.0


SINE = 0.5 * np.sin(np.arange(1000)).reshape(-1, 1)
PERIODS = np.round(1000 * np.sin(np.arange(1000) / 5)).reshape(-1, 1)
CLICK = np.where(np.arange(1000)[:, None] == 500, 3000, PERIODS)
SANDPAPER = RatePoint("dct", {"levels": 320}), "sandpaper"
OF_LRA = "lra of 175 Hz"


def muted(half_periods: int) -> np.ndarray:
    """Return PERIODS, silent at their beginning."""
    return PERIODS * (np.arange(1000)[:, None] > half_periods * np.pi * 5)


@pytest.mark.parametrize(
    ("outcome", "measure", "arguments"),
    [
        *(
            (outcome, signals.judge, (SINE, heard, texture_snr_db))
            for outcome, heard, texture_snr_db in (
                (HOLDS, SINE, 20.0),
                (HOLDS, 1.1 * SINE, 25.0),
                (DEGRADED, 1.1 * SINE, 30.0),
                (DEGRADED, 1.9 * SINE, 5.0),
                (FAILS, 2.1 * SINE, 5.0),
                (DEGRADED, 0.05 * SINE, 5.0),
                (DEGRADED, 0 * SINE, 17.0),
                (FAILS, -0.1 * SINE, 5.0),
                (DEGRADED, -0.001 * SINE, 5.0),
                (FAILS, np.where(SINE > 0.49, np.nan, SINE), 5.0),
                (HOLDS, 1.001 * SINE, 90.0),
            )
        ),
        (HOLDS, signals.judge, (0 * SINE, 0 * SINE, 20.0)),
        (DEGRADED, signals.judge, (0 * SINE, 2e-3 * SINE, 20.0)),
        (FAILS, signals.judge, (0 * SINE, 0.04 * SINE, 20.0)),
        (HOLDS, transport.rate_codes, (PERIODS, PERIODS, 0, 0, 0)),
        (HOLDS, transport.rate_codes, (PERIODS, muted(2), 1, 2, 0)),
        (DEGRADED, transport.rate_codes, (PERIODS, muted(20), 1, 2, 0)),
        (FAILS, transport.rate_codes, (PERIODS, muted(50), 1, 2, 0)),
        (FAILS, transport.rate_codes, (PERIODS, CLICK, 0, 0, 0)),
        (FAILS, transport.rate_codes, (PERIODS, PERIODS[:100], 0, 0, 0)),
        (HOLDS, settings.judge_rate, (1.1, 1.0)),
        (DEGRADED, settings.judge_rate, (2.0, 1.0)),
        (FAILS, settings.judge_rate, (4.0, 0.0)),
        *(
            (outcome, measure, (trial,))
            for outcome, measure, trial in (
                (FAILS, filters.measure, Trial("direct form", "order 12", value=5)),
                (HOLDS, filters.measure, Trial("reflection coefficients", "order 12", value=5)),
                (DEGRADED, signals.measure_onset, at(RatePoint("mdct", {"step": 0.5}))),
                (HOLDS, signals.measure_onset, at(RatePoint("mdct", {"step": 0.01}))),
                (FAILS, output.measure_speed, at(*SANDPAPER, 25.0)),
                (HOLDS, output.measure_speed, at(*SANDPAPER, 50.0)),
                (HOLDS, output.measure_speed, at(*SANDPAPER, 100.0)),
                (HOLDS, output.measure_shift, Trial(OF_LRA, "Q 15", value=0)),
                (HOLDS, output.measure_shift, Trial(OF_LRA, "Q 5", value=2)),
                (FAILS, output.measure_shift, Trial(OF_LRA, "Q 30", value=5)),
                (HOLDS, output.measure_sine, Trial("piezo-stack, compensated", "40 µm", value=50)),
                (DEGRADED, output.measure_sine, Trial("piezo-stack, compensated", "40 µm", value=400)),
                (HOLDS, signals.measure, at(LEARNED, "texture")),
                (HOLDS, learned_signals.measure_quiet, at(LEARNED, value=0.0)),
                (FAILS, learned_signals.measure_quiet, at(LEARNED, value=60.0)),
                (HOLDS, float_parity.measure_core, at(LEARNED)),
            )
        ),
        *(
            (HOLDS, measure, (at(LEARNED, f"{part}, {way}"),))
            for part, measure in (
                ("analysis", float_parity.measure_analysis),
                ("synthesis", float_parity.measure_synthesis),
            )
            for way in ("no optimisation", "in pieces")
        ),
        (DEGRADED, float_parity._judged, (np.ones((1, 2, 3)), np.ones((1, 2, 3)) + 1e-4, {})),
    ],
)
def test_rules(outcome: Outcome, measure: Callable[..., Measured], arguments: tuple[object, ...]) -> None:
    assert measure(*arguments).outcome is outcome


def test_figures_are_what_their_names_say() -> None:
    for half_periods in (2, 20, 50):
        off = transport.rate_codes(PERIODS, muted(half_periods), 1, 2, 0).figures["off_share"]
        assert off == pytest.approx(half_periods * np.pi / 200, abs=0.01)
    slow = output.measure_speed(at(*SANDPAPER, 25.0))
    assert slow.figures["upper_octave_level_db"] < -10  # type: ignore[operator]
    assert settings.needed_bits(np.array([1.0, -1.0, 1.0, -1.0]), 4) == 1.0
    floor = settings.measure_coefficients(Trial("dct, huffman", "all the same")).figures["bits_per_sample"]
    assert floor is not None and 1.0 <= floor < 1.2


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
def test_an_offset_or_a_drift_counts_not_and_a_high_pass_before_coding_is_the_remedy(name: str) -> None:
    made, texture = signals.CONDITIONS[name].make(), signals.texture()
    assert np.std(made - texture) > 3 * np.std(texture) or np.mean(made - texture) > 9
    np.testing.assert_allclose(signals.tactile_part(made), signals.tactile_part(texture), atol=0.02)
    rate_point = RatePoint("mdct", {"step": 0.5})
    assert signals.measure(at(rate_point, name)).outcome is not HOLDS
    assert signals.measure(at(rate_point, f"{name}, high-passed")).outcome is HOLDS


def test_recordings_of_ones_own_are_a_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(all_maps, "run", here)
    (tmp_path / "own" / "deep").mkdir(parents=True)
    save(tmp_path / "own" / "deep" / "plank.wav", wood(3, 0.5, rate_hz=8000))
    save(tmp_path / "own" / "silent.wav", Recording(np.zeros((900, 1)), 1000.0, "um", "silent"))
    (tmp_path / "own" / "bare.csv").write_text("1\n2\n")
    (tmp_path / "own" / "notes.md").touch()
    chosen = ("--codecs", "slp", "--maps", "recordings", "--recordings", tmp_path / "own")
    result = run_command("stability", "--out", tmp_path / "out", *chosen)
    assert result.exit_code == 0, result.output
    assert "skipped 1 file: notes.md" in result.stderr and "left out: bare: " in result.stderr
    rows = rows_of(tmp_path / "out" / "stability" / "recordings.csv")
    assert {row["case"] for row in rows} == {"deep/plank", "silent"} and len(rows) == 6
    assert {row["outcome"] for row in rows} == {"holds"}
    assert "## Your recordings" in (tmp_path / "out" / "stability.md").read_text()


def test_an_hour_counts_by_its_last_minute_and_a_source_of_its_own_pace_runs_dry_by_the_drift(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signals, "HOUR_S", 120)
    assert signals.measure_hour(at(RatePoint("mdct", {"step": 0.05}))).outcome is HOLDS
    monkeypatch.setattr(transport, "PACED_S", 4.0)
    assert transport.measure_paced(at(STEP, value=-10_000)).outcome is HOLDS
    late = transport.measure_paced(at(STEP, value=50_000))
    assert late.outcome is not HOLDS
    # 0.1 s at one part in twenty.
    assert late.figures["first_underrun_s"] == pytest.approx(2, abs=1)


def test_a_fall_on_the_way_up_a_rate_point_set_is_marked() -> None:
    trials = [Trial("fake", "a case")] * 6
    cells = table(trials, [Measured(HOLDS, {"snr_db": each}) for each in (1.0, 5.0, 4.0, 4.95, 7.0, None)])

    def letters(judged: Cells) -> str:
        return "".join(Outcome(outcome).letter for outcome in judged["outcome"])

    assert letters(settings.falls(cells)) == "HHDHHH"
    assert settings.falls(cells)["effect"][2] == "SNR 4.0 dB, 1.0 dB less than at a coarser setting"
    assert letters(settings.near_best(cells)) == "DHHHHH"
    assert letters(settings.half_left(cells)) == "DHHHHH"


@pytest.fixture
def played_once(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(transport, "LOOPS", 1)
    transport._stream.cache_clear()
    yield
    transport._stream.cache_clear()


@pytest.mark.usefixtures("played_once")
def test_a_longer_stall_than_the_buffer_is_heard_and_a_controller_without_the_model_rejects() -> None:
    usual = transport.USUAL_BUFFER
    short, long = (transport.measure(at(STEP, usual, stall_s, of_map="stalls")) for stall_s in (0.05, 1.0))
    assert (short.outcome, short.figures["off_share"]) == (HOLDS, 0)
    assert long.figures["underruns"] > 0  # type: ignore[operator]
    assert transport.measure(at(LEARNED, usual, 0.0, of_map="loss")).outcome is HOLDS
    for case in ("no image on the controller", "other image on the controller"):
        with pytest.raises(VibrocastError, match="does not run here"):
            model_images.measure_wrong(at(LEARNED, case))


def test_a_wrong_or_damaged_image_is_rejected_while_something_vouches_for_it() -> None:
    for case in model_images.WRONG:
        with pytest.raises(VibrocastError):
            model_images.measure_wrong(at(LEARNED, case))
    with pytest.raises(VibrocastError):
        model_images.measure_cut(at(LEARNED, value=90.0))
    outcomes = {
        attempt(replace(at(LEARNED, runtime, percent), measure=model_images.measure_changed)).outcome
        for runtime in codec.RUNTIMES
        for percent in (0.0, 1.0, 45.0, 99.0)
    }
    assert FAILS not in outcomes and REJECTED in outcomes


def test_what_a_model_needs_beyond_mdct_is_measured_in_bits() -> None:
    rate_point_set = tuple(RatePoint("mdct", {"step": 2 ** (exponent / 2)}) for exponent in range(4, -14, -1))
    same = learned_signals.measure_kind(Trial("mdct", "wood", rate_points=rate_point_set))
    assert same.outcome is HOLDS
    assert same.figures["ratio"] == pytest.approx(1.0)
    coarse = learned_signals.measure_kind(Trial("mdct", "wood", rate_points=rate_point_set[:2]))
    assert (coarse.outcome, coarse.effect) == (FAILS, "10 dB are not reached")


def test_a_wrong_level_costs_quality_in_either_runtime() -> None:
    for runtime in codec.RUNTIMES:
        right, wrong = (
            learned_signals.measure_level(at(RatePoint("eva", {"level": level}, TINY), "texture", method=runtime))
            for level in (1.0, 0.001)
        )
        assert right.outcome is HOLDS
        assert wrong.figures["snr_db"] < right.figures["snr_db"] - 3  # type: ignore[operator]


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
    assert [Outcome(outcome).letter for outcome in cells["outcome"]] == list("HFHDFFR")
    assert not any("/some" in effect for effect in cells["effect"])
    for text in ("", "a,b\n1,2\n", PEERS_CSV.replace("20,0.5", "x,0.5"), "\0"):
        file.write_text(text)
        with pytest.raises(InputError):
            peers.read_peers(file)


LETTERS = {outcome.letter: outcome for outcome in Outcome}
LOSS = transport.LOSS


def losses(**outcomes: str) -> Cells:
    """Return cells of the map of lost frames: letters of the outcomes at 1, 3 and 10 %, by method."""
    trials = [
        Trial(method, transport.USUAL_BUFFER, "step=1", value) for method in outcomes for value in (1.0, 3.0, 10.0)
    ]
    letters = "".join(outcomes.values())
    return table(trials, [Measured(LETTERS[letter], {"off_share": 0.25}, "an effect") for letter in letters])


def test_the_page_begins_with_the_failures_their_limits_and_remedies(tmp_path: Path) -> None:
    cells = losses(mdct="HHD", dct="HHH", slp="HDF", opus="HHD", parametric="HHH")
    (failure,) = page.write(tmp_path, {LOSS: cells}, "vibrocast stability --quick")
    crashed = losses(flac="HHF").with_columns(effect=pl.lit("CRASH: KeyError: 1"))
    failures = page.failures({LOSS: explained("loss", pl.concat([losses(slp="HHF"), crashed.tail(1)]))})
    assert [each.methods for each in failures] == ["flac", "slp"]
    assert (failure.methods, failure.boundary) == ("mdct, slp and opus", "fails: 10 %; degraded: 3 %")
    text = (tmp_path / "stability.md").read_text()
    row = (
        "| Lost frames silence the texture | mdct, slp and opus | fails: 10 %; degraded: 3 % | "
        f"{explanation('loss', 'slp', '', DEGRADED, '').remedy} | [map](#lost-frames), [CSV](stability/loss.csv) |"
    )
    assert row in text.splitlines()
    assert text.index("## Where mdct fails") < text.index(row)
    (of_mdct,) = page.failures({LOSS: explained("loss", cells)}, "mdct")
    assert (of_mdct.methods, of_mdct.boundary) == ("mdct", "degraded: 10 %")
    assert "15 combinations of codec, signal and setting were tested, and 11 meet the [rules](#rules)." in text
    assert (
        "share, `mdct` meets 66 %. Of the other codecs, `dct` meets most (100 %) and `slp` fewest (33 %). These shares "
        "leave out `parametric`, because by design it does not keep the waveform."
    ) in text
    assert "`vibrocast stability --quick`" in text
    assert "![Most codecs tolerate 1 to 3 % of lost frames](stability/loss.svg)" in text
    rows = {(row["method"], row["outcome"]): row for row in rows_of(tmp_path / "stability" / "boundaries.csv")}
    assert rows["slp", "fails"]["where"] == "10 %"
    assert (rows["mdct", "holds"]["conditions"], rows["mdct", "holds"]["all_conditions"]) == ("2", "3")


def test_cells_are_read_again_as_they_were_written(tmp_path: Path) -> None:
    cells = losses(mdct="HHD")
    rejected = table([Trial("mdct", "a case", to_be_rejected=True)], [Measured(REJECTED, {"off_share": None})])
    page.write(tmp_path, {LOSS: pl.concat([cells, rejected])}, "stability")
    again = page.read_cells(tmp_path / "stability" / "loss.csv", LOSS)
    assert again.equals(pl.concat([cells, rejected]))
    with pytest.raises(InputError, match=r"run `vibrocast stability` again"):
        page.read_cells(tmp_path / "stability" / "loss.csv", transport.STALLS)


@pytest.mark.slow
@pytest.mark.usefixtures("played_once")
def test_every_map_on_a_tiny_grid(tmp_path: Path) -> None:
    for each in all_maps.MAPS:
        trials = each.trials(QUICK)
        assert trials and all(made.map == each.name for made in trials)
        measured = [attempt(made) for made in trials[:1]]
        assert not any(made.effect.startswith("CRASH") for made in measured)
        pictures.write(tmp_path / f"{each.name}.svg", each, explained(each.name, table(trials[:1], measured)))
        assert "<svg" in (tmp_path / f"{each.name}.svg").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--codecs", "nonsense"], "'nonsense' is no list of codecs"),
        (["--codecs", ","], "is no list of codecs"),
        (["--peers-edge", "missing.csv"], "missing.csv"),
        (["--maps", "nonsense"], "nonsense"),
        (["--maps", "recordings"], "recordings"),
        (["--recordings", "missing"], "missing"),
        (["--codecs", "slp", "--quick"], "choose another --out"),
    ],
)
def test_bad_arguments_are_rejected_and_a_page_of_other_origin_is_kept(
    arguments: list[str], message: str, tmp_path: Path
) -> None:
    (tmp_path / "stability.md").write_text("mine")
    said = run_command("stability", "--out", tmp_path, *arguments)
    assert said.exit_code == 2 and message in said.stderr
    assert (tmp_path / "stability.md").read_text() == "mine"


def test_the_answer_in_json_names_the_map_of_each_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(all_maps, "run", here)
    said = succeeds("stability", "--out", tmp_path, "--codecs", "mdct", "--quick", "--maps", "resonance", "--json")
    (failure,) = json.loads(said)["failures"]
    assert failure["map"] == "resonance" and failure["boundary"].startswith("fails: ")
    assert "resonance" in repr(output.RESONANCE) and "constants" not in repr(output.RESONANCE)


def test_all_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    docs, drawn = tmp_path / "docs", (signals.SIGNALS, output.RESONANCE)
    monkeypatch.setattr(all_maps, "MAPS", drawn)
    monkeypatch.setattr(all_maps, "run", here)
    peers_file = tmp_path / "edge.csv"
    peers_file.write_text(PEERS_CSV)
    said = succeeds("stability", "--out", docs, "--codecs", "mdct", "--quick", "--peers-edge", peers_file)
    text = (docs / "stability.md").read_text()
    assert said.splitlines()[-1] == f"page: {docs / 'stability.md'}"
    assert "  remedy: " in said
    for name in ("signals", "resonance", "peers"):
        assert f"](stability/{name}.svg)" in text
        rows = rows_of(docs / "stability" / f"{name}.csv")
        assert rows and {row["outcome"] for row in rows} <= {str(outcome) for outcome in Outcome}
    written = {path.name: path.read_bytes() for path in (docs / "stability").iterdir()}
    for path in (docs / "stability").glob("*.svg"):
        path.unlink()
    monkeypatch.setattr(stability_page, "MAPS", drawn)
    assert CliRunner().invoke(stability_page.main, [str(docs)]).exit_code == 0
    assert (docs / "stability.md").read_text() == text
    assert {path.name: path.read_bytes() for path in (docs / "stability").iterdir()} == written
    result = CliRunner().invoke(stability_page.main, [str(tmp_path)])
    assert result.exit_code == 1 and "description.csv: No such file or directory; give the --out" in result.output
