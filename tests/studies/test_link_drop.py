"""The page's section on a link that falls to half: what it says is what was streamed."""

from pathlib import Path

import pytest

from studies import link_drop
from vibrocast import textures


@pytest.mark.slow
def test_the_section_is_written_with_its_table_and_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_drop, "RATES_BPS", (4000,))
    section = link_drop.section([textures.GENERATORS["rough"](seconds=2.0, rate_hz=2800)], tmp_path)
    row = next(line for line in section.splitlines() if line.startswith("| 4000"))
    _, _, _, late, dropped, min_early_ms, rate, back_s = (cell.strip() for cell in row.strip("|").split("|"))
    assert (late, dropped) == ("0", "0")
    assert float(min_early_ms) > 0
    assert 0.45 < float(rate) < 0.75
    assert float(back_s) < 4
    assert (tmp_path / "results" / "link_drop.csv").read_text().count("\n") == 2
    assert (tmp_path / "results" / "link_drop.png").read_bytes().startswith(b"\x89PNG")
