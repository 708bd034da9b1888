"""The files generated from the messages are up to date; a page without a place for a table is an error."""

from pathlib import Path

import pytest

from vibrocast.device_protocol.generate import generated_files, page
from vibrocast.harness.dissector import DISSECTOR, dissector

FILES = {**generated_files(), DISSECTOR: dissector()}
HINT = "run `python -m vibrocast.device_protocol.generate` and `python -m vibrocast.harness.dissector`"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_generated_file_is_fresh(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == FILES[path], HINT


def test_page_without_a_place_for_a_table_is_named() -> None:
    with pytest.raises(ValueError, match="no place for a table: add the lines <!-- generated: requests -->"):
        page("# The wire protocol")
