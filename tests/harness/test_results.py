"""A run as JSON and as a page, and two runs compared: what has become worse is named."""

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest

from vibrocast.errors import InputError
from vibrocast.harness import page, results
from vibrocast.host.bench_limits import BenchLimits, missed

RUN = results.Results(
    {
        "name": "controller",
        "address": "sim",
        "build": "<1>",
        "hardware": "simulated",
        "serial_number": "none",
        "actuator": {"name": "piezo-stack", "corner_hz": 270.0},
    },
    {"vibrocast": "0"},
    {
        "latency": {
            "total_ms": 25.0,
            "to_sensor_ms": 28.0,
            "jitter_ms": 1.0,
            "as_sent": True,
            "underruns": 0,
            "lost_packets": 0,
            "packets": 700,
            "clock": {"drift_ppm": 3.0},
        },
        "smallest": {"found": {"total_ms": 20.0}, "trials": []},
        "throughput": {"to_controller_bytes_per_s": 9e4, "to_host_bytes_per_s": 8e4, "bad_frames": 0},
        "load": [{"channels": 1, "rate_hz": 2800, "underruns": 0, "lost_packets": 0}],
        "fidelity": [
            {
                "texture": "oak: best",
                "source": "a model",
                "as_decoded": True,
                "as_computed": True,
                "coding_snr_db": 15.0,
                "decoded_snr_db": 15.0,
                "snr_db": 12.0,
                "weighted_snr_db": 14.0,
                "st_sim": 0.9,
                "playing_snr_db": 30.0,
                "gain": 1.0,
                "lag_ms": 0.0,
                "drift_ppm": 0.0,
                "packets": 100,
                "underruns": 0,
                "lost_packets": 0,
                "spectrum": {"frequencies_hz": [10, 100], "sent_db": [1, 2], "residual_db": [-9, -8]},
            }
        ],
    },
    {"response": "no <sensor>"},
    ("latency", "smallest", "throughput", "load", "fidelity"),
    {"bad_frames_at_controller": 0, "bad_frames_at_host": 0},
)


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    RUN.write(tmp_path / "run.json")
    document = results.read_results(tmp_path / "run.json")
    assert document == json.loads(json.dumps(RUN.document()))
    assert {"run_id", "date", "versions", "bench_sha256"} == set(document["run"])
    assert not any(change.regressed for change in results.compare(document, document))


def changed(*path: Any, value: object) -> dict[str, Any]:
    """Return the run with another value at a place."""
    document = copy.deepcopy(RUN.document())
    *way, last = path
    at: Any = document
    for key in way:
        at = at[key]
    at[last] = value
    return document


FIDELITY = ("measured", "fidelity", 0)


@pytest.mark.parametrize(
    ("path", "value", "worse"),
    [
        (("measured", "throughput", "to_host_bytes_per_s"), 5e4, {"throughput to the host, bytes/s": "worse"}),
        (("measured", "throughput", "to_host_bytes_per_s"), 7e4, {}),
        ((*FIDELITY, "as_computed"), False, {"oak: best: DAC as computed": "worse"}),
        ((*FIDELITY, "as_computed"), None, {"oak: best: DAC as computed": "not known now"}),
        ((*FIDELITY, "playing_snr_db"), 28.5, {"oak: best: SNR without the codec, dB": "worse"}),
        ((*FIDELITY, "playing_snr_db"), 40.0, {}),
        ((*FIDELITY, "snr_db"), None, {"oak: best: SNR, dB": "not known now"}),
        ((*FIDELITY, "gain"), 1.2, {"oak: best: gain": "worse"}),
        ((*FIDELITY, "gain"), float("nan"), {"oak: best: gain": "not known now"}),
        ((*FIDELITY, "lag_ms"), 300.0, {"oak: best: lag, ms": "worse"}),
        ((*FIDELITY, "underruns"), 1, {"oak: best: underruns": "worse"}),
        ((*FIDELITY, "lost_packets"), 1, {"oak: best: lost packets": "worse"}),
        (("measured", "latency", "to_sensor_ms"), 40.0, {"latency to the sensor, ms": "worse"}),
        (("measured", "latency", "to_sensor_ms"), None, {"latency to the sensor, ms": "not known now"}),
        (("measured", "latency", "as_sent"), False, {"live: decoded as sent": "worse"}),
        (("measured", "latency", "lost_packets"), 1, {"live: lost packets": "worse"}),
        (("measured", "latency", "underruns"), 1, {"live: underruns": "worse"}),
        (("measured", "smallest", "found"), None, {"smallest stable latency, ms": "not known now"}),
        (("measured", "load", 0, "underruns"), 2, {"largest load, samples/s": "worse"}),
        (("measured", "load"), [], {"largest load, samples/s": "not measured now"}),
        (("link", "bad_frames_at_controller"), 3, {"to the controller: damaged frames": "worse"}),
        (("link", "bad_frames_at_host"), 3, {"to the host: damaged frames": "worse"}),
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
        now = results.Results({}, {}, {"x": value}).document()["measured"]["x"]
        assert now is None
        value = now
    found = results.compare(RUN.document(), changed(*path, value=value))
    assert {change.name: change.problem for change in found if change.regressed} == worse


def test_a_figure_that_the_earlier_run_lacks_cannot_be_compared() -> None:
    earlier = changed("measured", "smallest", value=None)
    found = results.compare(earlier, RUN.document())
    assert {change.name: change.problem for change in found if change.regressed} == {
        "smallest stable latency, ms": "not in the earlier run"
    }


def test_a_figure_that_every_device_has_is_a_problem_where_neither_run_knows_it() -> None:
    unstable = changed("measured", "smallest", "found", value=None)
    (change,) = [change for change in results.compare(unstable, unstable) if change.regressed]
    assert (change.name, change.problem) == ("smallest stable latency, ms", "known in neither run")


@pytest.mark.parametrize(
    ("path", "found"),
    [
        (("latency", "as_sent"), ["live: decoded as sent"]),
        (("fidelity", 0, "as_decoded"), ["oak: best: decoded as sent"]),
        (("fidelity", 0, "as_computed"), ["oak: best: DAC as computed"]),
    ],
)
def test_what_a_controller_plays_otherwise_is_named_unless_it_lost_something(
    path: tuple[str | int, ...], found: list[str]
) -> None:
    document = changed("measured", *path, value=False)
    assert list(results.deviations(document)) == found
    for measured in (document["measured"]["latency"], document["measured"]["fidelity"][0]):
        measured["lost_packets"] = 1
    assert list(results.deviations(document)) == []


def test_limits_name_the_figures_that_miss_them() -> None:
    limits = BenchLimits(min_snr_db=12.5, max_gain=1.05, max_latency_ms=25.0, max_bad_frames=0, max_drift_ppm=2.0)
    document = changed("measured", "latency", "lost_packets", value=8)
    document["link"]["bad_frames_at_host"] = 1
    assert missed(limits, results.judged(document)) == [
        "clock: drift_ppm = 3, max_drift_ppm = 2",
        "live: lost_percent = 1.143, max_lost_percent = 1",
        "oak: best: snr_db = 12, min_snr_db = 12.5",
        "link: bad_frames = 1, max_bad_frames = 0",
    ]
    unknown = changed(*FIDELITY, "gain", value=None)
    assert missed(BenchLimits(min_gain=0.9), results.judged(unknown)) == [
        "oak: best: gain is not known, min_gain = 0.9"
    ]
    assert missed(BenchLimits(), results.judged(RUN.document())) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"format": "other"}',
        '{"format": "vibrocast measurements", "schema": 1}',
        '{"format": "vibrocast measurements", "schema": 2, "measured": 3}',
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
    document, changes = RUN.document(), results.compare(RUN.document(), RUN.document())
    document["measured"] = {name: document["measured"][name] for name in ("throughput", "load", "fidelity")}
    document["missed"] = ["oak: snr_db = 1, min_snr_db = 2"]
    page.write(tmp_path / "run.html", document, [results.Change("gain", 1.0, 0.5, "worse"), *changes], "")
    text = (tmp_path / "run.html").read_text()
    assert "Not as before: gain." in text
    assert "oak: snr_db = 1, min_snr_db = 2" in text and document["run"]["run_id"] in text
    assert "&lt;1&gt;" in text and "no &lt;sensor&gt;" in text
    assert text.count("<svg") == 1
    assert "src=" not in text and "<link" not in text and "<script" not in text
