"""The shipped study end to end: simulated observers and their report, and a scripted participant in Chromium."""

import csv
import json
import re
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.command import ROOT, started, succeeds

STUDY = ROOT / "examples" / "studies" / "textures_short.toml"


def shortened(folder: Path) -> Path:
    """Write the study with one texture, one repetition, short stimuli and no breaks."""
    text = re.sub(r'\[\[textures\]\]\nname = "(sandpaper|leather)"\n(.+\n)+', "", STUDY.read_text())
    for key, value in (("repetitions", 1), ("practice_trials", 1), ("break_seconds", 0), ("stimulus_seconds", 0.3)):
        text, count = re.subn(rf"^{key} = \S+", f"{key} = {value}", text, flags=re.MULTILINE)
        assert count == 1
    path = folder / "textures_short.toml"
    path.write_text(text)
    return path


def test_simulated_observers_take_part_and_are_reported(tmp_path: Path) -> None:
    out = tmp_path / "short"
    succeeds("study", "simulate", STUDY, "--participants", 3, "--out", out)
    succeeds("study", "report", out)
    assert "Simulated observers, not people" in (out / "report" / "report.html").read_text()
    document = json.loads((out / "report" / "report.json").read_text())
    assert {"means.pdf", "means.pgf", "report.tex"} <= {path.name for path in (out / "report").iterdir()}
    assert (len(document["participants"]), document["simulated"], document["method"]) == (3, True, "degradation")
    means = {(row["texture"], row["condition"]): row["mean"] for row in document["means"]}
    for texture in ("wood", "sandpaper", "leather"):
        assert means[texture, "uncompressed again"] < means[texture, "linear 4"]
    assert len(document["findings"]) == 12


def test_a_scripted_participant_takes_part_in_chromium(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "short"
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    process = started("study", "run", shortened(tmp_path), "--participant", 7, "--port", 0, "--out", out)
    assert process.stdout is not None
    try:
        address = process.stdout.readline().removeprefix("participant: ").strip()
        assert address.startswith("http://127.0.0.1:")
        with closing(browser.new_page()) as page:
            page.set_default_timeout(20_000)
            page.goto(address)
            page.get_by_role("button", name="Start the sound").click()
            page.get_by_role("button", name="Continue").click()
            page.fill("input", "thirty")
            page.click("button.main")
            expect(page.get_by_text("Stroke at the pace")).to_be_visible()
            page.get_by_role("button", name="Continue").click()
            answered = 0
            while answered < 6:
                trial = page.locator("[data-label='A']")
                rest = page.get_by_role("heading", name="Take a break")
                expect(trial.or_(rest).first).to_be_visible()
                if rest.is_visible():
                    page.get_by_role("button", name="Continue").click()
                    expect(rest).to_be_hidden()
                    continue
                for label in ("Reference", "A"):
                    button = page.locator(f"[data-label='{label}']")
                    button.click()
                    expect(button).to_have_class(re.compile("playing"))
                    expect(button).not_to_have_class(re.compile("playing"))
                assert "linear" not in page.inner_text("body"), "nobody who takes part sees a condition"
                progress = page.locator("#progress-text").inner_text()
                page.click(f"[data-choice='{answered % 4}']")
                answered += 1
                expect(page.locator("#progress-text")).not_to_have_text(progress)
            page.fill("input", "nothing")
            page.click("button.main")
            expect(page.get_by_text("Thank you")).to_be_visible()
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.communicate()
    with (out / "participant_007" / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["value"]) for row in rows] == [number % 4 for number in range(6)]
    events = [json.loads(line) for line in (out / "participant_007" / "log.jsonl").read_text().splitlines()]
    assert sum(event["event"] == "played" for event in events) == 12
    succeeds("study", "report", out)
    assert "Simulated" not in (out / "report" / "report.html").read_text()
