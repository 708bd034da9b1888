"""The C core under address and undefined-behaviour sanitisers, where a compiler has them."""

import itertools
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.codec.eva_models import random_image, with_extreme_weights
from tests.codec.signals import RATE_HZ, texture
from vibrocast.codec import Choice, Framing, Setting, core, encode, eva, mdct, slp
from vibrocast.codec.eva_image import PRIOR_KINDS, PriorKind
from vibrocast.codec.rotation import COMMON, OWN, Rotation
from vibrocast.export import mdct_tables
from vibrocast.firmware.native_core import ffi, library
from vibrocast.output.actuator import LRA, PIEZO_STACK, VOICE_COIL
from vibrocast.output.actuator_constants import constants

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("clang") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no clang or gcc, whose sanitisers this needs")
    built = tmp_path_factory.mktemp("sanitised") / "core"
    firmware = ROOT / "firmware"
    sources = [*sorted((firmware / "src" / "core").glob("*.c")), Path(__file__).with_name("sanitised_core.c")]
    flags = ["-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
    command = [
        compiler,
        *flags,
        "-fno-sanitize-recover=all",
        f"-I{firmware / 'include'}",
        f"-I{firmware / 'src'}",
        *map(str, sources),
        "-o",
        str(built),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if "libasan" in done.stderr or "libclang_rt" in done.stderr:
        pytest.skip(f"{compiler} has no sanitiser runtime")
    assert done.returncode == 0, done.stderr
    return built


def record(kind: int, data: bytes) -> bytes:
    return bytes((kind,)) + len(data).to_bytes(2, "little") + data


def run(program: Path, records: bytes, codec_name: str = "mdct") -> bool:
    """Run records, where no sanitiser may find anything; return whether the core took the stream."""
    # The program leaves its own buffers to the system when it ends early; the core itself allocates nothing.
    environment = {"ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run([str(program), codec_name], input=records, capture_output=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout == b"done\n"


def losses_and_noise(generator: np.random.Generator, packets: int) -> bytes:
    """Return records of packets of one byte repeated, then of any bytes, a fifth refreshes, a tenth of them lost."""
    records = b"".join(record(0, b"\x01" + bytes([byte]) * 150) for byte in range(0, 256, 5))
    for sequence in range(packets):
        payload = bytes((2 * sequence + (sequence % 5 == 0),)) + generator.bytes(int(generator.integers(300)))
        records += record(int(generator.random() < 0.1), payload)
    return records


def test_streams_with_losses_damage_and_noise(program: Path) -> None:
    generator = np.random.default_rng(1)
    untrained = mdct_tables.untrained_tables()
    apart = Rotation((0, 63, 7), (COMMON, OWN, 0, COMMON), (5, 20, 33), ((7, 8, 9),))
    together = Rotation(tuple(range(16)), (OWN, 0, 0, 0), (), (tuple(generator.integers(0, 64, 120).tolist()),))
    for channels, tables, hop, rate_control, rotation in (
        (1, b"", 32, None, None),
        (3, untrained, 16, lambda trial: Choice(int(generator.choice(trial.quantiser_offsets))), None),
        (16, b"", 128, lambda trial: Choice(int(generator.integers(-30, 30))), None),
        (1, generator.bytes(len(untrained)), 128, None, None),
        (3, b"", 64, lambda trial: Choice(int(generator.integers(-30, 30))), apart),
        (16, b"", 16, None, together),
    ):
        encoder = mdct.MdctEncoder(
            [0.02] * channels,
            RATE_HZ,
            Framing(96, 4),
            tables or None,
            hop=hop,
            noise_filling=0.1,
            rate_control=rate_control,
            rotation=rotation,
        )
        packets = encoder.encode(texture(3000, channels))
        records = record(0, tables) + record(channels, encoder.configuration)
        for packet in packets:
            damaged = bytearray(packet)
            if generator.random() < 0.5:
                damaged[generator.integers(len(damaged))] ^= 1 << int(generator.integers(8))
            records += record(int(generator.random() < 0.1), bytes(damaged[: generator.integers(1, len(damaged) + 1)]))
            records += record(0, b"\x01" + generator.bytes(int(generator.integers(200))))
        assert run(program, records)


def test_extreme_steps_and_levels(program: Path) -> None:
    section = Rotation((0, 63), (COMMON, OWN, COMMON, COMMON), (48,), ((16,),)).pack()
    greatest = core.STEP_CODES - 1
    for codes, rate_controlled, rotation, shape in itertools.product(
        ([0, 0], [greatest, greatest], [0, greatest]), (False, True), (b"", section), (b"", b"\xff" * 2)
    ):
        for hop in core.HOPS:
            configuration = mdct.configuration(hop, 2, codes, 31, rate_controlled, shape, rotation)
            records = record(0, b"") + record(2, configuration)
            records += b"".join(record(0, b"\x01" + bytes([byte]) * 150) for byte in range(256))
            assert run(program, records)


def test_random_configurations(program: Path) -> None:
    generator = np.random.default_rng(2)
    for _ in range(20):
        configuration = generator.bytes(int(generator.integers(8)))
        records = record(0, generator.bytes(int(generator.integers(2)))) + record(
            int(generator.integers(18)), configuration
        )
        run(program, records + record(0, b"\x01\x55"))


@pytest.mark.parametrize("entropy", ["huffman", "range"])
@pytest.mark.parametrize(("quantiser", "levels", "block"), [("linear", 14, "64"), ("log", 65535, "1024")])
def test_dct_streams_with_losses_damage_and_noise(
    program: Path, entropy: str, quantiser: str, levels: int, block: str
) -> None:
    generator = np.random.default_rng(1)
    setting: Setting = {"entropy": entropy, "quantiser": quantiser, "levels": levels, "block": block}
    for channels in (1, 16):
        stream = encode(texture(3000, channels), RATE_HZ, setting, codec="dct", live=True)
        records = record(channels, stream.header.configuration)
        for packet in stream.packets:
            records += record(int(generator.random() < 0.2), packet)
            damaged = bytearray(packet)
            for _ in range(3):
                damaged[generator.integers(len(damaged))] ^= 1 << int(generator.integers(8))
            records += record(0, bytes(damaged[: generator.integers(1, len(damaged) + 1)]))
            # Ranges of the greatest magnitude, then whatever bits.
            records += record(0, b"\x01" + b"\xff" * 4 * channels + generator.bytes(int(generator.integers(200))))
            records += record(0, b"\x01" + generator.bytes(int(generator.integers(200))))
        assert run(program, records, "dct")


def test_random_configurations_of_dct(program: Path) -> None:
    generator = np.random.default_rng(2)
    for _ in range(20):
        numbers = generator.integers([1, 0, 0, 0], [50, 65536, 64, 1100]).astype("<u2").tobytes()
        configuration = generator.integers(0, 33, 1, dtype=np.uint8).tobytes() + numbers + generator.bytes(2)
        for length in (9, 11):
            records = (
                record(1, configuration[:length]) + record(0, b"\x01" + generator.bytes(150)) + record(1, b"\x55\x66")
            )
            run(program, records, "dct")


HEADS = {
    "slp": [
        (bytes((frame << 5 | 16, 2, 0, 255, 141, *[step_code] * channels)), channels)
        for frame, step_code, channels in ((0, 0, 16), (1, slp.STEP_CODES - 1, 1), (1, 100, 3), (2, 0, 2))
    ],
    "parametric": [(b"\0\0\0\2\0", 16), (b"\x3f\x68\0\2\0", 1), (b"\x1a\x38\1\2\0", 3)],
}


@pytest.mark.parametrize("name", HEADS)
def test_streams_without_a_model_with_losses_and_noise(program: Path, name: str) -> None:
    generator = np.random.default_rng(3)
    for configuration, channels in HEADS[name]:
        assert run(program, record(channels, configuration) + losses_and_noise(generator, 60), name)


RANDOM = {"slp": [96, 9, 1, 256, 142, 168, 168], "parametric": [70, 128, 8, 9, 2]}
"""Above each byte of a configuration; the last one or two belong to a channel each."""


@pytest.mark.parametrize("name", RANDOM)
def test_random_configurations_without_a_model(program: Path, name: str) -> None:
    generator = np.random.default_rng(4)
    for _ in range(20):
        configuration = generator.integers(0, RANDOM[name]).astype(np.uint8).tobytes()
        for shorter in (1, 0):
            head = record(2 - shorter if name == "slp" else 1 - shorter, configuration[: len(configuration) - shorter])
            run(program, head + record(0, b"\x01" + generator.bytes(150)), name)


@pytest.mark.parametrize("prior", PRIOR_KINDS)
@pytest.mark.parametrize(("width", "latents"), [(1, 1), (9, 17), (17, 9)])
def test_eva_streams_with_losses_and_noise(program: Path, width: int, latents: int, prior: PriorKind) -> None:
    generator = np.random.default_rng(5)
    image = random_image(1, width, latents, prior)
    for model, channels in ((image, 1), (with_extreme_weights(image, 2), 16)):
        rate_controlled = channels > 1
        configuration = eva.configuration(5, [core.STEP_CODES - 1] * channels, rate_controlled)
        records = record(0, model.pack()) + record(channels, configuration)
        records += losses_and_noise(generator, 30)
        assert run(program, records, "eva")


def test_damaged_models_and_configurations_of_eva(program: Path) -> None:
    generator = np.random.default_rng(6)
    for trial in range(40):
        model = bytearray(random_image(trial, prior=PRIOR_KINDS[trial % 2]).pack())
        if trial > 3:
            model[generator.integers(9 if trial % 4 else len(model))] = generator.integers(256)
            model = model[: len(model) - int(generator.choice([0, 0, 1, 500]))]
        head = generator.integers(0, 256, int(generator.integers(8)), dtype=np.uint8).tobytes()
        configuration = head if trial % 3 else eva.configuration(3, [700])
        records = record(0, bytes(model)) + record(1, configuration) + record(0, b"\x01" + generator.bytes(150))
        run(program, records, "eva")


def test_output_of_extreme_signals_scales_and_rates(program: Path) -> None:
    generator = np.random.default_rng(7)
    described = [PIEZO_STACK, LRA, VOICE_COIL]
    described += [replace(LRA, quality=200.0), replace(LRA, quality=30.0, maximum_boost=1.0)]
    described += [replace(PIEZO_STACK, dac_rate_hz=1_000_000), replace(PIEZO_STACK, dac_bits=2, power_limit=1e-12)]
    described += [replace(LRA, corner_hz=2000.0, quality=50.0, slew_volts_per_second=1e-9, stroke_um=1e-30)]
    for trial in range(32):
        actuator = described[trial % len(described)]
        channels = int(generator.integers(1, 17))
        highest_hz = min(200_000, 128 * actuator.dac_rate_hz)
        lowest_hz = max(100, actuator.dac_rate_hz // 50)
        rate_hz = int(generator.choice([lowest_hz, 2800, actuator.dac_rate_hz, highest_hz]))
        rate_hz = min(highest_hz, max(lowest_hz, rate_hz))
        scales = generator.choice([0x0001, 0x0080, 0x3F80, 0x7F7F], channels)
        stream = {"rate_hz": rate_hz, "unit": trial % 3, "channels": channels, "gain": scales.tolist()}
        library()  # declares the structures
        records = record(trial // 3 % 2, bytes(ffi.buffer(ffi.new("vc_actuator *", constants(actuator)))))
        records += record(0, bytes(ffi.buffer(ffi.new("vc_output_stream *", stream))))
        for kind in generator.integers(0, 6, 8):
            gain = generator.choice(np.array([0, 1, 0x3F000000, 0x7F7FFFFF, 0xFF800000], "<u4"))
            extremes = np.array([-32768, -1, 0, 1, 32767], "<i2")
            samples = generator.choice(extremes, (int(generator.integers(60)), channels)).repeat(trial % 4 + 1, axis=0)
            records += record(int(kind) % 5, gain.tobytes() if kind == 1 else samples.tobytes())
        assert run(program, records + record(4, b"") + record(3, b""), "output")


def test_output_of_what_cannot_be_played(program: Path) -> None:
    generator = np.random.default_rng(8)
    library()  # declares the structures
    actuator, stream = ffi.new("vc_actuator *", constants(PIEZO_STACK)), ffi.new("vc_output_stream *")
    for _ in range(20):
        damaged = generator.bytes(ffi.sizeof("vc_output_stream"))
        records = record(1, bytes(ffi.buffer(actuator))) + record(0, damaged) + record(0, generator.bytes(64))
        run(program, records, "output")
    assert library().vc_drive_size(actuator, stream) == 0
