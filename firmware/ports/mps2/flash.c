/* Flash in the board's memory: it behaves like NOR flash, and keeps its content until power-off. */
#include "board.h"

#define VC_RECORD_BYTES 4096u
#define VC_SLOT_BYTES (1u << 20)
#define VC_FLASH_BYTES (2 * VC_RECORD_BYTES + 2 * VC_SLOT_BYTES)

static uint8_t memory[VC_FLASH_BYTES] __attribute__((section(".model_flash")));

static int erase(void *context, uint32_t offset, uint32_t length)
{
    (void)context;
    memset(memory + offset, 0xFF, length);
    return 0;
}

static int program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    (void)context;
    for (; length > 0; length--)
        memory[offset++] &= *data++;
    return 0;
}

const vc_flash vc_board_flash = {
    .base = memory,
    .record = {0, VC_RECORD_BYTES},
    .record_bytes = VC_RECORD_BYTES,
    .slot = {2 * VC_RECORD_BYTES, 2 * VC_RECORD_BYTES + VC_SLOT_BYTES},
    .slot_bytes = VC_SLOT_BYTES,
    .write_bytes = 1,
    .erase = erase,
    .program = program,
};
