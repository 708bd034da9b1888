"""The report of a study: every method's tables and charts, flaws of the files, and findings that claim no sameness."""

import csv
import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from scipy import stats

from tests.study.small_study import stimuli_of, study_of
from vibrocast.errors import InputError
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.study import analysis, stimuli
from vibrocast.study.report import write_report
from vibrocast.study.session import LOG, RESULTS, RUN
from vibrocast.study.simulation import SIMULATED, SkinOf, simulate_participant
from vibrocast.study.study_file import METHODS, read_study
from vibrocast.study.trials import RESULT_COLUMNS

PARTICIPANTS = 4
SIMULATION = "Simulated observers, not people"
Row = dict[str, str]
_KEPT = TemporaryDirectory(prefix="vibrocast_report_")  # removed when the tests end


@cache
def simulated(method: str) -> Path:
    """Return a results folder with simulated observers; tests change copies of it."""
    folder = Path(_KEPT.name) / method
    folder.mkdir()
    study = study_of(folder, method)
    prepared = stimuli_of(method, folder)
    out = folder / "results"
    stimuli.save(out / analysis.STIMULI, prepared, PIEZO_STACK)
    shutil.copy(folder / f"{method}.toml", out / analysis.STUDY_FILE)
    skin_of = SkinOf(prepared, PIEZO_STACK)
    for number in range(1, PARTICIPANTS + 1):
        simulate_participant(study, prepared, skin_of, number, out / f"participant_{number:03}")
    return out


def copied(tmp_path: Path, method: str = "degradation") -> Path:
    """Return a copy of the results of a method."""
    folder = tmp_path / "results"
    shutil.copytree(simulated(method), folder)
    return folder


def change(folder: Path, value_of: Callable[[Row], object]) -> None:
    """Give every answer of all participants another value."""
    for path in folder.glob(f"participant_*/{RESULTS}"):
        with path.open(newline="") as file:
            rows = [{**row, "value": str(value_of(row))} for row in csv.DictReader(file)]
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, RESULT_COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def graded(folder: Path, grades: dict[str, list[int]]) -> None:
    """Let each participant give these grades to the conditions, of all textures."""
    change(folder, lambda row: grades[row["condition"]][int(row["participant"]) - 1])


TABLES = {
    "degradation": {"means", "tests", "power", "correlations"},
    "mushra": {"means", "tests", "power", "correlations"},
    "same_different": {"sensitivities"},
    "abx": {"sensitivities"},
    "two_alternative": {"sensitivities"},
    "paired_comparison": {"preferences"},
    "staircase": {"thresholds", "mean_thresholds"},
}


@pytest.mark.parametrize(
    "method", [method if method == "mushra" else pytest.param(method, marks=pytest.mark.slow) for method in METHODS]
)
def test_each_method_has_its_tables_and_charts(method: str, tmp_path: Path) -> None:
    page = write_report(simulated(method), tmp_path / "report")
    text = page.read_text()
    document = json.loads((page.parent / "report.json").read_text())
    assert TABLES[method] | {"stimuli", "played", "participants"} <= set(document)
    assert {path.stem for path in page.parent.glob("*.csv")} <= set(document)
    with (page.parent / "stimuli.csv").open(newline="") as file:
        assert all(len(row["stream_sha256"]) == 64 and row["level_db"] for row in csv.DictReader(file))
    assert document["simulated"] is True
    assert all(each["whole"] for each in document["participants"])
    assert SIMULATION in text.partition("</title>")[0]
    assert text.count(">" + SIMULATION) == text.count("<svg") + 1  # in each chart, and above the findings
    assert "http" not in text.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    ).replace("https://matplotlib.org", "")
    assert document["findings"] and not any(" same " in each for each in document["findings"])


def test_tests_are_paired_and_corrected(tmp_path: Path) -> None:
    folder = copied(tmp_path)
    grades = {"recording again": [0, 0, 1, 0], "fine": [0, 1, 1, 1], "coarse": [3, 3, 3, 2]}
    graded(folder, grades)
    read = analysis.analyse(folder)
    group = {each.condition: each for each in read.ratings if each.texture == "wood"}
    for name in ("fine", "coarse"):
        test = group[name].test
        expected = stats.ttest_rel(grades[name], grades["recording again"])
        assert test is not None
        assert (test.t, test.p) == pytest.approx((expected.statistic, expected.pvalue))
    assert group["coarse"].test is not None
    assert group["coarse"].test.holm_p == pytest.approx(2 * (group["coarse"].test.p or 0))
    assert group["fine"].counts == (1, 3, 0, 0)
    coarse, fine = (next(line for line in analysis.findings(read) if f"wood, {name}:" in line) for name in
                    ("coarse", "fine"))  # fmt: skip
    assert ": noticed. The mean differs by +2.50 (" in coarse
    assert ": not shown to be noticed. The mean differs by +0.50 (" in fine
    assert "4 participants find an effect of d = " in fine
    graded(folder, {"recording again": [2, 3, 2, 3], "fine": [0, 0, 0, 1], "coarse": [3, 3, 2, 3]})
    line = next(line for line in analysis.findings(analysis.analyse(folder)) if "wood, fine:" in line)
    assert "rated better than the hidden reference" in line


def test_correlations_count_every_rated_stimulus_but_the_hidden_reference() -> None:
    read = analysis.analyse(simulated("mushra"))
    assert read.correlations is not None
    means = {(each.texture, each.condition): each.mean.value for each in read.ratings}
    rated = [each for each in read.stimuli if each.role in ("condition", "anchor")]
    correlation = read.correlations["third_octave_db"]
    assert correlation.count == len(rated) == 8
    expected = stats.pearsonr(
        [each.facts["third_octave_db"] for each in rated], [means[each.texture, each.condition] for each in rated]
    )
    assert correlation.pearson.value == pytest.approx(expected.statistic)


@pytest.mark.slow
def test_people_are_not_called_simulated_a_mixture_is_named_and_no_name_breaks_the_page(tmp_path: Path) -> None:
    folder = copied(tmp_path)
    study = folder / analysis.STUDY_FILE
    study.write_text(study.read_text().replace("A small study", "<script>alert(1)</script>"))
    sha256 = read_study(study, with_files=False).sha256
    for simulators, said in (
        (4, f">{SIMULATION}"),
        (3, "3 of 4 participants are simulated observers, not people"),
        (0, ""),
    ):
        for number, path in enumerate(sorted(folder.glob(f"participant_*/{RUN}"))):
            device = SIMULATED if number < simulators else "sim"
            path.write_text(json.dumps(json.loads(path.read_text()) | {"study_sha256": sha256, "device": device}))
        text = write_report(folder, tmp_path / "report").read_text()
        assert said in text and "<script>" not in text
        assert write_report(folder, tmp_path / "again").read_text() == text
    assert SIMULATION not in text


DAMAGES: dict[str, Callable[[str], str]] = {
    "cut": lambda line: line[: len(line) // 2],
    "a grade out of range": lambda line: line.replace(",same,0,", ",same,9,").replace(",different,3,", ",different,9,"),
    "not a number": lambda line: line.replace(",0,", ",nan,").replace(",3,", ",nan,"),
    "another study": lambda line: "other" + line,
    "an unknown texture": lambda line: line.replace(",wood,", ",iron,").replace(",rough,", ",iron,"),
    "a zero byte": lambda line: "\0" * len(line),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_line_is_left_out_with_a_warning(name: str, tmp_path: Path) -> None:
    folder = copied(tmp_path)
    path = folder / "participant_002" / RESULTS
    lines = path.read_text().splitlines()
    place = next(number for number, line in enumerate(lines) if ",main," in line and DAMAGES[name](line) != line)
    lines[place] = DAMAGES[name](lines[place])
    path.write_text("\n".join(lines) + "\n")
    read = analysis.analyse(folder)
    assert "participant 2: 1 damaged or repeated line(s) of results.csv left out" in read.warnings
    assert any(line.startswith("participant 2: not finished, ") for line in read.warnings)
    assert [each.is_whole for each in read.participants] == [True, False, True, True]


def test_a_repeated_line_counts_once(tmp_path: Path) -> None:
    folder = copied(tmp_path)
    path = folder / "participant_001" / RESULTS
    path.write_text(path.read_text() + path.read_text().splitlines()[-1] + "\n")
    read = analysis.analyse(folder)
    assert len(read.warnings) == 1 and "1 damaged or repeated" in read.warnings[0]
    assert read.ratings == analysis.analyse(simulated("degradation")).ratings


def test_an_unfinished_staircase_is_marked(tmp_path: Path) -> None:
    folder = copied(tmp_path, "staircase")
    path = folder / "participant_003" / RESULTS
    path.write_text("\n".join(path.read_text().splitlines()[:3]) + "\n")
    read = analysis.analyse(folder)
    assert any(line.startswith("participant 3: not finished, ") for line in read.warnings)
    assert [each.is_whole for each in read.participants] == [True, True, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_one_participant_has_a_report_without_tests_also_without_answers(method: str, tmp_path: Path) -> None:
    folder = copied(tmp_path, method)
    for number in range(2, PARTICIPANTS + 1):
        shutil.rmtree(folder / f"participant_{number:03}")
    text = write_report(folder, tmp_path / "report").read_text()
    assert ("too few answers for a test" in text) == (method in ("degradation", "mushra"))
    (folder / "participant_001" / RESULTS).write_text(",".join(RESULT_COLUMNS) + "\n")
    assert write_report(folder, tmp_path / "empty").exists()


FLAWS: dict[str, tuple[Callable[[Path], object], str]] = {
    "two studies": (
        lambda folder: (folder / analysis.STUDY_FILE).write_text(
            (folder / analysis.STUDY_FILE).read_text() + "# other"
        ),
        "another study file; move that folder away",
    ),
    "a copy": (
        lambda folder: shutil.copytree(folder / "participant_002", folder / "participant_2 copy"),
        "participant 2 is there twice",
    ),
    "other columns": (lambda folder: (folder / "participant_001" / RESULTS).write_text("a,b\n1,2\n"), "other columns"),
    "zeros": (lambda folder: (folder / "participant_001" / RESULTS).write_text("\0\0\0\0"), "other columns"),
    "no results": (shutil.rmtree, "no results of a study"),
}


@pytest.mark.parametrize("name", FLAWS)
def test_a_folder_that_holds_no_results_of_one_study_is_rejected(name: str, tmp_path: Path) -> None:
    folder = copied(tmp_path)
    change_folder, message = FLAWS[name]
    change_folder(folder)
    with pytest.raises(InputError, match=message):
        analysis.analyse(folder)


def test_the_log_shows_what_was_played(tmp_path: Path) -> None:
    folder = copied(tmp_path)
    path = folder / "participant_001" / LOG
    events = [json.loads(line) for line in path.read_text().splitlines()]
    played = next(event for event in events if event["event"] == "played" and event["stimulus"] == "wood/coarse")
    extra = played | {"stream_sha256": "0" * 64, "limited": 70, "underruns": 2, "latency_ms": 30.0}
    path.write_text(path.read_text() + json.dumps(extra) + '\n{"event": "device failed"}\n{"event": "pla')
    read = analysis.analyse(folder)
    rows = {row["stimulus"]: row for row in analysis.tables(read)["played"]}
    assert rows["wood/coarse"]["presentations"] == PARTICIPANTS + 1
    assert rows["wood/coarse"] | {"limited_samples_most": 70, "underruns": 2, "other_stream": 1} == rows["wood/coarse"]
    assert rows["wood/fine"]["other_stream"] == 0
    assert "participant 1: the device failed 1 time(s)" in read.warnings


def test_a_listener_who_misses_the_hidden_reference_is_left_out(tmp_path: Path) -> None:
    folder = copied(tmp_path, "mushra")
    hidden = [95, 50, 95, 95]
    change(folder, lambda row: hidden[int(row["participant"]) - 1] if row["condition"] == "recording again" else 40)
    read = analysis.analyse(folder)
    assert list(read.excluded) == [2]
    assert all(2 not in each.by_participant for each in read.ratings)
    assert "Participant 2 is left out" in write_report(folder, tmp_path / "report").read_text()


def test_preferences_rank_the_winner_first_with_intervals(tmp_path: Path) -> None:
    folder = copied(tmp_path, "paired_comparison")
    order = ("recording", "fine", "coarse")
    change(folder, lambda row: int(order.index(row["condition"]) > order.index(row["comparison"])))
    read = analysis.analyse(folder)
    assert "wood, most preferred first: recording, fine, coarse." in analysis.findings(read)
    for each in read.preferences:
        assert each.strength.low is not None and each.strength.high is not None and each.strength.value is not None
        assert each.strength.low - 1e-9 <= each.strength.value <= each.strength.high + 1e-9


def test_the_report_in_the_pages_is_of_the_present_example() -> None:
    root = Path(__file__).parents[2]
    sha256 = read_study(root / "examples/studies/textures_short.toml").sha256
    assert sha256[:16] in (root / "docs/benchmarks/results/rehearsal_report.html").read_text(encoding="utf-8")
