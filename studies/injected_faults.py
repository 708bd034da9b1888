"""Injects faults into a bench that are to be noticed: `python -m studies.injected_faults --out docs/benchmarks`."""

import contextlib
import multiprocessing
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import click

from studies import page
from studies.faulty_bench import FAULTS, SOUND, Injected, faulty_bench, run_host
from vibrocast import errors
from vibrocast.workers import end_with_parent

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
RUNS = 10
"""Of each fault."""
CLEAN_RUNS = 4
"""Of each controller, on a machine that does nothing else, and as many under load."""
LOAD = 20
"""Programs that compute all the time, beside the runs under load."""
TOGETHER = 2
"""Runs of faults at a time: each waits most of its time for the actuator."""
SENSED = ("actuator", "sensor")
TRUE_CAUSE = dict.fromkeys(SENSED, "actuator or sensor")
"""By place, where the cause has another name there."""
# An error that ends the run names the cause in these words.
_ENDED_BY = {
    "broke off": "wire",
    "has restarted": "device",
    "answers no more": "wire or device",
    "it drives": "device",
}
# The machine may do something else while it measures the sound bench, with which all faults are compared.
_TRIES = 5
_HOST = "from vibrocast.host.cli.entry import main; main()"


@dataclass(frozen=True)
class Noticed:
    """A run with a fault: its alarm, one of ALARMS, the cause that the command named, and its reason in words."""

    place: str
    fault: str
    run: int
    alarm: str
    cause: str
    reason: str

    @property
    def is_named(self) -> bool:
        """Whether the command named the true cause."""
        return self.cause == TRUE_CAUSE.get(self.place, self.place)


@dataclass(frozen=True)
class Clean:
    """A run of a controller without faults beside programs that compute, compared with an earlier one."""

    device: str
    load: int
    run: int
    alarm: str
    reason: str


def names(place: str) -> str:
    """Return the measurements that show faults of a place; a sweep takes long, and shows the actuator."""
    return "fidelity,response" if place in SENSED else "latency,throughput,fidelity"


def cause(said: str) -> str:
    """Return the likely cause that a command named, or the one in the error that ended it; empty without any."""
    named = re.search("^likely cause: (.*)$", said, re.MULTILINE)
    return named[1] if named else next((place for words, place in _ENDED_BY.items() if words in said), "")


def reason(said: str) -> str:
    """Return why a command failed, from its first error: all that it names, not what to do."""
    lines = [line.partition(": ") for line in said.splitlines()]
    text = next((rest for head, _, rest in lines if head == "error"), "")
    problem = re.sub(r"^.*?(measured\.json|not all could be measured): ", "", text)
    return re.sub(r"(?<!\w)/\S*/", "", problem.rpartition("; ")[0] or problem)


def measured(bench: Path, out: Path, only: str, earlier: Path | None, injected: Injected = SOUND) -> tuple[str, str]:
    """Measure a bench into a folder, and compare with that of an earlier run; return the alarm and what it said."""
    compared = () if earlier is None else ("--compare", str(earlier / "measured.json"))
    options = ("--bench", str(bench), "--allow-programs", "--only", only, "--out", str(out), *compared)
    code, said = run_host(injected, [sys.executable, "-c", _HOST, "measure", *options])
    return ALARMS.get(code, str(code)), said


def on_bench(injected: Injected, out: Path, earlier: Path | None) -> tuple[str, str]:
    """Measure a bench with a fault, as `measured` does, into a new folder."""
    out.mkdir()
    with faulty_bench(injected, out, LIMITS) as bench:
        return measured(bench, out, names(injected.place), earlier, injected)


def _noticed(number: int, run: int, out: Path, earlier: Path) -> Noticed:
    injected = FAULTS[number]
    alarm, said = on_bench(injected, out, earlier)
    return Noticed(injected.place, injected.fault, run, alarm, cause(said), reason(said))


def notice(faults: Sequence[Injected], folder: Path, runs: int = RUNS) -> Iterator[Noticed]:
    """Measure a sound bench, and one with each of some FAULTS; yield what noticed it. Raises click.ClickException."""
    earlier = {}
    for place in {names(each.place): each.place for each in faults}.values():
        for number in range(_TRIES):
            sound = folder / f"sound-{names(place)}-{number}"
            alarm, said = on_bench(Injected(place, SOUND.fault), sound, None)
            if alarm == NO_ALARM:
                break
        else:
            raise click.ClickException(f"the sound bench fails: {reason(said)}; use a less busy machine")
        earlier[names(place)] = sound
    # Processes, because a device must answer in time whatever the others compute.
    with ProcessPoolExecutor(TOGETHER, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        running = [
            pool.submit(_noticed, FAULTS.index(fault), run, folder / f"{number}-{run}", earlier[names(fault.place)])
            for number, fault in enumerate(faults)
            for run in range(1, runs + 1)
        ]
        for each in running:
            yield each.result()


@contextlib.contextmanager
def busy(programs: int) -> Iterator[None]:
    """Run so many programs that compute all the time, beside the block."""
    with contextlib.ExitStack() as stack:
        for _ in range(programs):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(process.kill)
        yield


def clean_runs(folder: Path) -> Iterator[Clean]:
    """Measure controllers without faults again and again; yield each run, compared with an idle one."""
    bench, limits = folder / "bench.toml", LIMITS.replace("min_snr_db = 8\n", "")
    for device, only in DEVICES.items():
        bench.write_text(
            f'[[controllers]]\nname = "it"\naddress = "{device}"\n[[textures]]\ngenerate = "rough"\n[limits]\n{limits}'
        )
        first = folder / device
        measured(bench, first, only, None)
        for load in (0, LOAD):
            with busy(load):
                for run in range(1, CLEAN_RUNS + 1):
                    alarm, said = measured(bench, folder / f"{device}-{load}-{run}", only, first)
                    yield Clean(device, load, run, alarm, reason(said))


def counts(alarms: Iterable[str]) -> str:
    """Return how often each alarm came, the most frequent first."""
    return ", ".join(f"{alarm} {count}" for alarm, count in Counter(alarms).most_common())


def rendered(noticed: Sequence[Noticed], clean: Sequence[Clean]) -> str:
    """Return the page with both tables."""
    by_fault = {(each.place, each.fault): [run for run in noticed if run.fault == each.fault] for each in noticed}
    by_device = {
        (device, load): [run for run in clean if (run.device, run.load) == (device, load)]
        for device, load in {(each.device, each.load): None for each in clean}
    }
    return page.render(
        "injected_faults",
        globals(),
        counts=counts,
        faults=by_fault,
        fewest=min(map(len, by_fault.values())),
        named=[runs for runs in by_fault.values() if sum(run.is_named for run in runs) >= 0.9 * len(runs)],
        clean=by_device,
        missed=[each for each in noticed if each.alarm == NO_ALARM],
        false_alarms=[each for each in clean if each.alarm not in (NO_ALARM, ALARMS[errors.HOST_BUSY])],
        undecided={
            load: [each for each in clean if each.load == load and each.alarm == ALARMS[errors.HOST_BUSY]]
            for load in (0, LOAD)
        },
        runs={load: [each for each in clean if each.load == load] for load in (0, LOAD)},
    )


@page.study
def main(out: Path) -> None:
    """Inject faults into a bench, measure sound ones as well, and write their part of stability.md."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        noticed = page.collected("injecting faults", notice(FAULTS, folder), RUNS * len(FAULTS), str)
        clean = page.collected("clean runs", clean_runs(folder), 2 * CLEAN_RUNS * len(DEVICES), str)
    tables = ((TABLE, noticed, Noticed), (CLEAN_TABLE, clean, Clean))
    page.publish(out, "stability", rendered(noticed, clean), tables)


if __name__ == "__main__":
    main()
