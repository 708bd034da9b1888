"""The RP2040's port on an emulated board: its boot, its flash, what it plays and how it rests."""

import struct
import zlib

import numpy as np
import pytest
from unicorn import UC_HOOK_CODE, arm_const

from tests.firmware.boards import LEARNED, between_rests, coded, play_as_computed, session
from tests.firmware.test_targets import functions
from vibrocast import models
from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.harness.boards.emulator import EmulationError
from vibrocast.harness.boards.rp2040 import FLASH_BYTES, UNIQUE_NUMBER, Rp2040
from vibrocast.host import uploader
from vibrocast.output.actuator import LRA, Codes
from vibrocast.simulated_device.flash import FlashMemory

FLASH, BOOT_RAM = 0x1000_0000, 0x2004_1F00


def test_the_board_states_its_unique_number_and_a_haptic_driver_gets_the_upper_bits_of_each_sample() -> None:
    device = Rp2040(image="rp2040-drv260x")
    link, host = session(device)
    assert bytes.fromhex(host.description.serial_number) == UNIQUE_NUMBER
    # DRV2605 datasheet, 8.6: rest, two voltages, ERM with its other bits as after power-up, open loop, RTP.
    assert device.haptic_writes == [(2, 0), (0x16, 0x3E), (0x17, 0x8C), (0x1A, 0x36), (0x1D, 0x20), (1, 5)]
    device.haptic_writes.clear()
    expected = play_as_computed(link, host, coded("mdct", channels=1), LRA)
    inputs = np.maximum(expected[:, 0] >> 8, -127)
    changes = inputs[np.flatnonzero(np.diff(inputs, prepend=0))]
    values = [value for address, value in device.haptic_writes if address == 2]
    written = np.array(values, np.uint8).astype(np.int8)
    written = written[np.flatnonzero(np.diff(written, prepend=0))]
    # Every 40 ms a value or a register of the set-up is sent again, in place of a sample.
    assert len(changes) > 100 and 0 <= len(changes) - len(written) < 10
    assert set(written) <= set(changes) and written[-1] == 0
    assert len(device.haptic_writes) - len(values) >= 4


def i2s_bits(program: list[int], frames: list[int]) -> list[tuple[int, int]]:
    """Run the PIO's program (RP2040 datasheet, 3.4); return word select and data at each rise of the bit clock."""
    found = []
    place, x, data, clock, frame_bits = 0, 14, 0, 0, [word >> bit & 1 for word in frames for bit in range(31, -1, -1)]
    while frame_bits or clock == 0:
        instruction = program[place]
        select, rising = instruction >> 12 & 1, instruction >> 11 & 1 > clock
        clock = instruction >> 11 & 1
        place = (place + 1) % len(program)
        match instruction & 0xE7E0, instruction & 0x1F:
            case 0x6000, 1:
                data = frame_bits.pop(0)
            case 0x0040, target:
                place, x = (target if x > 0 else place), (x - 1) % 2**32
            case 0xE020, value:
                x = value
            case other:
                raise AssertionError(other)
        if rising:
            found.append((select, data))
    return found


def test_an_amplifier_on_i2s_gets_each_sample_at_8000_hz() -> None:
    codes: list[Codes] = []
    device = Rp2040(on_dac=codes.append, image="rp2040-i2s")
    link, host = session(device)
    expected = play_as_computed(link, host, coded("mdct"), LRA)
    played = np.concatenate(codes)
    assert len(played) == pytest.approx(link.now_us * 8000 / 1e6, abs=32)  # the boot, which takes no time, comes first
    np.testing.assert_array_equal(between_rests(played), between_rests(expected))
    # 120 MHz / (8000 Hz x 64 cycles a frame), in 16 bits and a fraction of 8.
    assert device._registers[0x1020_00C8] == 234.375 * 65536
    program = [device._registers[0x1020_0048 + 4 * place] for place in range(8)]
    bits = i2s_bits(program, [0x8001_7FFE, 0x5555_0F0F])
    # I2S: low is the left channel; the highest bit comes one bit clock after word select has changed.
    assert [select for select, _ in bits] == ([0] * 15 + [1] * 16 + [0]) * 2
    assert int("".join(str(data) for _, data in bits), 2) == 0x8001_7FFE_5555_0F0F


def test_images_outlive_a_restart_and_a_stream_of_bytes_goes_on_meanwhile() -> None:
    flash = FlashMemory(FLASH_BYTES)
    codes: list[Codes] = []
    device = Rp2040(flash, codes.append)
    link, host = session(device)
    firmware = bytes(flash.contents[:0xF_8000])
    kept = uploader.flash(host, models.find(LEARNED).image)
    assert bytes(flash.contents[:0xF_8000]) == firmware
    assert bytes(flash.contents[0xF_8000:]).strip(b"\xff")
    # The sample clock went on while flash could not be read.
    assert len(np.concatenate(codes)) == pytest.approx(link.now_us * 3000 / 1e6, rel=0.01)
    running = uploader.running(session(Rp2040(flash))[1])
    assert running is not None
    assert (running.slot, running.sha256) == (kept.slot, kept.sha256)


def test_the_watchdog_resets_a_board_whose_loop_stands_still() -> None:
    device = Rp2040()
    device.advance(0)
    device._interrupt = lambda exception: None  # type: ignore[method-assign]
    with pytest.raises(EmulationError, match=r"watchdog.*4\.0 s"):
        for now_us in range(0, 5_000_000, 100_000):
            device.advance(now_us)


def test_the_second_stage_of_the_boot_sets_up_flash_and_starts_the_program() -> None:
    """It runs from RAM, where the boot ROM copies it; its checksum is that of the datasheet."""
    image = Elf(build("rp2040"))
    stage = next(segment.data for segment in image.segments if segment.address == FLASH)
    assert len(stage) == 256
    reversed_bits = bytes(int(f"{byte:08b}"[::-1], 2) for byte in stage[:252])
    reflected = zlib.crc32(reversed_bits) ^ 0xFFFF_FFFF
    assert struct.unpack("<I", stage[252:])[0] == int(f"{reflected:032b}"[::-1], 2)

    device = Rp2040()
    unicorn = device.processor.unicorn
    written: list[tuple[int, int]] = []
    unicorn.mem_unmap(0x1800_0000, 4096)
    device.processor.add_registers(0x1800_0000, lambda offset: 0, lambda offset, value: written.append((offset, value)))
    unicorn.mem_write(BOOT_RAM, stage)
    unicorn.reg_write(arm_const.UC_ARM_REG_SP, BOOT_RAM)
    reset = image.symbols["Reset_Handler"] & ~1
    unicorn.hook_add(UC_HOOK_CODE, lambda *_: unicorn.emu_stop(), None, reset, reset)
    unicorn.ctl_flush_tb()
    unicorn.emu_start(BOOT_RAM | 1, 0)
    assert unicorn.reg_read(arm_const.UC_ARM_REG_PC) == reset
    assert unicorn.reg_read(arm_const.UC_ARM_REG_SP) == image.symbols["vc_stack_top"]
    assert device._system[0xD08] == image.sections[".vectors"].address
    # RP2040 datasheet, 4.10.13: off, half of the clock, words on two wires, fast read dual output, on.
    assert written[0] == (0x08, 0) and written[-1] == (0x08, 1)
    assert dict(written[1:-1]) == {0x14: 2, 0xF0: 1, 0x00: 0x003F_0300, 0x04: 0, 0xF4: 0x3B00_4218}


def test_what_runs_while_flash_is_changed_reads_nothing_in_flash() -> None:
    """All code but that of signatures is in RAM; interrupts and the calls of the ROM do not leave it."""
    image = Elf(build("rp2040"))
    found = functions(image)
    names = {image.functions[start]: start for start in found}
    todo = [names[name] for name in ("vc_output_interrupt", "UART0_IRQ_Handler", "program", "erase")]
    reached: set[int] = set()
    while todo:
        start = todo.pop()
        if start not in reached:
            reached.add(start)
            todo += found[start].callees
    assert names["vc_paced_next"] in reached and names["vc_watchdog_feed"] in reached
    assert all(start >> 28 == 2 for start in reached)


def test_the_file_for_usb_holds_the_flash_of_the_image() -> None:
    path = build("rp2040")
    image, blocks = Elf(path), path.with_suffix(".uf2").read_bytes()
    assert len(blocks) % 512 == 0
    flash = bytearray(b"\xff" * (1 << 20))
    for number in range(len(blocks) // 512):
        block = blocks[512 * number : 512 * (number + 1)]
        start, second, flags, address, size, index, count, family = struct.unpack_from("<8I", block)
        assert (start, second) == (0x0A32_4655, 0x9E5D_5157) and block[-4:] == struct.pack("<I", 0x0AB1_6F30)
        assert (flags, size, index, count, family) == (0x2000, 256, number, len(blocks) // 512, 0xE48B_FF56)
        flash[address - FLASH : address - FLASH + size] = block[32 : 32 + size]
    for segment in image.segments:
        offset = segment.load_address - FLASH
        if segment.data:
            assert flash[offset : offset + len(segment.data)] == segment.data
