"""Every study, at its smallest: it writes its page, its tables and its charts, and stored pages show stored tables."""

import ast
import importlib
import json
import runpy
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from tests import lint
from vibrocast import codec, pages, textures
from vibrocast.evaluation import cost, points
from vibrocast.harness.latency import MinLatency
from vibrocast.output.actuator import VOICE_COIL
from vibrocast.simulated_device.serial_port import has_pseudo_terminals

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "docs" / "benchmarks"
needs_compiler = pytest.mark.skipif(find_spec("ziglang") is None, reason="no compiler for microcontrollers")
needs_terminals = pytest.mark.skipif(not has_pseudo_terminals(), reason="no pseudo-terminals")


def is_run(path: Path) -> bool:
    """Return whether a file has a part that runs only as a program."""
    return any(
        isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'"
        for node in ast.parse(path.read_text(encoding="utf-8")).body
    )


PROGRAMS = [path for path in lint.tracked("*.py", ":!tests") if is_run(ROOT / path)]


def test_programs_are_found() -> None:
    assert {"studies/latency.py", "hatch_build.py"} <= set(PROGRAMS)


@pytest.mark.slow
@pytest.mark.parametrize("path", PROGRAMS)
def test_help_is_all_that_a_program_does(
    path: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(*_arguments: object, **_options: object) -> None:
        raise AssertionError("a file is written")

    monkeypatch.setattr(Path, "write_text", write)
    monkeypatch.setattr(Path, "write_bytes", write)
    monkeypatch.setattr(sys, "argv", [path, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / path), run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out.lower().startswith("usage: ")


@dataclass(frozen=True)
class Case:
    """A study at its smallest: arguments, where "FOLDER" is one of recordings, and smaller constants of its module.

    `page`: its name, if it is another than the module's. `tables`: the rows that each must have. `charts`: in results.
    """

    module: str
    tables: Mapping[str, int] = field(default_factory=dict)
    arguments: Sequence[str] = ()
    constants: Mapping[str, Any] = field(default_factory=dict)
    page: str = ""
    charts: Sequence[str] = ()


CASES = (
    Case(
        "rate_control",
        {},
        ("FOLDER",),
        {"RATES_BPS": (1000, 8000)},
        page="further_results",
        charts=("rate_control_codecs.png",),
    ),
    Case(
        "texture_paper",
        {"texture_paper": 3 * (3 * 7 + 9), "texture_paper_spectra": 3 * 160, "texture_paper_recordings": 18},
        ("--recordings", "FOLDER"),
        {"LEVELS": (14, 12, 10, 8, 6, 5, 4)},
        page="papers",
        charts=("texture_paper.png", "texture_paper_spectra.png"),
    ),
    Case(
        "okamoto_study",
        {"simulated_study": 51, "simulated_study_sensitivity": 6 * 3},
        constants={"STUDIES": 2, "PARTICIPANTS": 6},
        page="papers",
        charts=("simulated_study.svg", "simulated_study_sensitivity.svg"),
    ),
    Case("planning", {"planning": 2}, ("FOLDER",), page="further_results"),
    pytest.param(
        Case(
            "latency",
            {"latency": 10 + 6},
            constants={"ADDRESSES": ("sim",), "RUNS": 1, "find_min_latency": lambda *_: MinLatency(None, ())},
        ),
        marks=needs_terminals,
    ),
    Case("board_latency", {"board_latency": 8}, constants={"ACTUATORS": (VOICE_COIL,)}, page="latency"),
)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.module)
def test_a_study_writes_its_page_tables_and_charts(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = importlib.import_module(f"studies.{case.module}")
    for name, value in case.constants.items():
        monkeypatch.setattr(study, name, value)
    folder, results = tmp_path / "recordings", tmp_path / "out" / "results"
    folder.mkdir()
    textures.save(folder / "rough.wav", textures.GENERATORS["rough"](seconds=1.0, rate_hz=2800))
    arguments = [str(folder) if each == "FOLDER" else each for each in case.arguments]
    done = CliRunner().invoke(study.main, [*arguments, "--out", str(results.parent)])
    assert done.exit_code == 0, done.output
    page = (results.parent / f"{case.page or case.module}.md").read_text()
    assert f"python -m studies.{case.module}" in page
    assert page.splitlines()[-1].startswith(pages.FIGURES)
    for table, rows in case.tables.items():
        assert len((results / f"{table}.csv").read_text().splitlines()) == 1 + rows, table
    for chart in case.charts:
        assert (results / chart).stat().st_size > 1000


@needs_compiler
@pytest.mark.parametrize("name", ["firmware", "worst_case"])
def test_a_stored_page_shows_its_stored_tables(name: str, tmp_path: Path) -> None:
    shutil.copytree(BENCHMARKS, tmp_path, dirs_exist_ok=True)
    main = importlib.import_module(f"studies.{name}").main
    done = CliRunner().invoke(main, ["--out", str(tmp_path), "--from-tables"])
    assert done.exit_code == 0, done.output
    stored, drawn = ((folder / "firmware.md").read_text() for folder in (BENCHMARKS, tmp_path))
    assert stored == drawn, f"run `python -m studies.{name} --from-tables`"


def test_the_stored_tables_keep_what_their_pages_promise() -> None:
    """An alarm in each run with a fault, its true cause in nine of ten, and a page that shows them."""
    from studies import faulty_bench, injected_faults

    def stored(name: str, kind: type[points.Row]) -> list[points.Row]:
        return points.read_rows(BENCHMARKS / "results" / name, kind)

    noticed = stored(injected_faults.TABLE, injected_faults.Noticed)
    faults = [(each.place, each.fault) for each in faulty_bench.FAULTS]
    assert list(dict.fromkeys((row.place, row.fault) for row in noticed)) == faults
    assert all(row.alarm != injected_faults.NO_ALARM for row in noticed)
    clean = stored(injected_faults.CLEAN_TABLE, injected_faults.Clean)
    assert injected_faults.rendered(noticed, clean) in (BENCHMARKS / "stability.md").read_text()


@pytest.mark.slow
@needs_terminals
def test_faults_of_actuator_and_sensor_are_noticed(tmp_path: Path) -> None:
    """A busy machine makes those of wire, host and device look like others; the stored table has them."""
    from studies import faulty_bench, injected_faults

    chosen = {each.place: each for each in faulty_bench.FAULTS if each.place in injected_faults.SENSED}
    noticed = list(injected_faults.notice(list(chosen.values()), tmp_path, runs=1))
    assert [each.place for each in noticed] == list(chosen)
    assert all(each.alarm != injected_faults.NO_ALARM and each.is_named and each.reason for each in noticed)


@pytest.mark.slow
@needs_compiler
def test_the_shipped_sizes_are_those_that_the_core_compiles_to(tmp_path: Path) -> None:
    """To a twentieth, as compilers differ."""
    from studies import decoder_sizes

    done = CliRunner().invoke(decoder_sizes.main, ["--out", str(tmp_path / "sizes.json")])
    assert done.exit_code == 0, done.output
    counted = json.loads((tmp_path / "sizes.json").read_text())
    shipped = json.loads(cost.DECODER_SIZES.read_text(encoding="utf-8"))
    assert set(counted) == {*codec.CODECS, *codec.PEERS}
    in_core = [name for name, size in counted.items() if size["note"].startswith("for Cortex-M4")]
    assert {"mdct", "slp", "dct", "eva", "parametric"} <= set(in_core)
    for name in in_core:
        assert shipped[name]["bytes"] == pytest.approx(counted[name]["bytes"], rel=0.05)
