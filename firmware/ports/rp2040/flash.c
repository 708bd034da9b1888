/* Flash for model images, by functions of the boot ROM. RP2040 datasheet: 2.8.3.
 *
 * Meanwhile flash cannot be read. All code, interrupts and vectors lie in RAM, so the output and the serial port go on.
 */
#include "board.h"
#include "boot2.h"

#define PAGE 256u
#define SECTOR 4096u
#define BLOCK 65536u
#define BLOCK_ERASE 0xD8u /* command of the flash chip */

#define ROM_CODE(a, b) ((uint32_t)(a) | (uint32_t)(b) << 8)

typedef void *(*rom_lookup)(const uint16_t *table, uint32_t code);

/* 2.8.3: the addresses of the ROM's table of functions and of the function that searches it are at 0x14 and 0x18. */
static uintptr_t rom_function(uint32_t code)
{
    uintptr_t table = 0x14u;
    const volatile uint16_t *known;
    __asm("" : "+r"(table)); /* else GCC takes an address near 0 for a mistake */
    known = (const volatile uint16_t *)table;
    const rom_lookup look_up = (rom_lookup)(uintptr_t)known[2];
    return (uintptr_t)look_up((const uint16_t *)(uintptr_t)known[0], code);
}

static void call_rom(uint32_t code)
{
    ((void (*)(void))rom_function(code))();
}

/* 2.8.3.1.3: in this order before a change, and after it. */
static void begin_change(void)
{
    call_rom(ROM_CODE('I', 'F')); /* connect_internal_flash */
    call_rom(ROM_CODE('E', 'X')); /* flash_exit_xip */
}

static void end_change(void)
{
    call_rom(ROM_CODE('F', 'C')); /* flash_flush_cache, which also lets go of the chip select */
    vc_flash_reads_start();
}

/* Read unique ID, 4Bh: four bytes later come eight (W25Q16JV datasheet, 8.2.30). The ROM has left the interface at
 * bytes on one wire. */
void vc_flash_read_unique(uint8_t *unique)
{
    unsigned place;
    begin_change();
    VC_QSPI_SS_CTRL = VC_QSPI_SS_LOW;
    for (place = 0; place < 5 + VC_UNIQUE_BYTES; place++) {
        uint8_t byte;
        VC_SSI_DR0 = place == 0 ? 0x4B : 0;
        while (!(VC_SSI_SR & VC_SSI_RECEIVED)) {
        }
        byte = (uint8_t)VC_SSI_DR0;
        if (place >= 5)
            unique[place - 5] = byte;
    }
    VC_QSPI_SS_CTRL = VC_QSPI_SS_HIGH;
    end_change();
}

/* `data`: in RAM. */
static void program_page(uint32_t offset, const uint8_t *data)
{
    const uintptr_t address = rom_function(ROM_CODE('R', 'P'));
    begin_change();
    ((void (*)(uint32_t, const uint8_t *, uint32_t))address)(offset, data, PAGE);
    end_change();
}

static void erase_piece(uint32_t offset, uint32_t length)
{
    const uintptr_t address = rom_function(ROM_CODE('R', 'E'));
    begin_change();
    ((void (*)(uint32_t, uint32_t, uint32_t, uint8_t))address)(offset, length, BLOCK, BLOCK_ERASE);
    end_change();
    vc_watchdog_feed();
}

/* A block takes up to 2 s, and a sector 0.4 s (W25Q16JV datasheet, 9.6): the watchdog is fed in between. */
static int erase(void *context, uint32_t offset, uint32_t length)
{
    const uint8_t *memory = (const uint8_t *)(uintptr_t)(VC_FLASH_BASE + offset);
    uint32_t place;
    (void)context;
    vc_watchdog_feed();
    for (place = 0; place < length;) {
        const uint32_t piece = (offset + place) % BLOCK == 0 && length - place >= BLOCK ? BLOCK : SECTOR;
        erase_piece(offset + place, piece);
        place += piece;
    }
    for (place = 0; place < length; place++)
        if (memory[place] != 0xFF)
            return -1;
    return 0;
}

/* The ROM writes whole pages. Bytes of 0xFF change nothing, and `data` may lie in flash itself. */
static int program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    const uint8_t *memory = (const uint8_t *)(uintptr_t)(VC_FLASH_BASE + offset);
    uint8_t page[PAGE];
    uint32_t done = 0, place;
    (void)context;
    while (done < length) {
        const uint32_t inside = (offset + done) % PAGE, room = PAGE - inside;
        const uint32_t count = length - done < room ? length - done : room;
        memset(page, 0xFF, sizeof page);
        memcpy(page + inside, data + done, count);
        program_page(offset + done - inside, page);
        vc_watchdog_feed();
        done += count;
    }
    for (place = 0; place < length; place++)
        if (memory[place] != data[place])
            return -1;
    return 0;
}

const vc_flash vc_board_flash = {
    .base = (const uint8_t *)VC_FLASH_BASE,
    .record = {0x0F8000, 0x0FC000},
    .record_bytes = 0x4000,
    .slot = {0x100000, 0x180000},
    .slot_bytes = 0x80000,
    .write_bytes = 1,
    .erase = erase,
    .program = program,
};
