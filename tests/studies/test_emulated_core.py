"""Decoders on emulated processors: the host's integers, kernels alike, ARM's cycles, and the costs that are stated."""

from importlib.util import find_spec
from itertools import product
from pathlib import Path

import capstone
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from studies import compilers, emulated_core, firmware, small_parts, worst_case
from studies.emulated_core import CORES, RISC_V, ZIG, Core, EmulatedCore, compile_core
from studies.small_parts import PROCESSORS, Cost
from studies.worst_case import Turn
from tests.codec.eva_models import model_with, random_image, with_extreme_weights
from vibrocast import textures
from vibrocast.codec import Stream, eva
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import image_hash, read_stream
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.evaluation import points
from vibrocast.harness.boards.cycles import block_cycles

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("ziglang") is None, reason="no compiler for microcontrollers"),
]

STREAMS = Path(__file__).parents[1] / "codec"
RESULTS = Path(__file__).parents[2] / "docs" / "benchmarks" / "results"
PROMPT_MS = 30.0
M4F = CORES["M4F"]
LIMITS_PERCENT = {"mdct": 3.0, "eva-16": 3.0, "eva-128": 75.0}
"""Wanted: less than this load of a Cortex-M4F."""
BUILDS = [("M4F", 0), ("M4F", 1), ("M7", 0), ("M33", 0), ("M0+", 0)]
FUNCTIONS = [
    f"vc_{name}_{function}"
    for name in ("mdct", "dct", "slp", "parametric", "eva")
    for function in ("decoder_size", "decoder_init", "decoder_packet_samples", "decode")
]
KERNELS = ["vc_dot_products", *(f"vc_eva_{name}" for name in ("products", "squares", "normalise", "scale"))]
AREA = 0x6000_0000


class Programs(dict[tuple[str, int], Path]):
    """The core for each processor, with DSP instructions (0) and in portable C (1); compiled at first need."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __missing__(self, build: tuple[str, int]) -> Path:
        core, portable = build
        self[build] = compile_core(
            self._folder / f"{core}-{portable}.elf",
            CORES[core],
            [*FUNCTIONS, *KERNELS],
            {"VC_MAX_CHANNELS": 2, **({"VC_PORTABLE": 1} if portable else {})},
        )
        return self[build]


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Programs:
    return Programs(tmp_path_factory.mktemp("programs"))


def golden(name: str) -> Stream:
    image = STREAMS / f"golden_{name.removesuffix('_steered')}.vcmi"
    return read_stream(STREAMS / f"golden_{name}.vct", image.read_bytes() if image.exists() else None)


@pytest.mark.parametrize("build", BUILDS, ids=str)
@pytest.mark.parametrize(
    "name", ["mdct", "dct_huffman", "dct_range", "slp", "parametric", "eva_adaptive", "eva_static_steered"]
)
def test_golden_streams_decode_to_the_hosts_samples(name: str, build: tuple[str, int], programs: Programs) -> None:
    coded = golden(name)
    run = emulated_core.decode(programs[build], CORES[build[0]], coded)
    np.testing.assert_array_equal(run.decoded, coded.decode_integers())
    assert np.any(run.decoded) and run.cycles > run.instructions > 100
    assert 100 < run.stack_bytes < 4096, "what eva.h says"


@pytest.mark.parametrize("build", BUILDS, ids=str)
@pytest.mark.parametrize(
    ("width", "latents", "seed"), [(5, 3, 0), (7, 9, 1), (12, 16, 2), (24, 8, 3), (15, 32, 4), (16, 16, 5), (48, 5, 6)]
)
@pytest.mark.parametrize("extreme", [False, True])
def test_models_of_any_width_decode_to_the_hosts_samples(
    width: int, latents: int, seed: int, extreme: bool, build: tuple[str, int], programs: Programs
) -> None:
    """Of random bytes, which make latents of any size."""
    model = random_image(seed, width, latents)
    tables = (with_extreme_weights(model, seed) if extreme else model).pack()
    random = np.random.default_rng(seed)
    packets = tuple(b"\x01" + random.bytes(200) for _ in range(3))
    image = model_with(tables).image
    header = StreamHeader(
        eva.IDENTIFIER, 2800, None, "full scale", (1.0,), eva.configuration(5, [1000]), image_hash(image)
    )
    coded = Stream(header, packets, image)
    run = emulated_core.decode(programs[build], CORES[build[0]], coded)
    np.testing.assert_array_equal(run.decoded, coded.decode_integers())


def int16s(values: NDArray[np.int64]) -> bytes:
    return values.astype("<i2").tobytes()


def in_kernel_order(values: NDArray[np.int64], channels: int, portable: int) -> NDArray[np.int64]:
    """Columns of activations as the kernels keep them between squares, norms and products, or back from that order."""
    if portable or channels % 16 != 0:
        return values
    return values.reshape(-1, 2, 2).transpose(0, 2, 1).ravel()


ACTIVATIONS = st.sampled_from([-32767, -32766, -16384, -1, 0, 1, 2, 16384, 32766, 32767]) | st.integers(-32767, 32767)
WEIGHTS = st.sampled_from([-128, -127, -1, 0, 1, 127]) | st.integers(-128, 127)
WIDTHS = st.sampled_from([16, 32, 48, 128]) | st.integers(1, 40)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_sums_of_products_are_exact(data: st.DataObject, programs: Programs) -> None:
    rows, columns, odd = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 9)), data.draw(st.integers(0, 1))
    channels, taps = data.draw(WIDTHS), data.draw(st.integers(1, 3))
    length = taps * channels
    weights = np.resize(data.draw(st.lists(WEIGHTS, min_size=1, max_size=60)), rows * length)
    inputs = np.resize(data.draw(st.lists(ACTIVATIONS, min_size=1, max_size=60)), channels * (columns + taps - 1))
    expected = [
        weights.reshape(rows, length).astype(np.int64) @ inputs[channels * column :][:length]
        for column in range(columns)
    ]
    at_weights, at_inputs, at_sums = AREA + odd, AREA + 0x8002, AREA + 0x10000  # weights lie at any address
    for portable in (0, 1):
        core = EmulatedCore(programs["M4F", portable], M4F)
        core.write(at_weights, weights.astype(np.int8).tobytes())
        core.write(at_inputs, int16s(in_kernel_order(inputs, channels, portable)))
        core.call("vc_eva_products", at_weights, rows, taps, at_inputs, channels, columns, at_sums)
        sums = np.frombuffer(core.read(at_sums, 4 * rows * columns), "<i4")
        np.testing.assert_array_equal(sums, np.concatenate(expected))
        core.write(at_inputs, int16s(inputs))
        core.call("vc_dot_products", at_weights, rows, length, at_inputs, at_sums)
        np.testing.assert_array_equal(np.frombuffer(core.read(at_sums, 4 * rows), "<i4"), expected[0])


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_squares_and_normalisation_are_alike_with_dsp_instructions_and_without(
    data: st.DataObject, programs: Programs
) -> None:
    channels, columns = data.draw(WIDTHS), data.draw(st.integers(1, 3))
    count = channels * columns
    values = np.resize(data.draw(st.lists(ACTIVATIONS, min_size=1, max_size=count)), count)
    most = 127 * 32767 * 128
    numbers = st.integers(0, most) | st.just(most)
    sums = np.resize(data.draw(st.lists(numbers, min_size=1, max_size=count)), count)
    signs = np.resize(data.draw(st.lists(st.sampled_from([-1, 1]), min_size=1, max_size=count)), count)
    wide = st.sampled_from([0, 1, 2**31, 2**32 - 1]) | st.integers(0, 2**32 - 1)
    multipliers = np.resize(data.draw(st.lists(wide, min_size=1, max_size=channels)), channels)
    limit = 2**30 - 1
    energies = st.integers(0, 40) | st.integers(1, 32767).map(lambda root: root**2 - 1) | st.integers(0, limit)
    constants = np.resize(data.draw(st.lists(energies, min_size=1, max_size=channels)), channels)
    shift = data.draw(st.integers(0, 30))
    results = []
    for portable in (0, 1):
        core = EmulatedCore(programs["M4F", portable], M4F)
        addresses = [AREA + 0x1000 * number for number in range(9)]
        at_values, at_sums, at_multipliers, at_constants, at_squares, at_doubled, at_normalised = addresses[:7]
        at_signed, at_scaled = addresses[7:]
        core.write(at_values, int16s(values))
        for address, written in (
            (at_sums, sums),
            (at_multipliers, multipliers),
            (at_constants, constants),
            (at_signed, signs * sums),
        ):
            core.write(address, (written & 0xFFFF_FFFF).astype("<u4").tobytes())
        core.call("vc_eva_squares", at_values, channels, columns, at_squares, at_doubled)
        at_all = (at_values, channels, columns, at_sums, at_doubled, at_multipliers, at_constants, shift, at_normalised)
        core.call("vc_eva_normalise", *at_all)
        stride = channels + 2
        core.call("vc_eva_scale", at_signed, at_multipliers, channels, columns, at_scaled, stride)
        for address in (at_squares, at_normalised):
            written = np.frombuffer(core.read(address, 2 * count), "<i2").astype(np.int64)
            results.append(int16s(in_kernel_order(written, channels, portable)))
        results += [core.read(at_doubled, 4 * columns), core.read(at_scaled, 2 * stride * columns)]
    assert results[: len(results) // 2] == results[len(results) // 2 :]


@pytest.mark.parametrize("core", [CORES["M0+"], RISC_V], ids=lambda core: core.title)
def test_a_whole_controller_plays_at_the_stored_load(core: Core, tmp_path: Path) -> None:
    """To a twentieth, as compilers differ."""
    rows = points.read_rows(RESULTS / compilers.TABLE, compilers.Row)
    stored = next(
        row
        for row in rows
        if (row.processor, row.program, row.codec, row.level, row.compiler)
        == (core.title, compilers.CONTROLLER, "slp", "-Os", "zig")
    )
    texture = textures.resample(textures.GENERATORS["rough"](3, compilers.SECONDS), compilers.RATE_HZ)
    stream = encode_recording(texture, codec_name="slp", snr_db=compilers.SNR_DB, live=True).stream
    program = compilers.compile_controller(tmp_path / "controller.elf", core, "slp", ZIG, "-Os")
    emulated = EmulatedCore(program, core)
    assert compilers.play(emulated, core, stream) == pytest.approx(stored.per_sample, rel=0.05)
    assert emulated.flash_bytes == pytest.approx(stored.flash, rel=0.05)


@pytest.mark.parametrize(
    ("instructions", "cycles"),
    [
        ("0868 1168", 3),  # ldr r0, [r1]; ldr r1, [r2]: ARM DDI 0439, 3.3.3
        ("8858 5861", 2 + 1),  # ldr r0, [r1, r2]; str r0, [r3, #20]
        ("4859 1168 5a68", 4),  # ldr r0, [r1, r5]; ldr r1, [r2]; ldr r2, [r3, #4]
        ("0868 0168", 4),  # ldr r0, [r1]; ldr r1, [r0]: waits for the first
        ("0931 0868", 1 + 3),  # adds r1, #9; ldr r0, [r1]: waits for the sum
        ("f0b5", 6),  # push {r4, r5, r6, r7, lr}
        ("1ec9", 5),  # ldm r1!, {r1, r2, r3, r4}
        ("b0fbf1f0", 12),  # udiv r0, r0, r1
        ("20fb0100", 1),  # smlad r0, r0, r1, r0
        ("00fb1100", 1),  # mls r0, r0, r1, r0
    ],
)
def test_cycles_are_those_of_the_reference_manual(instructions: str, cycles: int) -> None:
    disassembler = capstone.Cs(capstone.CS_ARCH_ARM, capstone.CS_MODE_THUMB | capstone.CS_MODE_MCLASS)
    disassembler.detail = True
    block = list(disassembler.disasm(bytes.fromhex(instructions), 0))
    assert block
    assert block_cycles(block) == cycles


def test_the_shipped_figures_are_what_is_counted(programs: Programs) -> None:
    """To a twentieth, as compilers differ; and the loads that are wanted are met by instructions."""
    loads = firmware.stored(firmware.Load)
    rows = [row for row in loads if (row.core, row.kernels) == ("M4F", "DSP instructions")]
    stream, _ = firmware.coded("mdct", "rough")
    run = emulated_core.decode(programs["M4F", 0], M4F, stream)
    shipped = next(row for row in rows if (row.decoder, row.texture) == ("mdct", "rough"))
    assert shipped.instructions == pytest.approx(run.instructions, rel=0.05), "run studies.firmware"
    for decoder, percent in LIMITS_PERCENT.items():
        counts = [row.instructions for row in rows if row.decoder == decoder]
        assert 100 * max(counts) * firmware.RATE_HZ / M4F.clock_hz < percent


def test_loads_and_sizes_are_measured_of_any_decoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(firmware, "CORES", {"M4F": M4F})
    loads = list(firmware.measure_loads(tmp_path, ["mdct"], ["wood"]))
    (portable, dsp) = firmware.measure_sizes(tmp_path, ["mdct"])
    assert {(load.core, load.kernels) for load in loads} == set(product(("M4F",), ("DSP instructions", "portable C")))
    assert all(load.cycles is None or load.cycles > load.instructions for load in loads)
    for size in (portable, dsp):
        assert size.state_1_bytes < size.state_2_bytes < size.state_4_bytes


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> EmulatedCore:
    return worst_case.emulated(tmp_path_factory.mktemp("worst_case"))


@pytest.mark.parametrize(
    ("decoder", "block"), [("mdct", "128"), ("dct", "1024"), ("slp", "32"), ("parametric", "16"), ("eva-16", "")]
)
def test_noise_costs_no_more_than_the_firmware_states(decoder: str, block: str, hostile: EmulatedCore) -> None:
    noise_cycles, stated_cycles = worst_case.noise(hostile, decoder, block, channels=1)
    assert noise_cycles < stated_cycles < 1.2 * noise_cycles


def test_a_board_stops_at_once_whatever_it_decodes(hostile: EmulatedCore) -> None:
    _, stream = worst_case.measure(hostile, "dct", "1024", 2, tries=2)
    turn = worst_case.on_board(stream, 12_000, stops=2)
    assert turn.turn_ms is not None and 5 < turn.turn_ms < PROMPT_MS
    assert turn.stop_ms is not None and 0 < turn.stop_ms < PROMPT_MS


def test_a_board_rejects_a_stream_that_it_cannot_decode_in_time(hostile: EmulatedCore) -> None:
    _, stream = worst_case.measure(hostile, "slp", "128", 2, tries=0)
    assert worst_case.on_board(stream, 12_000, stops=1) == Turn("slp", 2, 12_000)


def test_the_table_of_turns_has_none_that_is_late() -> None:
    turns = points.read_rows(RESULTS / worst_case.TURNS, Turn)
    assert all((turn.stop_ms or 0.0) < PROMPT_MS and (turn.turn_ms or 0.0) < PROMPT_MS for turn in turns)


@pytest.mark.parametrize("processor", PROCESSORS, ids=lambda processor: processor.title)
def test_each_processor_decodes_to_the_same_bits_in_the_memory_that_is_stated(tmp_path: Path, processor: Core) -> None:
    recording = textures.GENERATORS["rough"](3, 0.2)
    stream = encode_recording(recording, codec_name="slp", snr_db=12, live=True).stream
    core = EmulatedCore(small_parts.compile_decoder(tmp_path / "slp.elf", processor, "slp"), processor)
    ram, per_sample = small_parts.run(core, processor, bytes(stream), None)
    rows = points.read_rows(RESULTS / small_parts.TABLE, Cost)
    assert {(row.processor, row.decoder) for row in rows} >= set(
        product((each.title for each in PROCESSORS), small_parts.DECODERS)
    )
    (row,) = (row for row in rows if (row.processor, row.decoder) == (processor.title, "slp"))
    assert row.ram == ram
    assert row.flash == pytest.approx(core.flash_bytes, 0.02)
    assert row.per_sample is not None and per_sample < row.per_sample
    assert core.stack_bytes <= max(row.stack for row in rows) <= 4096  # as vibrocast/decoder.h says
    last = stream.decode_integers()[-stream.packet_samples :]
    samples = np.frombuffer(core.read(small_parts._SAMPLES, 2 * last.size), "<i2")
    np.testing.assert_array_equal(samples, last.ravel())
