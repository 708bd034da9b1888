"""The answer of the planner as text and JSON."""

import json
from dataclasses import replace
from pathlib import Path

from tests.planner.scenes import scene
from vibrocast.planner import page
from vibrocast.planner.choose import plan


def test_the_answer_begins_with_the_choice_and_fits_a_terminal(tmp_path: Path) -> None:
    read = scene(tmp_path)
    (choice,) = plan(read)
    lines = page.summary(read.asked, choice).splitlines()
    assert lines[0] == f"wood: {choice.chosen.measured.option.name}"
    labels = [line[:14].strip() for line in lines[1:] if line[:14].strip()]
    assert labels == ["why", "settings", "bit rate", "quality", "delay", "controller", *["rejected"] * 3]
    assert len(lines) <= 14 and max(map(len, lines)) <= 80
    told = json.loads(json.dumps(page.document(read.asked, choice), allow_nan=False))
    measured = choice.chosen.measured
    assert (told["choice"]["codec"], told["choice"]["setting"]) == (measured.option.codec, measured.setting)
    texture = replace(choice.subject.texture, name="wood \x1b[2J " * 12)
    renamed = replace(choice, subject=replace(choice.subject, texture=texture))
    lines = page.summary(read.asked, renamed).splitlines()
    assert "\\x1b" in lines[0] and lines[1].startswith(("  wood", "  \\x1b"))
    assert max(map(len, lines)) <= 80
