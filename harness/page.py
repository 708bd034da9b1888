"""The report of a run as one HTML page that needs nothing else: figures in words and tables, plots inlined as SVG."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibrocast import pages
from vibrocast.evaluation import pictures
from vibrocast.files import atomic_write
from vibrocast.harness.latency import PARTS
from vibrocast.harness.results import NAMES, Change
from vibrocast.host.figures import FIGURES
from vibrocast.host.picture import STYLES
from vibrocast.output.actuator import analog_response

# From dark to light, with hatches: distinct in grey print.
_SHADES = ("#20123a", "#2a7fb8", "#7fb8d8", "#f0a030", "#d0d0d0", "#707070", "#f7d9a8", "#ffffff")
_HATCHES = ("", "//", "", "..", "", "xx", "\\\\", "")

_TITLES = {key: figure.title for key, figure in FIGURES.items()} | {
    "rate_hz": "Hz",
    "buffer_ms": "ahead, ms",
    "survived_ms": "silence survived, ms",
    "ended_by": "ended by",
}
"""Of columns, by their keys; others have their key for a title."""
_OF_DEVICE = ("build", "hardware", "serial_number", "protocol")


def write(path: Path, document: dict[str, Any], changes: Sequence[Change], actuator_table: str) -> None:
    """Write the page of a run (harness.results). `changes`: against an earlier run. Raises OSError.

    `actuator_table`: the fitted actuator as a table of a bench file, empty where none was fitted.
    """
    device, measured = document["device"], {name: document["measured"].get(name) for name in NAMES}
    latency, fidelity, fitted = (measured[name] for name in ("latency", "fidelity", "response"))
    plots = {
        "latency": latency and _latency(latency),
        "fidelity": [_spectrum(texture) for texture in fidelity or ()],
        "response": fitted and _response(fitted),
    }
    facts = {key: device[key] for key in _OF_DEVICE if key in device} | document["host"] | _origin(document["run"])
    page = pages.render(
        Path(__file__).with_name("measured.html.jinja"),
        device=device,
        facts=[{"what": what, "which": which} for what, which in facts.items()],
        changes=[asdict(change) for change in changes],
        measured=measured,
        meanings=PARTS,
        plots=plots,
        failed=document["failed"],
        missed=document["missed"],
        actuator_table=actuator_table,
        figure=_number,
        titles=_TITLES,
        fidelity=[_fidelity_row(each) for each in fidelity or ()],
    )
    with atomic_write(path) as partial:
        partial.write_text(page, encoding="utf-8")


def _fidelity_row(texture: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a texture by their keys."""
    report = texture["report"]
    return {
        "texture": report["file"],
        "as_decoded": report["decoded_equals_offline"],
        "as_computed": report["dac_equals_offline"],
        "coding_snr_db": report["quality"]["snr_db"],
        **report["quality"]["skin"],
        "drift_ppm": texture["drift_ppm"],
    }


def _origin(run: dict[str, Any]) -> dict[str, str]:
    """Return what identifies a run."""
    return {"date": run["date"], "run": run["run_id"], "bench file, SHA-256": run["bench_sha256"] or "none"}


def _number(value: object) -> object:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.4g}" if isinstance(value, float) else value


def _figure(draw: Callable[[Axes], None], height_in: float = 3.2) -> str:
    figure = Figure(figsize=(9.5, height_in), layout="constrained")
    axes = figure.subplots()
    draw(axes)
    return pictures.inlined(figure)


def _latency(latency: dict[str, Any]) -> str:
    """Return the plot of the parts, one behind the other."""
    parts = latency["parts"]

    def draw(axes: Axes) -> None:
        start_ms = 0.0
        for (name, part), shade, hatch in zip(parts.items(), _SHADES, _HATCHES, strict=True):
            width_ms = max(0.0, part["median_ms"])
            axes.barh(
                0, width_ms, left=start_ms, color=shade, hatch=hatch, edgecolor="#202020", linewidth=0.6, label=name
            )
            start_ms += width_ms
        axes.axvline(30, color="#707070", linestyle=":")
        axes.set_xlim(0, max(32.0, start_ms * 1.05))
        axes.set_yticks([])
        axes.set_xlabel("ms from a block's last sample at the host (dotted: 30 ms)")
        figure = axes.get_figure()
        assert figure is not None, "it has been drawn on"
        figure.legend(ncols=len(parts), fontsize="small", loc="outside upper center", frameon=False)

    return _figure(draw, 1.7)


def _spectrum(texture: dict[str, Any]) -> str:
    """Return the plot of a texture's third octaves: what was sent, and what differs at the skin."""
    spectrum = texture["spectrum"]

    def plot(axes: Axes) -> None:
        axes.semilogx(spectrum["frequencies_hz"], spectrum["sent_db"], label="sent", **STYLES[0])
        axes.semilogx(spectrum["frequencies_hz"], spectrum["residual_db"], label="residual", **STYLES[1])
        axes.set_xlabel("Hz")
        axes.set_ylabel("third octaves, dB re 1 um")
        axes.set_title(texture["report"]["file"], parse_math=False, fontsize="medium", loc="left")
        axes.legend(frameon=False)
        axes.grid(alpha=0.3)

    return _figure(plot)


def _response(measured: dict[str, Any]) -> str:
    """Return the plot of a frequency response, measured and fitted."""
    curve, fit = measured["curve"], measured["fit"]

    def draw(axes: Axes) -> None:
        frequencies_hz = np.array(curve["frequencies_hz"])
        shape = np.abs(analog_response(frequencies_hz, fit["corner_hz"], fit["quality"])) * fit["stroke_um"] / 2
        axes.semilogx(frequencies_hz, curve["gain_db"], label="measured", **STYLES[0])
        axes.semilogx(frequencies_hz, 20 * np.log10(shape), label="fitted", **STYLES[1])
        axes.set_xlabel("Hz")
        axes.set_ylabel("dB re 1 um at full drive")
        axes.legend(frameon=False)
        axes.grid(alpha=0.3)

    return _figure(draw)
