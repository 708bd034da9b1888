"""Programs of the user's as codecs: small scripts stand in for them, those that work and those that do not."""

import sys
import time
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from tests.codec.signals import RATE_HZ, texture
from vibrocast.codec import Signal
from vibrocast.errors import InputError
from vibrocast.evaluation import external
from vibrocast.evaluation.external import Command, Program

EXAMPLE = Path(__file__).parents[2] / "examples" / "programs.toml"

COPY = "import shutil, sys; shutil.copy(*sys.argv[1:3])"
COPY_FOLDER = """
import os, shutil, sys
source, target = sys.argv[1:]
for name in os.listdir(source):
    shutil.copy(os.path.join(source, name), os.path.join(target, name + ".out"))
"""
CUT = """
import sys, wave
with wave.open(sys.argv[1]) as file:
    form, kept = file.getparams(), file.readframes(int(sys.argv[3]))
with wave.open(sys.argv[2], "wb") as file:
    file.setparams(form)
    file.writeframes(kept)
"""
ENCODER = """
import array, gzip, sys, wave
source, target, shift = sys.argv[1:]
with wave.open(source) as file:
    samples = array.array("h", file.readframes(file.getnframes()))
    head = bytes((int(shift),)) + file.getframerate().to_bytes(4, "little")
open(target, "wb").write(head + gzip.compress(array.array("h", [value >> int(shift) for value in samples]).tobytes()))
"""
DECODER = """
import array, gzip, sys, wave
source, target, delay, speed = sys.argv[1:]
coded = open(source, "rb").read()
samples = [value << coded[0] for value in array.array("h", gzip.decompress(coded[5:]))]
with wave.open(target, "wb") as file:
    file.setparams((1, 2, int.from_bytes(coded[1:5], "little") * int(speed), 0, "NONE", ""))
    file.writeframes(array.array("h", [0] * int(delay) + samples).tobytes())
"""


def python(script: str, *arguments: str) -> tuple[Command, ...]:
    return ((sys.executable, "-c", script, *arguments),)


COPIED = python(COPY, "{input}", "{output}")
COPIER = Program(name="copier", file=Path("mine.toml"), encoder=COPIED, decoder=COPIED)


def coder(delay: int = 0, speed: int = 1) -> Program:
    """A coder that drops the setting's number of low bits; decoded signal lags by `delay`."""
    return replace(
        COPIER,
        encoder=python(ENCODER, "{input}", "{output}", "{setting}"),
        decoder=python(DECODER, "{input}", "{output}", str(delay), str(speed)),
    )


def snr_db(signal: Signal, decoded: Signal) -> float:
    return float(10 * np.log10(np.sum(signal**2) / np.sum((signal - decoded) ** 2)))


def failure(program: Program, samples: int = 500) -> str:
    with pytest.raises(InputError) as caught:
        external.run(program, "", texture(samples), RATE_HZ)
    return str(caught.value)


@pytest.mark.parametrize("level", [1e-6, 1.0, 40.0])
def test_a_program_codes_in_the_physical_unit(level: float) -> None:
    signal = level * texture(3000)
    fine, coarse = (external.run(coder(), setting, signal, RATE_HZ) for setting in ("0", "9"))
    assert fine.decoded.shape == signal.shape
    assert snr_db(signal, fine.decoded) > 70
    assert 10 < snr_db(signal, coarse.decoded) < 40
    assert 0 < coarse.size_bytes < fine.size_bytes
    assert fine.encode_s > 0
    assert fine.decode_s > 0


def test_short_signals_silence_and_a_missing_end_are_coded_and_other_signals_rejected() -> None:
    for samples in (1, 2, 7):
        assert snr_db(texture(samples), external.run(COPIER, "", texture(samples), RATE_HZ).decoded) > 70
        assert not np.any(external.run(COPIER, "", np.zeros((samples, 1)), RATE_HZ).decoded)
    cut, signal = replace(COPIER, decoder=python(CUT, "{input}", "{output}", "950")), texture(1000)
    decoded = external.run(cut, "", signal, RATE_HZ).decoded
    assert snr_db(signal[:950], decoded[:950]) > 70 and not np.any(decoded[950:])
    for other in (np.zeros((0, 1)), np.zeros((5, 2)), np.zeros(5), np.full((5, 1), np.nan)):
        with pytest.raises(InputError, match="one channel of finite numbers"):
            external.run(COPIER, "", other, RATE_HZ)


@pytest.mark.parametrize("delay", [0, 1, 52, 700])
@pytest.mark.parametrize("told", [False, True])
def test_delay_is_removed(delay: int, told: bool) -> None:
    signal = texture(2000)
    program = replace(coder(delay), delay_samples=delay if told else None)
    assert snr_db(signal, external.run(program, "0", signal, RATE_HZ).decoded) > 70


def test_the_file_is_labelled_with_another_rate() -> None:
    """The stand-in carries the label through: a decoder that returned another rate would be rejected."""
    signal = texture(500)
    assert snr_db(signal, external.run(replace(coder(), label_rate_hz=8000), "0", signal, RATE_HZ).decoded) > 70
    with pytest.raises(InputError, match=r"at 5600 Hz instead of one at 2800 Hz.*mine\.toml"):
        external.run(coder(speed=2), "0", signal, RATE_HZ)


def test_programs_that_code_folders_and_in_two_steps() -> None:
    folders = python(COPY_FOLDER, "{input_folder}", "{output_folder}")
    steps = (*python(COPY, "{input}", "{scratch_folder}/half"), *python(COPY, "{scratch_folder}/half", "{output}"))
    signal = texture(600)
    for decoder in (folders, steps):
        decoded = external.run(replace(COPIER, encoder=steps, decoder=decoder), "", signal, RATE_HZ).decoded
        assert snr_db(signal, decoded) > 70


def test_a_program_that_cannot_be_run_or_fails_is_named_and_quoted(tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.write_bytes(b"\0\1\2")
    broken.chmod(0o755)
    missing = failure(replace(COPIER, decoder=(("no-such-program", "{input}"),)))
    assert missing == "copier: no-such-program not found; install it or correct its path in mine.toml"
    for encoder, message in (
        (((str(broken),),), "cannot be started"),
        (python("import sys; sys.exit('first line\\nno such quality\\n')"), "ended with code 1: no such quality"),
        (python("import os; os.kill(os.getpid(), 9)"), "was killed by signal 9"),
    ):
        assert message in failure(replace(COPIER, encoder=encoder))


def test_a_hanging_program_is_stopped_with_its_children(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    shell = ("sh", "-c", 'sleep 600 & echo $! > "$1"; wait', "sh", str(pid_file))
    assert "did not end within 1 s; raise timeout_s in mine.toml" in failure(
        replace(COPIER, encoder=(shell,), timeout_s=1.0)
    )
    child = Path(f"/proc/{int(pid_file.read_text())}/stat")
    for _ in range(200):
        if not child.exists() or child.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return
        time.sleep(0.02)
    pytest.fail("the child still runs")


@pytest.mark.parametrize(
    ("encoder", "decoder", "expected"),
    [
        ("pass", COPY, "the encoder wrote nothing"),
        (COPY, CUT.replace("int(sys.argv[3])", "400"), "400 samples instead of 500"),
        (COPY, "pass", "the decoder wrote 0 files"),
        (COPY, COPY + "; shutil.copy(sys.argv[1], sys.argv[2] + '2')", "the decoder wrote 2 files"),
        (COPY, "import sys; open(sys.argv[2], 'wb').write(bytes(5000))", "no WAV file"),
        (COPY, "import sys; open(sys.argv[2], 'wb').write(b'RIFF')", "no WAV file"),
        (COPY, "import sys; open(sys.argv[2], 'wb')", "no WAV file"),
        (
            COPY,
            "import soundfile, sys; soundfile.write(sys.argv[2], [float('nan')] * 500, 2800, 'FLOAT')",
            "NaN or infinity",
        ),
        (COPY, "import soundfile, sys; soundfile.write(sys.argv[2], [[0.0] * 2] * 500, 2800)", "2 channels"),
    ],
)
def test_what_is_left_must_be_usable(encoder: str, decoder: str, expected: str) -> None:
    arguments = ("{input}", "{output}")
    assert expected in failure(
        replace(COPIER, encoder=python(encoder, *arguments), decoder=python(decoder, *arguments))
    )


BOTH = 'encoder = ["a", "{input}", "{output}"]\ndecoder = ["b", "{input}", "{output}"]\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[", "not a TOML file"),
        ("mine = 3", "a table of its own"),
        ("[mine]\nencoder = ['a']", "decoder is missing"),
        *((f"[mine]\n{BOTH}settings = {value}", "settings must be a list") for value in ("[]", "'fine'", "3", "[[1]]")),
        (f"[mine]\n{BOTH}label_rate_hz = 0", "label_rate_hz must be a whole number from 1"),
        (f"[mine]\n{BOTH}delay_samples = -1", "delay_samples must be a whole number from 0"),
        (f"[mine]\n{BOTH}timeout_s = 'long'", "timeout_s must be a number from 1, not 'long'"),
        (f"[mine]\n{BOTH}coded_suffix = '/x'", "coded_suffix must be a text such as"),
        *(
            (f"[mine]\nencoder = {value}\ndecoder = ['b']", "encoder must be a list of a program")
            for value in ("'a'", "[]", "[[]]", "['a', 3]", "3")
        ),
        ("[mine]\nencoder = ['a', '{in}']\ndecoder = ['b']", "encoder has {in}; choose from input, output"),
    ],
)
def test_lists_that_are_wrong_are_rejected(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError) as caught:
        external.read_programs(path)
    assert all(program.file == EXAMPLE for program in external.read_programs(EXAMPLE, allow_programs=True))
    assert expected in str(caught.value)
    assert str(path) in str(caught.value)
