"""Injects faults into a bench that are to be noticed: `python -m studies.injected_faults --out docs/benchmarks`."""

import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from studies import page
from studies.faulty_bench import FAULTS, SOUND, Injected, faulty_bench, run_host
from vibrocast import errors

TABLE, CLEAN_TABLE = "injected_faults.csv", "clean_runs.csv"
DEVICES = {
    **dict.fromkeys(("sim", "sim-usb", "host"), "latency,throughput,fidelity,response"),
    **dict.fromkeys(("cortex-m4", "stm32f405"), "fidelity,response"),
}
"""Each controller with the measurements of its clean runs. An emulated processor is too slow for live packets, and its
throughput is that of this computer: it changes by half from run to run."""
NO_ALARM = "none"
ALARMS = {
    0: NO_ALARM,
    errors.FAILED: "measurement failed",
    errors.BAD_INPUT: "wrong bench",
    errors.NO_DEVICE: "no device",
    errors.LIMIT_MISSED: "limit missed",
    errors.REGRESSION: "regression",
    errors.HOST_BUSY: "undecided",
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
CLEAN_RUNS = 3
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


def names(place: str) -> str:
    """Return the measurements that show faults of a place; a sweep takes long, and shows the actuator."""
    return "fidelity,response" if place in SENSED else "latency,throughput,fidelity"


def reason(said: str) -> str:
    """Return why a command failed, from its first error: all that it names, and the likely cause, not what to do."""
    lines = [line.partition(": ") for line in said.splitlines()]
    text = next((rest for head, _, rest in lines if head == "error"), "")
    problem = re.sub(r"^.*?(measured\.json|not all could be measured): ", "", text)
    cause = "".join(f" (likely cause: {rest})" for head, _, rest in lines if head == "likely cause")
    return re.sub(r"(?<!\w)/\S*/", "", problem.rpartition("; ")[0] or problem) + cause


def measured(bench: Path, out: Path, only: str, earlier: Path | None, injected: Injected = SOUND) -> tuple[str, str]:
    """Measure a bench into a folder, and compare with that of an earlier run; return the alarm and its reason."""
    compared = () if earlier is None else ("--compare", str(earlier / "measured.json"))
    options = ("--bench", str(bench), "--allow-programs", "--only", only, "--out", str(out), *compared)
    code, said = run_host(injected, [sys.executable, "-c", _HOST, "measure", *options])
    return ALARMS.get(code, str(code)), reason(said)


def on_bench(injected: Injected, out: Path, earlier: Path | None) -> tuple[str, str]:
    """Measure a bench with a fault, as `measured` does, into a new folder."""
    out.mkdir()
    with faulty_bench(injected, out, LIMITS) as bench:
        return measured(bench, out, names(injected.place), earlier, injected)


def notice(faults: Sequence[Injected], folder: Path) -> Iterator[Noticed]:
    """Measure a sound bench, and one with each fault; yield what noticed it. Raises click.ClickException."""
    earlier = {}
    for place in {names(each.place): each.place for each in faults}.values():
        for number in range(_TRIES):
            sound = folder / f"sound-{names(place)}-{number}"
            alarm, why = on_bench(Injected(place, SOUND.fault), sound, None)
            if alarm == NO_ALARM:
                break
        else:
            raise click.ClickException(f"the sound bench fails: {why}; use a less busy machine")
        earlier[names(place)] = sound
    for number, injected in enumerate(faults):
        found = on_bench(injected, folder / str(number), earlier[names(injected.place)])
        yield Noticed(injected.place, injected.fault, *found)


def clean_runs(folder: Path) -> Iterator[Clean]:
    """Measure controllers without faults again and again; yield each run, compared with the first one."""
    bench, limits = folder / "bench.toml", LIMITS.replace("min_snr_db = 8\n", "")
    for device, only in DEVICES.items():
        bench.write_text(
            f'[[controllers]]\nname = "it"\naddress = "{device}"\n[[textures]]\ngenerate = "rough"\n[limits]\n{limits}'
        )
        first, *others = (folder / f"{device}-{run}" for run in range(CLEAN_RUNS + 1))
        measured(bench, first, only, None)
        for run, out in enumerate(others, 1):
            yield Clean(device, run, *measured(bench, out, only, first))


def rendered(noticed: Sequence[Noticed], clean: Sequence[Clean]) -> str:
    """Return the page with both tables."""
    return page.render(
        "injected_faults",
        globals(),
        noticed=noticed,
        clean=clean,
        missed=[each for each in noticed if each.alarm == NO_ALARM],
        false_alarms=[each for each in clean if each.alarm != NO_ALARM],
    )


@page.study
def main(out: Path) -> None:
    """Inject faults into a bench, measure sound ones as well, and write their part of stability.md."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        noticed = page.collected("injecting faults", notice(FAULTS, folder), len(FAULTS), str)
        clean = page.collected("clean runs", clean_runs(folder), CLEAN_RUNS * len(DEVICES), str)
    tables = ((TABLE, noticed, Noticed), (CLEAN_TABLE, clean, Clean))
    page.publish(out, "stability", rendered(noticed, clean), tables)


if __name__ == "__main__":
    main()
