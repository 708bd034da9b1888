"""A run as JSON and as a page, and two runs compared: what has become worse is named."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from vibrocast.files import InputFileError
from vibrocast.host.harness import page, results

RUN = results.Results(
    {"name": "controller", "address": "sim", "build": "<1>"},
    {"vibrocast": "0"},
    {
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
                "snr_db": float("inf"),
                "st_sim": 0.9,
                "playing_snr_db": 30.0,
                "gain": 1.0,
                "lag_ms": 0.0,
                "drift_ppm": 0.0,
                "spectrum": {"frequencies_hz": [10, 100], "sent_db": [1, 2], "residual_db": [-9, -8]},
            }
        ],
    },
    {"response": "no <sensor>"},
)


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    RUN.write(tmp_path / "run.json")
    document = results.read_results(tmp_path / "run.json")
    assert document == json.loads(json.dumps(RUN.document()))
    assert document["measured"]["fidelity"][0]["snr_db"] is None
    assert not any(change.regressed for change in results.compare(document, document))


@pytest.mark.parametrize(
    ("path", "value", "worse"),
    [
        (("throughput", "to_host_bytes_per_s"), 5e4, ["throughput to the host, bytes/s"]),
        (("throughput", "to_host_bytes_per_s"), 7e4, []),
        (("fidelity", 0, "as_computed"), False, ["oak: best: DAC as computed"]),
        (("fidelity", 0, "playing_snr_db"), 28.5, ["oak: best: SNR without the codec, dB"]),
        (("fidelity", 0, "playing_snr_db"), 40.0, []),
        (("fidelity", 0, "gain"), 1.2, ["oak: best: gain"]),
        (("load", 0, "underruns"), 2, ["largest load, samples/s"]),
        (("load",), [], []),
    ],
)
def test_what_is_worse_beyond_its_tolerance_is_named(path: tuple[Any, ...], value: object, worse: list[str]) -> None:
    before, now = RUN.document(), copy.deepcopy(RUN.document())
    *way, last = path
    at = now["measured"]
    for key in way:
        at = at[key]
    at[last] = value
    assert [change.name for change in results.compare(before, now) if change.regressed] == worse


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("latency, ms", 25.639, "latency: 25.64 ms"),
        ("oak: DAC as computed", 1.0, "oak: DAC as computed: yes"),
        ("oak: decoded as sent", 0.0, "oak: decoded as sent: no"),
        ("oak: gain", 0.87341, "oak: gain: 0.8734"),
        ("throughput to the host, bytes/s", 2.15447e7, "throughput to the host: 21544700 bytes/s"),
        ("controllers that played as computed", 3.0, "controllers that played as computed: 3"),
    ],
)
def test_a_figure_is_a_line_with_its_unit(name: str, value: float, line: str) -> None:
    assert results.described(name, value) == line


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"format": "other"}', '{"format": "vibrocast measurements 1", "measured": 3}', "[" * 9999]
)
def test_another_file_is_no_earlier_run(text: str, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text(text)
    with pytest.raises(InputFileError, match="not the JSON of an earlier `vibrocast measure`"):
        results.read_results(path)


def test_the_page_needs_nothing_else_and_shows_what_is_worse(tmp_path: Path) -> None:
    document, changes = RUN.document(), results.compare(RUN.document(), RUN.document())
    page.write(tmp_path / "run.html", document, [results.Change("gain", 1.0, 0.5, True), *changes], "")
    text = (tmp_path / "run.html").read_text()
    assert "Worse beyond the tolerances: gain." in text
    assert "&lt;1&gt;" in text and "no &lt;sensor&gt;" in text
    assert text.count("<svg") == 1
    assert "src=" not in text and "<link" not in text and "<script" not in text
