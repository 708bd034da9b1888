"""A run as JSON and as a page, and two runs compared: what has become worse is named."""

import copy
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.harness import runs
from tests.harness.runs import RUN
from vibrocast.errors import FAILED, HOST_BUSY, REGRESSION, InputError
from vibrocast.harness import page, results
from vibrocast.harness.results import Results
from vibrocast.host.bench_file import Bench, BenchController
from vibrocast.host.figures import FIGURES, BenchLimits, exit_code_of, missed
from vibrocast.planner.forecast import Forecast


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    RUN.write(tmp_path / "run.json")
    run = results.read_results(tmp_path / "run.json")
    assert run == RUN
    assert not problems(run, run)


def problems(before: Results, now: Results) -> dict[str, str]:
    """Return what is wrong with figures of two runs, by their names."""
    return {change.name: change.problem for change in results.compare(before, now) if change.problem}


def changed(*path: Any, value: object) -> Results:
    """Return the run with another value at a place."""
    document = copy.deepcopy(RUN.document())
    *way, last = path
    at: Any = document
    for key in way:
        at = at[key]
    at[last] = value
    return msgspec.convert(document, Results)


BENCH = Bench((BenchController("it", "sim"),), limits=BenchLimits(min_snr_db=99))
NO_LIMITS = replace(BENCH, limits=BenchLimits())
REPORT = ("measured", "fidelity", 0, "report")
LATENCY = ("measured", "latency")


@pytest.mark.parametrize(
    ("path", "value", "worse"),
    [
        (("measured", "throughput", "to_host_bytes_per_s"), 5e4, {"throughput to the host, bytes/s": "worse"}),
        (("measured", "throughput", "to_host_bytes_per_s"), 7e4, {}),
        ((*REPORT, "dac_equals_offline"), False, {"rough: DAC as computed": "worse"}),
        ((*REPORT, "dac_equals_offline"), None, {"rough: DAC as computed": "not known now"}),
        ((*REPORT, "quality", "skin", "playing_snr_db"), 20.0, {"rough: SNR without the codec, dB": "worse"}),
        ((*REPORT, "quality", "skin", "playing_snr_db"), 40.0, {}),
        ((*REPORT, "quality", "skin", "snr_db"), None, {"rough: SNR, dB": "not known now"}),
        ((*REPORT, "quality", "skin", "gain"), 1.2, {"rough: gain": "worse"}),
        ((*REPORT, "quality", "skin", "gain"), float("nan"), {"rough: gain": "not known now"}),
        (("measured", "fidelity", 0, "lag_ms"), 300.0, {"rough: lag, ms": "worse"}),
        ((*REPORT, "underruns"), 1, {"rough: underruns": "worse"}),
        ((*REPORT, "lost_packets"), 1, {"rough: lost packets, %": "worse"}),
        ((*LATENCY, "to_sensor_ms"), 40.0, {"live: latency to the sensor, ms": "not known in the earlier run"}),
        ((*LATENCY, "report", "timing", "end_to_end_ms"), 99.0, {"live: latency, ms": "worse"}),
        ((*LATENCY, "report", "decoded_equals_offline"), False, {"live: decoded as sent": "worse"}),
        ((*LATENCY, "report", "lost_packets"), 5, {"live: lost packets, %": "worse"}),
        ((*LATENCY, "report", "underruns"), 1, {"live: underruns": "worse"}),
        (("measured", "smallest", "found"), None, {"smallest stable latency, ms": "not known now"}),
        (("measured", "load", 0, "underruns"), 2, {"largest load, samples/s": "worse"}),
        (("measured", "load"), [], {"largest load, samples/s": "worse"}),
        (("link", "bad_frames_at_controller"), 3, {"link: damaged frames": "worse"}),
        (("link", "bad_frames_at_host"), 3, {"link: damaged frames": "worse"}),
        (("link", "repeated_frames"), 1, {"link: repeated frames": "worse"}),
        (("link", "reordered_frames"), 1, {"link: reordered frames": "worse"}),
        (("device", "hardware"), "another", {"hardware": "another device"}),
        (("device", "serial_number"), "2", {"serial_number": "another device"}),
        (("device", "actuator"), {"name": "lra"}, {"actuator": "another device"}),
        (("device", "actuator"), {"name": "piezo-stack", "corner_hz": 241.5}, {}),
        (("asked",), ["gap"], {"gap": "in neither run"}),
    ],
)
def test_each_figure_that_is_worse_or_missing_is_named(
    path: tuple[Any, ...], value: object, worse: dict[str, str]
) -> None:
    if isinstance(value, float) and value != value:
        value = Results({"x": value}, {}).document()["device"]["x"]
        assert value is None
    assert problems(RUN, changed(*path, value=value)) == worse


@pytest.mark.parametrize(
    ("path", "value", "cause"),
    [
        ((*REPORT, "dac_equals_offline"), False, "device"),
        (("device", "serial_number"), "2", "device"),
        (("link", "device_restarts"), 1, "device"),
        (("link", "bad_frames_at_controller"), 3, "wire"),
        ((*LATENCY, "report", "timing", "end_to_end_ms"), 99.0, "wire"),
        (("measured", "throughput", "to_host_bytes_per_s"), 5e4, "host"),
        ((*LATENCY, "report", "lost_packets"), 5, "wire"),
        ((*REPORT, "quality", "skin", "gain"), 1.2, "actuator or sensor"),
        (("device", "serial_number"), RUN.device["serial_number"], ""),
    ],
)
def test_the_cause_is_that_of_the_figures_that_are_worse(path: tuple[Any, ...], value: object, cause: str) -> None:
    """In all runs, this machine was busy while it measured the throughput."""
    now = changed(*path, value=value)
    now.doubts["throughput"] = "other programs ran"
    assert results.likely_cause(now, NO_LIMITS, results.compare(RUN, now)) == cause


def test_an_exact_copy_is_not_worse_than_one_that_losses_kept_from_being_compared() -> None:
    assert problems(changed(*REPORT, "dac_equals_offline", value=None), RUN) == {}


def test_a_figure_that_the_earlier_run_lacks_cannot_be_compared() -> None:
    earlier = changed("measured", "smallest", value=None)
    assert problems(earlier, RUN) == {"smallest stable latency, ms": "not in the earlier run"}


def test_a_figure_that_every_device_has_is_a_problem_where_neither_run_knows_it() -> None:
    unstable = changed("measured", "smallest", "found", value=None)
    assert problems(unstable, unstable) == {"smallest stable latency, ms": "known in neither run"}


@pytest.mark.parametrize(
    ("path", "found"),
    [
        ((*LATENCY, "report", "decoded_equals_offline"), ["live: decoded as sent"]),
        ((*REPORT, "decoded_equals_offline"), ["rough: decoded as sent"]),
        ((*REPORT, "dac_equals_offline"), ["rough: DAC as computed"]),
    ],
)
def test_what_a_controller_plays_otherwise_is_named(path: tuple[str | int, ...], found: list[str]) -> None:
    (finding,) = results.findings_in(replace(changed(*path, value=False), failed={}), NO_LIMITS)
    assert finding.exit_code == FAILED and f"though nothing was lost: not {found[0]};" in finding.text


def test_all_that_is_wrong_is_named_and_the_worst_gives_the_exit_code() -> None:
    run = changed(*REPORT, "quality", "skin", "gain", value=-1.0)
    found = results.findings_in(run, BENCH, results.compare(RUN, run), "earlier.json")
    assert [each.text.partition(":")[0] for each in found] == [
        "not all could be measured",
        "not as in earlier.json",
        "limits missed",
    ]
    assert exit_code_of(found) == FAILED
    busy = replace(run, doubts={"gap": "this machine woke up 80 ms late"})
    found = results.findings_in(busy, BENCH, results.compare(RUN, busy), "earlier.json")
    assert str(found[0]).startswith("undecided, because this machine woke up 80 ms late: not all could be measured")
    assert exit_code_of(found) == REGRESSION  # another gain at the skin is none of this machine's


def test_a_busy_machine_leaves_times_undecided_and_nothing_else() -> None:
    late = replace(changed("measured", "throughput", "to_host_bytes_per_s", value=5e4), failed={})
    busy = replace(late, doubts={"throughput": "this machine woke up 80 ms late"})
    codes = [exit_code_of(results.findings_in(run, NO_LIMITS, results.compare(RUN, run))) for run in (RUN, late, busy)]
    assert codes == [FAILED, REGRESSION, HOST_BUSY]


def test_limits_name_the_figures_that_miss_them() -> None:
    limits = BenchLimits(min_snr_db=99, max_gain=0.5, max_latency_ms=99.0, max_bad_frames=0, max_drift_ppm=2.0)
    run = changed("link", "bad_frames_at_host", value=1)
    latency = runs.LATENCY
    run.measured.latency = replace(latency, report=replace(latency.report, lost_packets=8, packets=700))
    assert [each.text for each in missed(limits, run.figures())] == [
        "live: lost_percent = 1.143, max_lost_percent = 1",
        "rough: snr_db = 13.73, min_snr_db = 99",
        "rough: gain = 1, max_gain = 0.5",
        "link: bad_frames = 1, max_bad_frames = 0",
    ]
    unknown = changed(*REPORT, "quality", "skin", "gain", value=None)
    (unmet,) = missed(BenchLimits(min_gain=0.9), unknown.figures())
    assert unmet.text == "rough: gain is not known, min_gain = 0.9"
    assert missed(BenchLimits(), RUN.figures()) == []


def test_every_limit_and_every_forecast_is_a_figure_of_the_table() -> None:
    limits = {name.partition("_")[2] for name in BenchLimits.__struct_fields__}
    assert limits | {each.name for each in fields(Forecast)} <= set(FIGURES)
    figures = [(each.label, each.unit) for each in FIGURES.values()]
    assert len(set(figures)) == len(figures)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"format": "other"}',
        '{"format": "vibrocast measurements", "schema": 2}',
        '{"format": "vibrocast measurements", "schema": 3, "measured": 3}',
        "[" * 9999,
    ],
)
def test_another_file_is_no_earlier_run(text: str, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text(text)
    with pytest.raises(InputError, match="not the JSON of an earlier `vibrocast measure`"):
        results.read_results(path)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_a_run_with_a_figure_that_is_no_number_is_damaged(number: str, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    RUN.write(path)
    text, count = re.subn(r'"snr_db": [\d.]+', f'"snr_db": {number}', path.read_text())
    assert count
    path.write_text(text)
    with pytest.raises(InputError, match=f"{number} is no figure"):
        results.read_results(path)


def test_the_page_needs_nothing_else_and_shows_what_is_worse(tmp_path: Path) -> None:
    document, changes = RUN.document(), results.compare(RUN, RUN)
    document["measured"] = {name: document["measured"][name] for name in ("throughput", "load", "fidelity")}
    document["missed"] = ["rough: snr_db = 1, min_snr_db = 2"]
    page.write(tmp_path / "run.html", document, [results.Change("gain", 1.0, 0.5, "worse"), *changes], "")
    text = (tmp_path / "run.html").read_text()
    assert "Not as before: gain." in text
    assert "rough: snr_db = 1, min_snr_db = 2" in text and document["run"]["run_id"] in text
    assert "&lt;1&gt;" in text and "no &lt;sensor&gt;" in text
    assert text.count("<svg") == 1
    assert "src=" not in text and "<link" not in text and "<script" not in text
