"""The engine that fuzzes the firmware where libFuzzer is absent; every target for its share of a minute."""

import random
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.firmware import fuzzing
from tests.firmware.fuzzing import COUNTING, ENGINE, FLAGS, TARGETS, FaultError

SECONDS = 30
"""Time for all targets: two builds take the minute."""
ZIG = [sys.executable, "-m", "ziglang", "cc"]


def test_engine_finds_a_fault_step_by_step_and_keeps_the_input(tmp_path: Path) -> None:
    program, found = tmp_path / "planted", tmp_path / "found"
    sources = [str(ENGINE), str(Path(__file__).with_name("planted.c"))]
    subprocess.run([*ZIG, *FLAGS, "-fsanitize=undefined", COUNTING, *sources, "-o", str(program)], check=True)
    with pytest.raises(FaultError, match="mdct, seed 1"):
        fuzzing.run_engine(program, "mdct", [b"none"], 100, 1, found)
    assert found.read_bytes().startswith(b"vib\r")
    assert fuzzing.run_engine(program, "mdct", [b"none", b"vi"], 0, 1, found).inputs == 2


def test_corpus_has_inputs_of_every_target() -> None:
    assert all(map(fuzzing.corpus, TARGETS))
    with zipfile.ZipFile(fuzzing.CORPUS) as archive:
        assert {name.split("/")[0] for name in archive.namelist()} == set(TARGETS)


def fuzz(program: Path, seconds: int) -> None:
    """Fuzz every target with a seed that is new each time; a failure shows it."""

    def run(target: str, share: int) -> fuzzing.Counts:
        inputs = list(fuzzing.corpus(target).values())
        seed = random.SystemRandom().randrange(2**32)
        return fuzzing.run_engine(program, target, inputs, share, seed, program.with_name(f"{target}-fault"))

    for counts in fuzzing.in_parallel(run, TARGETS, seconds):
        assert counts.inputs > len(fuzzing.corpus(counts.target))


@pytest.mark.slow
def test_any_input_has_defined_behaviour(tmp_path: Path) -> None:
    program = tmp_path / "engine"
    done = fuzzing.build(ZIG, "undefined", program, COUNTING)
    assert done.returncode == 0, done.stderr
    fuzz(program, SECONDS)
    with pytest.raises(FaultError, match="FUZZ_TARGET"):
        fuzzing.run_engine(program, "no such target", [], 0, 1, tmp_path / "found")


@pytest.mark.slow
def test_any_input_stays_within_its_memory(tmp_path: Path) -> None:
    compiler = shutil.which("clang") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no clang or gcc, whose AddressSanitizer this needs")
    program = tmp_path / "engine"
    options = [COUNTING] if "clang" in compiler else []
    done = fuzzing.build([compiler], "address,undefined", program, *options)
    if "libasan" in done.stderr or "libclang_rt" in done.stderr:
        pytest.skip(f"{compiler} has no sanitiser runtime")
    assert done.returncode == 0, done.stderr
    fuzz(program, SECONDS)
