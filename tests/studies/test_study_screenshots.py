"""The screenshots of a study's pages: small, and taken again by the script."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from studies import study_screenshots
from tests.study.stub_run import chromium

MOST_BYTES = 60_000
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize("name", study_screenshots.SCREENSHOTS)
def test_the_stored_screenshot_is_small(name: str) -> None:
    stored = (study_screenshots.FIGURES / f"{name}.png").read_bytes()
    assert stored.startswith(PNG)
    assert len(stored) < MOST_BYTES


@pytest.mark.slow
@pytest.mark.skipif(chromium() is None, reason="needs Chromium: Debian's package chromium")
def test_the_script_takes_them_again(tmp_path: Path) -> None:
    taken = CliRunner().invoke(study_screenshots.main, ["--out", str(tmp_path)])
    assert taken.exit_code == 0, taken.output
    assert {path.stem for path in tmp_path.iterdir()} == set(study_screenshots.SCREENSHOTS)
    assert all(path.read_bytes().startswith(PNG) for path in tmp_path.iterdir())
