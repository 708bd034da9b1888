"""The subcommand `study`: check, run in the terminal, simulate and report."""

import json
from functools import partial
from pathlib import Path

import pytest

from tests import command
from tests.study.small_study import text_of

run = partial(command.run, "study")


@pytest.fixture
def study_path(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(text_of("degradation"))
    return path


def test_check_lists_the_stimuli(study_path: Path) -> None:
    result = run("check", study_path)
    assert result.exit_code == 0, result.stderr
    assert "wood/coarse" in result.stdout
    assert "8 stimuli can be compared on piezo-stack" in result.stdout


def test_check_rejects_what_cannot_be_compared(study_path: Path) -> None:
    study_path.write_text(study_path.read_text().replace("gain_db = -12", "gain_db = -70"))
    result = run("check", study_path)
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1].startswith("error: rough: nobody would feel")


def test_a_study_without_an_actuator_asks_for_one(study_path: Path) -> None:
    study_path.write_text(study_path.read_text().replace('actuator = "piezo-stack"\n', ""))
    result = run("check", study_path)
    assert result.exit_code == 2
    assert "name one by the key actuator of the study file" in result.stderr


def test_a_participant_answers_in_the_terminal(study_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = "run", study_path, "--participant", "3", "--terminal", "--device", "sim", "--out", out
    trial = "9\np R\np A\np x\n2\n"
    result = run(*arguments, data=f"\n\n{trial}q\n".encode())
    assert result.exit_code == 130, "the input has ended"
    assert "A not played yet" not in result.stdout
    assert "does not fit" in result.stdout or "not played yet" in result.stdout
    assert "there is no interval" in result.stdout
    results = out / "participant_003" / "results.csv"
    assert len(results.read_text().splitlines()) == 2
    result = run(*arguments, data=b"\n" + b"p R\np A\n1\n" * 5)
    assert result.exit_code == 0, result.stderr
    assert "Thank you" in result.stdout
    rows = results.read_text().splitlines()
    assert len(rows) == 7
    assert ",possibly same,1," in rows[1]


def test_simulated_observers_answer_and_the_report_says_so(study_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run("simulate", study_path, "--participants", "4", "--out", out)
    assert result.exit_code == 0, result.stderr
    assert len(list(out.glob("participant_*/results.csv"))) == 4
    assert len(list((out / "stimuli").glob("*.vct"))) == 8
    result = run("report", out)
    assert result.exit_code == 0, result.stderr
    assert "Simulated observers, not people" in (out / "report" / "report.html").read_text()
    document = json.loads((out / "report" / "report.json").read_text())
    assert document["simulated"] is True
    assert any(line.startswith("wood, coarse: ") for line in document["findings"])


def test_another_study_file_does_not_go_into_the_same_folder(study_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run("simulate", study_path, "--participants", "1", "--out", out).exit_code == 0
    study_path.write_text(study_path.read_text() + "\n# changed\n")
    changed = run("simulate", study_path, "--participants", "1", "--out", out)
    assert changed.exit_code == 2
    assert "another study file" in changed.stderr


def test_a_folder_without_results_has_no_report(tmp_path: Path) -> None:
    result = run("report", tmp_path)
    assert result.exit_code == 2
    assert "no results of a study" in result.stderr
