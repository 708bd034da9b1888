"""The corpus of the firmware's fuzz targets, and changed copies of it, under sanitisers."""

import shutil
import sys
from pathlib import Path

import pytest

from tests.firmware import fuzzing

COPIES = 200

pytestmark = pytest.mark.slow


def replay_everything(program: Path) -> None:
    for target in fuzzing.TARGETS:
        inputs = list(fuzzing.corpus(target).values())
        assert inputs
        done = fuzzing.replay(program, target, inputs, COPIES)
        outcome = (target, done.returncode, done.stdout)
        assert outcome == (target, 0, f"{len(inputs)} inputs\n".encode()), done.stderr.decode()


def test_corpus_and_changed_copies_of_it_have_defined_behaviour(tmp_path: Path) -> None:
    program = tmp_path / "replay"
    done = fuzzing.build([sys.executable, "-m", "ziglang", "cc"], "undefined", program)
    assert done.returncode == 0, done.stderr
    replay_everything(program)
    assert b"FUZZ_TARGET" in fuzzing.replay(program, "no such target", [], 0).stderr


def test_corpus_and_changed_copies_of_it_stay_within_their_memory(tmp_path: Path) -> None:
    compiler = shutil.which("clang") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no clang or gcc, whose AddressSanitizer this needs")
    program = tmp_path / "replay"
    done = fuzzing.build([compiler], "address,undefined", program)
    if "libasan" in done.stderr or "libclang_rt" in done.stderr:
        pytest.skip(f"{compiler} has no sanitiser runtime")
    assert done.returncode == 0, done.stderr
    replay_everything(program)
