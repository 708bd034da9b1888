"""Measures a bench by the names of the measurements, again where times have become worse, and writes what there is."""

import contextlib
import sys
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

from vibrocast import progress
from vibrocast.codec import CodecError
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.device_protocol.messages import MessageError
from vibrocast.device_protocol.transports import TransportError
from vibrocast.files import atomic_write
from vibrocast.harness import measurements, page
from vibrocast.harness.latency import FlawedError, Latency
from vibrocast.harness.results import ACTUATOR, JSON, NAMES, PAGE, Measured, Results, compare
from vibrocast.harness.sensors import SensorError
from vibrocast.host import bench_file
from vibrocast.host.bench_file import Bench
from vibrocast.host.controller import ConnectionLost, Controller, ControllerError
from vibrocast.host.playback import AlignmentError
from vibrocast.host.report import Provenance

# Measured again where they have become worse: the computer may have been busy with something else.
_TIMED = NAMES[:5]
_RETAKES = 2


def measure_bench(
    bench: Bench, folder: Path, names: Collection[str] = NAMES, earlier: Results | None = None
) -> Results:
    """Measure a bench, write PAGE, JSON and the fitted ACTUATOR into a folder, and show how far it is on stderr.

    `names`: some of NAMES. `earlier`: a run to compare with (`read_results`). A measurement
    that fails leaves the others; after a lost controller, or Ctrl-C, what was measured before is written. Raises
    InputError, ControllerError, TransportError, OSError.
    """
    results = Results({}, {}, asked=_possible(bench, names), run=Provenance(bench.sha256))
    folder.mkdir(parents=True, exist_ok=True)
    with _written(folder, results, earlier, bench):
        _measure(bench, names, results)
        for _ in range(_RETAKES):
            if earlier is None:
                break
            again = [name for name in _TIMED if _is_worse(earlier, results.measured, name)]
            if not again:
                break
            print(f"worse, measured again: {', '.join(again)}", file=sys.stderr)
            retaken = Results({}, {}, asked=tuple(again))
            _measure(bench, again, retaken)
            for key, count in retaken.link.items():
                results.link[key] = results.link.get(key, 0) + count
            for name in again:
                before, value = (getattr(each.measured, name) for each in (results, retaken))
                kept = before if value is None or _is_worse(earlier, retaken.measured, name) else value
                if isinstance(before, Latency) and isinstance(value, Latency):
                    kept = _with_losses_of(kept, before, value)
                setattr(results.measured, name, kept)
    return results


def _with_losses_of(kept: Latency, first: Latency, second: Latency) -> Latency:
    """Return the times of one take with the losses of both: only times depend on how busy the computer was."""
    report = replace(
        kept.report,
        packets=first.report.packets + second.report.packets,
        underruns=first.report.underruns + second.report.underruns,
        lost_packets=first.report.lost_packets + second.report.lost_packets,
        decoded_equals_offline=first.report.decoded_equals_offline and second.report.decoded_equals_offline,
        dac_equals_offline=first.report.dac_equals_offline and second.report.dac_equals_offline,
    )
    return replace(kept, report=report)


def _possible(bench: Bench, names: Collection[str]) -> tuple[str, ...]:
    """Return the names of the measurements that a bench allows: one controller plays nothing together with others."""
    return tuple(name for name in NAMES if name in names and (name != "together" or len(bench.controllers) > 1))


def _measure(bench: Bench, names: Collection[str], results: Results) -> None:
    """Take the measurements of these names; one that fails leaves the others, a lost controller ends all."""
    results.host.update(measurements.machine())
    with bench_file.connect(bench, bench.first) as session, _counted(session.controller, results):
        controller = session.controller
        results.device.update(measurements.device_facts(bench, controller))
        subject = measurements.subject(bench, session)
        for name, measurement in measurements.MEASUREMENTS.items():
            if name not in names:
                continue
            with progress.bar(name) as update:
                controller.watch_time()
                failure: Exception | None = None
                try:
                    setattr(results.measured, name, measurement(subject, update))
                except (ConnectionLost, TransportError):
                    raise
                except (AlignmentError, CodecError, ControllerError, MessageError, SensorError, StreamError) as error:
                    failure, results.failed[name] = error, str(error)
                    controller.stop()
                except KeyboardInterrupt:
                    with contextlib.suppress(ControllerError, TransportError):
                        controller.stop()
                    raise
                finally:
                    if doubt := _doubt(controller, failure):
                        results.doubts[name] = doubt
    if "together" in _possible(bench, names):
        with progress.bar("together"):
            results.measured.together = measurements.together(bench)


def _doubt(controller: Controller, failure: Exception | None) -> str:
    """Return why this machine may have spoilt a measurement, as `Controller.doubt`; `failure`: how it ended, if so."""
    if isinstance(failure, SensorError):  # no busy machine makes a sensor's program fail
        return ""
    return (failure.doubt if isinstance(failure, FlawedError) else "") or controller.doubt()


@contextlib.contextmanager
def _counted(controller: Controller, results: Results) -> Iterator[None]:
    """Count what goes wrong on the link during the block; damage there as far as the controller can be asked."""
    controller.request_status()
    before, requests = controller.wire_faults, controller.repeated_requests
    restarts = controller.device_restarts
    try:
        yield
    finally:
        requests = controller.repeated_requests - requests
        is_there = False
        with contextlib.suppress(ControllerError, TransportError):
            controller.request_status()
            is_there = True
        faults = controller.wire_faults.since(before)
        results.link.update(
            bad_frames_at_host=faults.bad_frames_back,
            repeated_frames=faults.repeated_frames,
            reordered_frames=faults.reordered_frames,
            repeated_requests=requests,
            device_restarts=controller.device_restarts - restarts,
        )
        if is_there:
            results.link["bad_frames_at_controller"] = faults.bad_frames


def _is_worse(earlier: Results, measured: Measured, name: str) -> bool:
    """Return whether a time of one measurement has become worse than in an earlier run."""
    now = Results({}, {}, measured, asked=(name,))
    return any(change.problem == "worse" and not change.counted for change in compare(earlier, now))


@contextlib.contextmanager
def _written(folder: Path, results: Results, earlier: Results | None, bench: Bench) -> Iterator[None]:
    """Write the results when the block ends, however it ends."""
    try:
        yield
    except BaseException as error:
        results.failed["the rest"] = str(error) or "interrupted"
        raise
    finally:
        if results.measured != Measured():
            table = ""
            if response := results.measured.response:
                table = bench_file.actuator_toml(response.actuator, bench.first.name)
                with atomic_write(folder / ACTUATOR) as partial:
                    partial.write_text(table, encoding="utf-8")
            missed = [*bench.missed(results.figures()), *measurements.misfits(bench, results.measured.response)]
            results.missed[:] = [f"{text} (undecided: {doubt})" if doubt else text for text, doubt in missed]
            results.write(folder / JSON)
            changes = [] if earlier is None else compare(earlier, results)
            page.write(folder / PAGE, results.document(), changes, table)
