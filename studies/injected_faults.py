"""Injects faults into a bench that are to be noticed: `python -m studies.injected_faults --out docs/benchmarks`."""

import json
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from studies import page
from studies.faulty_bench import FAULTS, SOUND, Injected, faulty_bench, run_host
from vibrocast import errors, progress
from vibrocast.host.cli.option_types import Whole

TABLE, CLEAN_TABLE = "injected_faults.csv", "clean_runs.csv"
DEVICES = {
    **dict.fromkeys(("sim", "sim-usb", "host"), "latency,throughput,fidelity,response"),
    **dict.fromkeys(("cortex-m4", "stm32f405"), "fidelity,response"),
}
"""Each controller with the measurements of its clean runs. An emulated processor is too slow for live packets, and its
throughput is that of this computer: it changes by half from run to run."""
ALARMS = {
    0: "none",
    errors.FAILED: "measurement failed",
    errors.BAD_INPUT: "wrong bench",
    errors.NO_DEVICE: "no device",
    errors.LIMIT_MISSED: "limit missed",
    errors.REGRESSION: "regression",
}
LIMITS = """\
min_snr_db = 8
min_gain = 0.9
max_gain = 1.1
max_latency_ms = 60
max_jitter_ms = 20
max_underruns = 0
max_lost_percent = 0.5
max_bad_frames = 0
max_drift_ppm = 300
"""
SENSED = ("actuator", "sensor")
# The machine may do something else while it measures the sound bench, with which all faults are compared.
_TRIES = 5
_HOST = "from vibrocast.host.cli.entry import main; main()"


@dataclass(frozen=True)
class Noticed:
    """A fault and its alarm: one of ALARMS, and the reason in the command's words."""

    place: str
    fault: str
    alarm: str
    reason: str


@dataclass(frozen=True)
class Clean:
    """A run of a controller without faults, compared with an earlier one, and its alarm."""

    device: str
    run: int
    alarm: str
    reason: str


def measured(out: Path, *arguments: str) -> list[str]:
    """Return the command that measures a bench."""
    return [sys.executable, "-c", _HOST, "measure", "--out", str(out), *arguments]


def names(place: str) -> str:
    """Return the measurements that show faults of a place; a sweep takes long, and shows the actuator."""
    return "fidelity,response" if place in SENSED else "latency,throughput,fidelity"


def reason(said: str) -> str:
    """Return why a command failed, from its first error: all that it names, without what to do."""
    errors = [line.partition(": ")[2] for line in said.splitlines() if line.startswith(("error: ", "not measured: "))]
    text = next((each for each in errors if not each.startswith("not all could be measured")), "")
    return re.sub(r"(?<!\w)/\S*/", "", _without_advice(text.rpartition("measured.json: ")[2]))


def _without_advice(error: str) -> str:
    """Return an error without its last part, which says what to do."""
    return error.rpartition("; ")[0] or error


def on_bench(injected: Injected, folder: Path, earlier: Path | None) -> tuple[int, str]:
    """Measure a bench with a fault into a folder; return the exit code, and what the command said."""
    with faulty_bench(injected, folder, LIMITS) as bench:
        compared = () if earlier is None else ("--compare", str(earlier))
        only = names(injected.place)
        command = measured(folder, "--bench", str(bench), "--allow-programs", "--only", only, *compared)
        code, said = run_host(injected, command)
    return code, said


def notice(faults: Sequence[Injected], folder: Path) -> Iterator[Noticed]:
    """Measure a sound bench, and one with each fault; yield what noticed it. Raises click.ClickException."""
    earlier = {}
    for place in {names(each.place): each.place for each in faults}.values():
        sound = folder / f"sound-{names(place)}"
        sound.mkdir()
        for _ in range(_TRIES):
            code, said = on_bench(Injected(place, SOUND.fault), sound, None)
            if code == 0:
                break
        else:
            raise click.ClickException(f"the sound bench fails: {said}; use a less busy machine")
        earlier[names(place)] = sound / "measured.json"
    for number, injected in enumerate(faults):
        inside = folder / str(number)
        inside.mkdir()
        code, said = on_bench(injected, inside, earlier[names(injected.place)])
        yield Noticed(injected.place, injected.fault, ALARMS.get(code, str(code)), reason(said))


def clean_runs(devices: Sequence[str], runs: int, folder: Path) -> Iterator[Clean]:
    """Measure controllers without faults again and again; yield each run, compared with the first one."""
    bench = folder / "bench.toml"
    for device in devices:
        limits = LIMITS.replace("min_snr_db = 8\n", "")
        bench.write_text(
            f'[[controllers]]\nname = "it"\naddress = "{device}"\n[[textures]]\ngenerate = "rough"\n[limits]\n{limits}'
        )
        first = folder / device
        for run in range(runs + 1):
            out = first if run == 0 else folder / f"{device}-{run}"
            compared = ("--compare", str(first / "measured.json")) if run else ()
            code, said = run_host(SOUND, measured(out, "--bench", str(bench), "--only", DEVICES[device], *compared))
            if run:
                yield Clean(device, run, ALARMS.get(code, str(code)), reason(said))


def rendered(noticed: Sequence[Noticed], clean: Sequence[Clean]) -> str:
    """Return the page with both tables."""
    missed = [each for each in noticed if each.alarm == "none"]
    false_alarms = [each for each in clean if each.alarm != "none"]
    return page.render(
        "injected_faults", noticed=noticed, clean=clean, missed=missed, false_alarms=false_alarms, limits=LIMITS
    )


@page.study
@click.option("--runs", type=Whole("NUMBER", 0), default=3, show_default=True, help="Repeat clean runs so often.")
@click.option(
    "--device",
    "devices",
    type=click.Choice(list(DEVICES)),
    multiple=True,
    default=tuple(DEVICES),
    show_default=True,
    help="Choose a controller for clean runs; may be repeated.",
)
def main(runs: int, devices: tuple[str, ...], out: Path) -> None:
    """Inject faults into a bench, measure sound ones as well, and write the page injected_faults.md."""
    with tempfile.TemporaryDirectory() as folder:
        with progress.bar("injecting faults") as update:
            noticed = []
            for each in notice(FAULTS, Path(folder)):
                noticed.append(each)
                update(len(noticed) / len(FAULTS), json.dumps(vars(each)))
        with progress.bar("clean runs") as update:
            clean = []
            for run in clean_runs(devices, runs, Path(folder)):
                clean.append(run)
                update(len(clean) / max(1, runs * len(devices)), json.dumps(vars(run)))
    tables = ((TABLE, noticed, Noticed), (CLEAN_TABLE, clean, Clean))
    page.publish(out, "injected_faults", rendered(noticed, clean), tables)


if __name__ == "__main__":
    main()
