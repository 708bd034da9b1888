"""Tests of kinds of textures by a table of files."""

from pathlib import Path

import pytest

from vibrocast.errors import InputError
from vibrocast.evaluation.kinds import kinds
from vibrocast.textures.dataset import DatasetEntry

TRACES = [
    DatasetEntry(name, Path("set") / name)
    for name in ("lmt-Brick.wav", "Direct_-_Probe_-_cork_-_slow", "textsense-1.wav", "vibtac12-3.wav", "other.wav")
]


def test_known_sets_are_known_by_their_names() -> None:
    found = {row.trace: row.kind for row in kinds(TRACES)}
    assert list(found.values()) == ["tool", "tool", "fingertip", "probe"] and "other.wav" not in found


def test_a_manifest_names_kinds_by_the_ends_of_paths(tmp_path: Path) -> None:
    table = tmp_path / "manifest.csv"
    table.write_text('file,rate_hz,kind\nset/other.wav,2800,"acceleration, tool"\n*.wav,2800,sound\n,1,none\n')
    found = {row.trace: row.kind for row in kinds(TRACES[2:], table)}
    assert found == {"textsense-1.wav": "sound", "vibtac12-3.wav": "sound", "other.wav": "acceleration, tool"}
    table.write_text("a,b\n")
    with pytest.raises(InputError, match="no column file, kind"):
        kinds(TRACES, table)
