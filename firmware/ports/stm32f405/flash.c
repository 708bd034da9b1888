/* Flash for model images. RM0090: 3.6 (erase and program operations), 3.9 (registers).
 *
 * The processor cannot fetch from flash meanwhile, so it waits in RAM. The interrupts are in RAM too: DAC and serial
 * port go on.
 */
#include "board.h"

#define BASE 0x08000000u
#define SECTORS 12

/* 4 s at 168 MHz at least, twice what a sector may take (datasheet DS8626, table 42). */
#define LONGEST_WAIT (1u << 26)

/* Table 5: where each sector begins. */
static const uint32_t sector_start[SECTORS + 1] = {0x00000, 0x04000, 0x08000, 0x0C000, 0x10000, 0x20000, 0x40000,
                                                   0x60000, 0x80000, 0xA0000, 0xC0000, 0xE0000, 0x100000};

/* Waits until the flash is ready; returns 0 if it reports no error. */
VC_INSIDE_RAM int finish(void)
{
    uint32_t turns = 0;
    __asm volatile("dsb" ::: "memory"); /* all writes to flash have arrived */
    while (VC_FLASH_SR & VC_FLASH_BUSY && turns++ < LONGEST_WAIT)
        vc_watchdog_feed();
    return (VC_FLASH_SR & (VC_FLASH_BUSY | VC_FLASH_ERRORS)) != 0;
}

static void unlock(void)
{
    VC_FLASH_KEYR = VC_FLASH_KEY_1;
    VC_FLASH_KEYR = VC_FLASH_KEY_2;
    VC_FLASH_SR = VC_FLASH_ERRORS;
}

static void lock(void)
{
    VC_FLASH_CR = VC_FLASH_LOCK;
}

/* 3.6.3, sector erase. */
VC_IN_RAM static int erase_sector(uint32_t sector)
{
    int failed = finish();
    VC_FLASH_CR = VC_FLASH_SECTOR_ERASE | VC_FLASH_BY_WORDS | sector << VC_FLASH_SECTOR_SHIFT;
    VC_FLASH_CR |= VC_FLASH_START;
    return finish() || failed;
}

/* 3.6.4: bytes up to a whole word, words, and the remaining bytes. */
VC_IN_RAM static int program_all(uint32_t address, const uint8_t *data, uint32_t length)
{
    int failed = finish();
    while (length > 0 && !failed) {
        uint32_t step = 1;
        if (address % 4 == 0 && length >= 4) {
            step = 4;
            VC_FLASH_CR = VC_FLASH_PROGRAM | VC_FLASH_BY_WORDS;
            VC_REGISTER(address) = data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
        } else {
            VC_FLASH_CR = VC_FLASH_PROGRAM;
            *(volatile uint8_t *)(uintptr_t)address = *data;
        }
        failed = finish();
        address += step;
        data += step;
        length -= step;
    }
    return failed;
}

/* 3.5.2: the data cache may still hold the erased sector. */
static void forget_cached(void)
{
    VC_FLASH_ACR &= ~(uint32_t)VC_FLASH_DATA_CACHE;
    VC_FLASH_ACR |= VC_FLASH_DATA_CACHE_RESET;
    VC_FLASH_ACR &= ~(uint32_t)VC_FLASH_DATA_CACHE_RESET;
    VC_FLASH_ACR |= VC_FLASH_DATA_CACHE;
}

static int erase(void *context, uint32_t offset, uint32_t length)
{
    const uint8_t *memory = (const uint8_t *)(uintptr_t)(BASE + offset);
    uint32_t sector, place;
    int failed = 0;
    (void)context;
    unlock();
    for (sector = 0; sector < SECTORS; sector++)
        if (sector_start[sector] >= offset && sector_start[sector + 1] <= offset + length && !failed)
            failed = erase_sector(sector);
    lock();
    forget_cached();
    for (place = 0; place < length && !failed; place++)
        failed = memory[place] != 0xFF;
    return failed;
}

static int program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    const uint8_t *memory = (const uint8_t *)(uintptr_t)(BASE + offset);
    uint32_t place;
    int failed;
    (void)context;
    unlock();
    failed = program_all(BASE + offset, data, length);
    lock();
    for (place = 0; place < length && !failed; place++)
        failed = memory[place] != data[place];
    return failed;
}

const vc_flash vc_board_flash = {
    .base = (const uint8_t *)BASE,
    .record = {0x04000, 0x08000},
    .record_bytes = 0x4000,
    .slot = {0x80000, 0xC0000},
    .slot_bytes = 0x40000,
    .write_bytes = 1,
    .erase = erase,
    .program = program,
};
