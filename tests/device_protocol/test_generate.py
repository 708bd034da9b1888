"""The files generated from the messages are up to date; a page without a place for a table is an error."""

from pathlib import Path

import pytest

from vibrocast.device_protocol import generate
from vibrocast.device_protocol.generate import generated_files, page

HINT = "run `python -m vibrocast.device_protocol.generate`"


@pytest.mark.parametrize("path", generated_files(), ids=lambda path: str(path.relative_to(generate.ROOT)))
def test_generated_file_is_fresh(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == generated_files()[path], HINT


def test_page_without_a_place_for_a_table_is_named() -> None:
    with pytest.raises(ValueError, match="no place for a table: add the lines <!-- generated: requests -->"):
        page("# The wire protocol")
