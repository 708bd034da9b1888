"""The report of a run as one HTML page that needs nothing else: figures in words and tables, plots inlined as SVG."""

import html
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from vibrocast.files import atomic_write
from vibrocast.host.harness import response
from vibrocast.host.harness.latency import PARTS
from vibrocast.host.harness.results import Change
from vibrocast.host.picture import STYLES

# From dark to light, with hatches: told apart in grey print.
_SHADES = ("#20123a", "#2a7fb8", "#7fb8d8", "#f0a030", "#d0d0d0", "#707070", "#f7d9a8", "#ffffff")
_HATCHES = ("", "//", "", "..", "", "xx", "\\\\", "")

_COMPARED = (
    "It is compared as displacement above 20 Hz. A texture in m/s^2 is coded as acceleration; integrated twice, the "
    "codec's noise at low frequencies weighs most, so the second SNR of the codec is less than the first. It is the "
    "most that the skin can have; the last SNR leaves the codec out."
)
_STYLE = """
body { font: 16px/1.45 sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #202020 }
table { border-collapse: collapse; margin: .8rem 0 } td, th { padding: .15rem .8rem .15rem 0; text-align: right }
td:first-child, th:first-child { text-align: left } th { border-bottom: 1px solid #202020 }
svg { max-width: 100%; height: auto } pre { background: #f0f0f0; padding: .6rem }
.bad { font-weight: bold; text-decoration: underline }
"""


def write(path: Path, document: dict[str, Any], changes: Sequence[Change], actuator_table: str) -> None:
    """Write the page of a run (host.harness.results). `changes`: against an earlier run. Raises OSError.

    `actuator_table`: the fitted actuator as a table of a bench file, empty where none was fitted.
    """
    device, measured = document["device"], document["measured"]
    title = f"{device['name']} at {device['address']}"
    body = [f"<h1>Measured: {_text(title)}</h1>", _device(document)]
    sections: dict[str, Callable[[Any], str]] = {
        "latency": _latency,
        "smallest": _smallest,
        "throughput": _throughput,
        "load": _load,
        "gap": _gap,
        "fidelity": _fidelity,
        "response": lambda response: _response(response, actuator_table),
        "together": _together,
    }
    if changes:
        body.append(_changes(changes))
    body += [draw(measured[name]) for name, draw in sections.items() if measured.get(name)]
    body += [
        f"<p class=bad>{_text(name)} was not measured: {_text(why)}</p>" for name, why in document["failed"].items()
    ]
    page = (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{_text(title)}</title>"
        f"<style>{_STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )
    with atomic_write(path) as partial:
        partial.write_text(page, encoding="utf-8")


def _text(value: object) -> str:
    return html.escape(str(value))


def _table(
    header: Sequence[str], rows: Sequence[Sequence[object]], bad: Callable[[int], bool] = lambda row: False
) -> str:
    head = "".join(f"<th>{_text(cell)}</th>" for cell in header)
    lines = [
        f"<tr{' class=bad' if bad(number) else ''}>{''.join(f'<td>{_text(_number(cell))}</td>' for cell in row)}</tr>"
        for number, row in enumerate(rows)
    ]
    return f"<table><tr>{head}</tr>{''.join(lines)}</table>"


def _number(value: object) -> object:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.4g}" if isinstance(value, float) else value


def _figure(draw: Callable[[Axes], None], height_in: float = 3.2) -> str:
    figure = Figure(figsize=(9.5, height_in), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.subplots()
    draw(axes)
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    return drawn.getvalue()[drawn.getvalue().index("<svg") :]


def _device(document: dict[str, Any]) -> str:
    device = document["device"]
    facts = {key: device[key] for key in ("build", "hardware", "protocol") if key in device} | document["host"]
    return _table(("what", "which"), list(facts.items()))


def _changes(changes: Sequence[Change]) -> str:
    worse = [change.name for change in changes if change.regressed]
    verdict = (
        f"Worse beyond the tolerances: {', '.join(worse)}." if worse else "Nothing is worse beyond the tolerances."
    )
    rows = [(change.name, change.before, change.now) for change in changes]
    table = _table(("figure", "before", "now"), rows, lambda row: changes[row].regressed)
    return f"<h2>Against the earlier run</h2><p>{_text(verdict)}</p>{table}"


def _latency(latency: dict[str, Any]) -> str:
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

    rows = [(name, PARTS[name], part["median_ms"], part["high_ms"]) for name, part in parts.items()]
    clock = latency["clock"]
    return (
        f"<h2>Latency: {latency['total_ms']:.1f} ms to the DAC</h2>"
        f"<p>Codec {_text(latency['codec'])} in packets of {latency['packet_samples']} samples at "
        f"{latency['rate_hz']} Hz, each due {latency['margin_ms']:g} ms after it comes; {latency['blocks']} blocks, "
        f"{latency['underruns']} underruns, {latency['lost_packets']} lost packets; arrival jitter "
        f"{latency['jitter_ms']:.2f} ms. Decoded as sent: {_number(latency['as_sent'])}. The controller's clock is "
        f"{clock['drift_ppm']:+.1f} ppm off the host's (standard error {clock['drift_error_ppm']:.1f}); shortest round "
        f"trip {clock['round_trip_ms']:.2f} ms.</p>"
        f"{_figure(draw, 1.7)}{_table(('part', 'what', 'median, ms', '95 % below, ms'), rows)}"
    )


def _smallest(smallest: dict[str, Any]) -> str:
    found = smallest["found"]
    verdict = "nothing was stable" if found is None else f"{found['total_ms']:.1f} ms"
    rows = [(trial["hop"], trial["margin_ms"], trial["total_ms"] or "not stable") for trial in smallest["trials"]]
    table = _table(("samples in a block", "margin, ms", "latency, ms"), rows)
    return f"<h2>Smallest stable latency: {verdict}</h2>{table}"


def _throughput(throughput: dict[str, Any]) -> str:
    return (
        f"<h2>Throughput</h2><p>{throughput['to_controller_bytes_per_s'] / 1000:.0f} kB/s to the controller, "
        f"{throughput['to_host_bytes_per_s'] / 1000:.0f} kB/s back; {throughput['bad_frames']} frames arrived "
        "damaged.</p>"
    )


def _load(loads: list[dict[str, Any]]) -> str:
    rows = [(load["channels"], load["rate_hz"], load["underruns"], load["lost_packets"]) for load in loads]
    table = _table(("channels", "Hz", "underruns", "lost packets"), rows, lambda row: bool(rows[row][2] + rows[row][3]))
    return f"<h2>Underruns against load</h2>{table}"


def _gap(gaps: list[dict[str, Any]]) -> str:
    rows = [(gap["buffer_ms"], gap["survived_ms"], gap["ended_by"]) for gap in gaps]
    return f"<h2>Longest gap survived</h2>{_table(('ahead, ms', 'silence survived, ms', 'ended by'), rows)}"


def _fidelity(textures: list[dict[str, Any]]) -> str:
    def draw(texture: dict[str, Any]) -> Callable[[Axes], None]:
        spectrum = texture["spectrum"]

        def plot(axes: Axes) -> None:
            axes.semilogx(spectrum["frequencies_hz"], spectrum["sent_db"], label="sent", **STYLES[0])
            axes.semilogx(spectrum["frequencies_hz"], spectrum["residual_db"], label="residual", **STYLES[1])
            axes.set_xlabel("Hz")
            axes.set_ylabel("third octaves, dB re 1 um")
            axes.set_title(texture["texture"], parse_math=False, fontsize="medium", loc="left")
            axes.legend(frameon=False)
            axes.grid(alpha=0.3)

        return plot

    columns = {
        "texture": "texture",
        "as_decoded": "decoded as sent",
        "as_computed": "DAC as computed",
        "coding_snr_db": "SNR of the codec, dB",
        "decoded_snr_db": "as displacement, dB",
        "snr_db": "SNR at the skin, dB",
        "playing_snr_db": "without the codec, dB",
        "st_sim": "ST-SIM",
        "gain": "gain",
        "drift_ppm": "drift, ppm",
    }
    rows = [[texture[key] for key in columns] for texture in textures]
    known_by = _text(textures[0]["source"])
    plots = "".join(_figure(draw(texture)) for texture in textures)
    figures = _table(list(columns.values()), rows)
    return f"<h2>Fidelity</h2><p>The skin is known by: {known_by}. {_COMPARED}</p>{figures}{plots}"


def _response(measured: dict[str, Any], actuator_table: str) -> str:
    curve, fit = measured["curve"], measured["fit"]

    def draw(axes: Axes) -> None:
        frequencies_hz = np.array(curve["frequencies_hz"])
        shape = np.abs(response.transfer(frequencies_hz, fit["corner_hz"], fit["quality"])) * fit["stroke_um"] / 2
        axes.semilogx(frequencies_hz, curve["gain_db"], label="measured", **STYLES[0])
        axes.semilogx(frequencies_hz, 20 * np.log10(shape), label="fitted", **STYLES[1])
        axes.set_xlabel("Hz")
        axes.set_ylabel("dB re 1 um at full drive")
        axes.legend(frameon=False)
        axes.grid(alpha=0.3)

    corner = f"at {fit['corner_hz']:.2f} Hz (± {fit['corner_error_hz']:.2f})"
    if fit["quality"] is None:
        kind = f"first order, -3 dB {corner}"
    else:
        kind = f"resonance {corner}, Q {fit['quality']:.2f} (± {fit['quality_error']:.2f})"
    return (
        f"<h2>Frequency response</h2><p>Known by: {_text(measured['source'])}. {kind}, stroke "
        f"{fit['stroke_um']:.2f} um (± {fit['stroke_error_um']:.2f}); {100 * fit['unexplained']:.2g} % of the recorded "
        "power is not explained.</p>"
        f"{_figure(draw)}<p>For the bench file:</p><pre>{_text(actuator_table)}</pre>"
    )


def _together(controllers: list[dict[str, Any]]) -> str:
    rows = [(each["name"], each["as_computed"], each["underruns"], each["failure"]) for each in controllers]
    table = _table(
        ("controller", "DAC as computed", "underruns", "failure"), rows, lambda row: rows[row][1] is not True
    )
    return f"<h2>All controllers at once</h2>{table}"
