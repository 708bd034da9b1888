"""The Python example of the README runs as it stands."""

import re
from pathlib import Path

import pytest
import soundfile

from vibrocast.textures.generate import wood

README = Path(__file__).parents[1] / "README.md"


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(block.splitlines()) <= 15
    monkeypatch.chdir(tmp_path)
    soundfile.write("wood.wav", wood(1, 1.0).samples / 50, 2800)
    names: dict[str, object] = {}
    exec(compile(block, str(README), "exec"), names)
    size_bytes, snr_db, _, decoded_equals_offline = capsys.readouterr().out.split()
    assert int(size_bytes) == Path("wood.vct").stat().st_size
    assert float(snr_db) == pytest.approx(15, abs=0.5)
    assert decoded_equals_offline == "True"
