"""The answer of the planner as text and JSON."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.planner.scenes import scene
from vibrocast.planner import page
from vibrocast.planner.choose import plan


def test_the_answer_begins_with_the_choice_and_fits_a_terminal(tmp_path: Path) -> None:
    read = scene(tmp_path)
    planned, (choice,) = plan(read)
    (texture,) = planned.textures
    lines = page.summary(read.asked, choice, texture).splitlines()
    assert lines[0] == f"wood: {choice.chosen.measured.option.name}"
    labels = [line[:14].strip() for line in lines[1:] if line[:14].strip()]
    assert labels == ["why", "settings", "bit rate", "quality", "delay", "controller", *["rejected"] * 3]
    assert len(lines) <= 14 and max(map(len, lines)) <= 80
    told = json.loads(json.dumps(page.document(choice, texture), allow_nan=False))
    assert (told["choice"]["codec"], told["choice"]["setting"]) == (texture.codec, texture.setting)
    assert [each["rejected"] for each in told["alternatives"]] == [each.why for each in choice.alternatives]
    fields = {name: getattr(texture, name) for name in texture.__struct_fields__}
    renamed: Any = SimpleNamespace(**fields | {"name": "wood \x1b[2J " * 12})
    lines = page.summary(read.asked, choice, renamed).splitlines()
    assert "\\x1b" in lines[0] and lines[1].startswith(("  wood", "  \\x1b"))
    assert max(map(len, lines)) <= 80
