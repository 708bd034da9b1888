"""The compiled cores: the processor chooses one, and all produce the same bits."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from vibrocast.firmware.native_core import CORE_VARIABLE, library

ROOT = Path(__file__).parents[2]
# Bits that x86-64-v3 asks for: ECX of CPUID leaf 1, EBX of leaf 7, ECX of leaf 0x80000001, XCR0.
NEEDED_BITS = ((0, 9, 12, 13, 19, 20, 22, 23, 27, 28, 29), (3, 5, 8), (0, 5), (1, 2))


def run_with(core: str | None, *command: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != CORE_VARIABLE}
    if core is not None:
        environment[CORE_VARIABLE] = core
    return subprocess.run([sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True)


def digests(core: str | None) -> dict[str, str]:
    done = run_with(core, "-m", "tests.codec.core_digests")
    assert done.returncode == 0, done.stderr
    result: dict[str, str] = json.loads(done.stdout)
    return result


def runs_x86_64_v3() -> bool:
    return bool(library().vc_runs_x86_64_v3())


@pytest.mark.slow
@pytest.mark.skipif(not runs_x86_64_v3(), reason="this processor does not run x86-64-v3, the other core")
def test_both_cores_produce_the_same_bits() -> None:
    baseline = digests("baseline")
    assert len(baseline) > 100
    assert digests("x86_64_v3") == baseline


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux lists the libraries of a process")
@pytest.mark.parametrize("core", [None, "baseline"])
def test_the_processor_chooses_the_core_unless_one_is_named(core: str | None) -> None:
    code = (
        "from vibrocast.codec.core import ffi, library; address = int(ffi.cast('size_t', ffi.addressof(library(), "
        "'vc_mdct_decoder_size')));"
        "print(*(line for line in open('/proc/self/maps') "
        "if int(line.split('-')[0], 16) <= address < int(line.split()[0].split('-')[1], 16)))"
    )
    chosen = core or ("x86_64_v3" if runs_x86_64_v3() else "baseline")
    assert f"vibrocast_core.{chosen}." in run_with(core, "-c", code).stdout


def test_a_missing_core_is_an_error_of_one_line() -> None:
    done = run_with(
        "sparc", "-c", "from vibrocast.host.cli.entry import main; main()", "info", "tests/codec/golden_mdct.vct"
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "VIBROCAST_CORE is 'sparc', which this machine cannot run; set it to baseline" in done.stderr


def test_a_processor_runs_x86_64_v3_only_with_all_that_it_asks_for() -> None:
    asked = library().vc_registers_run_x86_64_v3
    enough = [sum(1 << bit for bit in bits) for bits in NEEDED_BITS]
    assert asked(*enough) == 1
    for place, bits in enumerate(NEEDED_BITS):
        for bit in bits:
            lacking = list(enough)
            lacking[place] -= 1 << bit
            assert asked(*lacking) == 0, f"register {place}, bit {bit}"


@pytest.mark.skipif(not Path("/proc/cpuinfo").exists(), reason="only Linux lists what a processor can do")
def test_the_answer_is_that_of_the_system() -> None:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    flags = set(next((line.split(":")[1].split() for line in lines if line.startswith("flags")), []))
    needed = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}
    needed |= {"cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3"}
    assert runs_x86_64_v3() == (needed <= flags)


def test_threads_that_need_the_core_at_once_load_it_once() -> None:
    code = """
from threading import Barrier, Thread
from vibrocast.firmware.native_core import library
barrier, loaded = Barrier(16), []
def load():
    barrier.wait()
    loaded.append(library())
threads = [Thread(target=load) for _ in range(16)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(loaded) == 16 and len(set(map(id, loaded))) == 1
"""
    done = run_with(None, "-c", code)
    assert done.returncode == 0, done.stderr
