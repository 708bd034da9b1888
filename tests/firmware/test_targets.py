"""Every image of the firmware: builds, starts as it should, fits its board, calls nothing foreign and not itself."""

import json
import re
import struct
import sys
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path

import capstone
import pytest
from click.testing import CliRunner

from vibrocast.extras import MissingExtraError
from vibrocast.firmware import build as building
from vibrocast.firmware.build import TARGETS, build, size
from vibrocast.firmware.elf import Elf
from vibrocast.firmware.native_core import BuildError

IMAGES = [
    pytest.param(name, marks=[pytest.mark.slow] if name.endswith(("-interrupt", "-qemu")) else [])
    for name, target in TARGETS.items()
    if target.suffix == ".elf"
]
# Functions that compilers call if the processor has no instruction: Run-time ABI for the Arm Architecture.
COMPILERS_OWN = re.compile(
    r"__aeabi_(u?[il]div(mod)?|lmul|l[la]s[lr]|llsr|mem(cpy|clr|set|move)[48]?)|__u?div(mod)?[sd]i[34]|__clz[sd]i2"
    r"|compiler_rt.*"
)
# Of firmware/README.md, in bytes: flash, RAM, stack, deepest calls.
PAGE = {
    name: [int(number.replace(" ", "")) for number in numbers.split(" | ")]
    for name, numbers in re.findall(
        r"^\| `([\w-]+)` \| ([\d ]+(?: \| [\d ]+){3}) \|",
        (building.ROOT / "README.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
}
SOURCES = [path for path in building.ROOT.rglob("*.*") if path.suffix in (".c", ".h") and "build" not in path.parts]


@pytest.mark.parametrize("name", IMAGES)
def test_image_starts_at_reset_with_its_stack_below_what_else_is_in_that_memory(name: str) -> None:
    image = Elf(build(name))
    vectors = image.sections.get(".vectors", image.segments[0]).address
    first = next(segment for segment in image.segments if segment.address == vectors)
    stack_top, reset = struct.unpack_from("<II", first.data)
    stack = image.sections[".stack"]
    assert stack_top == stack.address + stack.size_bytes
    assert reset == image.symbols["Reset_Handler"] and reset & 1
    assert stack.address == min(s.address for s in image.segments if s.address >> 16 == stack.address >> 16)


@pytest.mark.parametrize("name", IMAGES)
def test_image_needs_nothing_but_its_sources_and_division(name: str) -> None:
    words = set(re.findall(r"\w+", "".join(path.read_text() for path in SOURCES)))
    foreign = {name for name in Elf(build(name)).functions.values() if name.split(".")[0] not in words}
    # The linker's way from flash to RAM.
    foreign = {name for name in foreign if not re.match("__Thumbv(7|6M)ABSLongThunk_", name)}
    assert {name for name in foreign if not COMPILERS_OWN.fullmatch(name)} == set()


@dataclass
class Function:
    """Facts from a function's instructions: its most stack, its calls, whether it also calls by pointer."""

    frame_bytes: int = 0
    callees: set[int] = field(default_factory=set)
    calls_by_pointer: bool = False


def functions(image: Elf) -> dict[int, Function]:
    """Return the functions of an image, by address."""
    disassembler = capstone.Cs(capstone.CS_ARCH_ARM, capstone.CS_MODE_THUMB | capstone.CS_MODE_MCLASS)
    disassembler.skipdata = True
    found = {start: Function() for start in image.functions}
    starts = sorted(found)
    for start, end in pairwise([*starts, starts[-1] + 1024]):
        function = found[start]
        code = next(
            s.data[start - s.address : end - s.address] for s in image.segments if 0 <= start - s.address < s.size_bytes
        )
        for instruction in disassembler.disasm(code, start):
            name, operands = instruction.mnemonic.removesuffix(".w"), instruction.op_str
            if name in ("push", "vpush"):
                function.frame_bytes += (4 if name == "push" else 8) * (operands.count(",") + 1)
            elif down := re.search(r"^(?:sub|subw) (?:sp, )?sp, #(\w+)$|\[sp, #-(\w+)\]!", f"{name} {operands}"):
                function.frame_bytes += int(down[1] or down[2], 0)
            elif name[0] == "b" and operands.startswith("#"):
                callee = int(operands[1:], 0)
                if callee in found and callee != start:
                    function.callees.add(callee)
            elif name == "blx" or (name == "bx" and operands != "lr"):
                function.calls_by_pointer = True
    return found


CALLED_BY_POINTER = {
    *("play", "drop", "count", "vc_tables_check", "erase", "program", "erase_sector", "program_all", "write_register"),
    *("check_tables", "check", "init", "feed", "poll"),  # of each codec
}
INTERRUPTS = {
    *("SysTick_Handler", "TIM6_DAC_IRQHandler", "USART3_IRQHandler", "take_received", "go_on_sending"),
    *("vc_output_interrupt", "UART0_IRQ_Handler"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGES)
def test_deepest_calls_with_interrupts_on_top_fit_the_stack(name: str) -> None:
    """No function calls itself: the search would never end."""
    image = Elf(build(name))
    found = functions(image)

    @cache
    def deepest(start: int, without_pointers: bool = False) -> int:
        function = found[start]
        below = [deepest(callee, without_pointers) for callee in function.callees]
        if function.calls_by_pointer and not without_pointers:
            below += [deepest(start, True) for start, name in image.functions.items() if name in CALLED_BY_POINTER]
        return function.frame_bytes + max(below, default=0)

    depth = {name: deepest(start) for start, name in image.functions.items() if name in {"main", *INTERRUPTS}}
    # At two priorities, with the FPU's registers and 8 bytes of alignment each (DDI 0403, B1.5.6 and B1.5.7).
    interrupts = 2 * (104 + 8) + sum(sorted(depth[name] for name in INTERRUPTS & set(depth))[-2:])
    assert 2000 < depth["main"] + interrupts <= image.sections[".stack"].size_bytes
    if name in PAGE:
        assert PAGE[name][3] == pytest.approx(depth["main"] + interrupts, 0.02)


def test_what_runs_while_flash_is_erased_calls_nothing_in_flash() -> None:
    image = Elf(build("stm32f405"))
    in_ram = {start: function for start, function in functions(image).items() if start >> 28 == 2}
    names = {image.functions[start] for start in in_ram}
    assert {"TIM6_DAC_IRQHandler", "USART3_IRQHandler", "SysTick_Handler", "erase_sector", "program_all"} <= names
    assert not any(function.calls_by_pointer or function.callees - set(in_ram) for function in in_ram.values())


def test_sizes_are_those_of_the_page() -> None:
    """To a fiftieth, as compilers differ."""
    assert len(PAGE) == 7
    for name, (flash, ram, stack, _) in PAGE.items():
        of = size(name)
        assert [flash, ram, stack] == pytest.approx([of.flash, of.ram, of.stack], 0.02)


def test_sizes_are_written_as_json(tmp_path: Path) -> None:
    done = CliRunner().invoke(building.main, ["cortex-m4", "--sizes", "--json", str(tmp_path / "sizes.json")])
    assert done.exit_code == 0, done.output
    written = json.loads((tmp_path / "sizes.json").read_text())
    assert written["cortex-m4"]["flash"] == size("cortex-m4").flash
    assert str(written["cortex-m4"]["flash"]) in done.output


def test_what_is_built_is_kept_until_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = building.Target("nothing", ".elf", ("-shared",), ("port",), shared=())
    monkeypatch.setattr(building, "ROOT", tmp_path)
    monkeypatch.setitem(building.TARGETS, "nothing", target)
    (tmp_path / "port").mkdir()
    source = tmp_path / "port" / "nothing.c"
    source.write_text("int nothing(void);\nint nothing(void) { return 0; }\n")
    first = build("nothing")
    assert first.is_file() and build("nothing") == first
    source.write_text("int nothing(void);\nint nothing(void) { return 1; }\n")
    assert build("nothing") != first
    source.write_text("int nothing(void) { return 1 }\n")
    with pytest.raises(BuildError, match=r"cannot be compiled(.|\n)*nothing\.c"):
        build("nothing")


def test_without_a_compiler_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ziglang", None)
    with pytest.raises(MissingExtraError, match=r"needs ziglang; install the extra \[firmware\]: .*pip install"):
        build("cortex-m4")
