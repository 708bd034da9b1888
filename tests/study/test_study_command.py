"""The subcommand `study`: check, run in the terminal, simulate and report."""

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


def test_check_lists_the_stimuli_or_rejects_what_cannot_be_compared(study_path: Path) -> None:
    told = command.succeeds("study", "check", study_path)
    assert "wood/coarse" in told and "8 stimuli can be compared on piezo-stack" in told
    text = study_path.read_text()
    study_path.write_text(text.replace("gain_db = -12", "gain_db = -70"))
    assert command.fails(2, "study", "check", study_path).startswith("error: rough: nobody would feel")
    study_path.write_text(text.replace('actuator = "piezo-stack"\n', ""))
    assert "name one by the key actuator of the study file" in command.fails(2, "study", "check", study_path)


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


def test_only_one_study_goes_into_a_folder_and_only_its_results_are_reported(study_path: Path, tmp_path: Path) -> None:
    assert "no results of a study" in command.fails(2, "study", "report", tmp_path)
    simulate = ("study", "simulate", study_path, "--participants", "1", "--out", tmp_path / "out")
    command.succeeds(*simulate)
    study_path.write_text(study_path.read_text() + "\n# changed\n")
    assert "another study file" in command.fails(2, *simulate)
