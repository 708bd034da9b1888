"""The codec of another package, which the registry alone knows, in the benchmark, its page and the stability maps."""

import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from tests.command import run
from tests.evaluation.conftest import here
from vibrocast import codec, workers
from vibrocast.codec import plugins, registry
from vibrocast.evaluation import cells, cost
from vibrocast.evaluation.points import Point, read_rows
from vibrocast.evaluation.stability import maps, signals
from vibrocast.evaluation.stability.trials import Outcome, Trial
from vibrocast.textures.generate import wood

EXAMPLE = Path(__file__).parents[2] / "examples" / "codec_plugin"
NAME = "haar"


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the package of the example look installed."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    points = EntryPoints([EntryPoint(NAME, "vibrocast_haar:Haar", plugins.GROUP)])
    monkeypatch.setattr(plugins, "entry_points", lambda group: points.select(group=group))
    monkeypatch.setattr(registry, "CODECS", registry.Codecs())
    for module in (codec, maps):
        monkeypatch.setattr(module, "CODECS", registry.CODECS)


@pytest.mark.slow
def test_the_benchmark_and_the_stability_maps_take_it_as_any_other(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "on_cores", lambda tasks, processes: here(tasks))
    monkeypatch.setattr(cost, "peak_memory_bytes", lambda codec_name, model: None)
    result = run("bench", folder, "--out", tmp_path / "out", "--repeats", "1", "--codecs", f"{NAME},slp")
    assert result.exit_code == 0, result.output
    points = read_rows(tmp_path / "out" / "results" / "points.csv", Point)
    own = [point for point in points if point.codec == NAME]
    assert len(own) == 24 and max(point.snr_db or 0 for point in own) > 20
    page = (tmp_path / "out" / "results.md").read_text()
    assert f"| `{NAME}` | Haar wavelet" in page
    assert any(line.startswith(f"| {NAME} |") for line in page.splitlines())
    assert f"\n{NAME}," in (tmp_path / "out" / "results" / "speeds.csv").read_text()
    assert "decoder not counted" in (tmp_path / "out" / "results" / "costs.csv").read_text()
    (method,) = maps.methods([NAME], ())
    rate_points = (maps.three_rate_points(method)["high"],)
    assert signals.measure(Trial(NAME, "texture", rate_points=rate_points)).outcome is Outcome.HOLDS


def test_a_cell_is_measured_again_where_its_module_changes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def keys() -> list[str]:
        cells._other_packages.cache_clear()
        chosen = cells.methods([NAME, "flac"])
        return [cells.Cell("wood", wood(0, 0.1), method, method.rate_points[0], 0).key for method in chosen]

    before = keys()
    assert keys() == before
    for file in EXAMPLE.glob("vibrocast_haar*"):
        (tmp_path / file.name).write_text(file.read_text() + "# another")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "vibrocast_haar")
    assert [old == new for old, new in zip(before, keys(), strict=True)] == [False, True]
    cells._other_packages.cache_clear()
