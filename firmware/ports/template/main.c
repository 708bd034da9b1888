/* A controller on your board: copy this folder, and fill in each function below.
 *
 * Each says by VC_MISSING that it is to be written; delete this line then. The build names those that are left.
 * docs/how-to/port_the_firmware.md takes you through them in this order.
 */
#include "vibrocast/actuator_tables.h"
#include "cortex_m.h"
#include "missing.h"
#include "vibrocast/port.h"
#include "vibrocast/sizes.h"

/* The vector table: for interrupts of your board, append their handlers, as ports/stm32f405/main.c does. */
static void on_fault(void);
static const vc_core_vectors vectors __attribute__((section(".vectors"), used)) = VC_CORE_VECTORS(on_fault, on_fault);

/* Step 2. Starts clocks, the watchdog, the link and the DAC, in this order. */
static void board_start(void)
{
    VC_MISSING(board_start);
}

/* Step 2. Restarts the watchdog's time. */
static void watchdog_feed(void)
{
    VC_MISSING(watchdog_feed);
}

/* Step 2. Brings the output to rest, without interrupts, and waits until the watchdog resets the board. */
static void on_fault(void)
{
    VC_MISSING(on_fault);
}

/* Step 3. Copies up to `capacity` bytes from the host into `data`; returns how many there were. Never waits. */
size_t vc_port_read(uint8_t *data, size_t capacity)
{
    VC_MISSING(vc_port_read);
    (void)data;
    (void)capacity;
    return 0;
}

/* Step 3. Takes up to `length` bytes for the host from `data`; returns how many it took. Never waits. */
size_t vc_port_write(const uint8_t *data, size_t length)
{
    VC_MISSING(vc_port_write);
    (void)data;
    (void)length;
    return 0;
}

/* Step 4. Returns microseconds, which never go back, of the oscillator that drives the DAC. */
uint64_t vc_port_now_us(void)
{
    VC_MISSING(vc_port_now_us);
    return 0;
}

/* Step 5. Sets `length` bytes from `offset` on to 0xFF; returns 0, or another number if the flash failed. */
static int flash_erase(void *context, uint32_t offset, uint32_t length)
{
    VC_MISSING(flash_erase);
    (void)context;
    (void)offset;
    (void)length;
    return -1;
}

/* Step 5. Writes whole pieces of write_bytes, each once after an erasure; returns as flash_erase does. */
static int flash_program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    VC_MISSING(flash_program);
    (void)context;
    (void)offset;
    (void)data;
    (void)length;
    return -1;
}

/* Step 6. Plays samples x channels codes, interleaved, 0 = rest. */
static void dac_play(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    VC_MISSING(dac_play);
    (void)context;
    (void)codes;
    (void)samples;
    (void)channels;
    (void)due_us;
}

/* Step 5. The places of records and slots, whole sectors of your flash, from `base` on, and its smallest write. A board
 * without model images needs none of step 5: give NULL to vc_loop_start. */
static const vc_flash flash = {
    .base = (const uint8_t *)0x08000000,
    .record = {0x40000, 0x44000},
    .record_bytes = 0x4000,
    .slot = {0x80000, 0xC0000},
    .slot_bytes = 0x40000,
    .write_bytes = 8,
    .erase = flash_erase,
    .program = flash_program,
};

/* Step 6. With an interrupt at each sample, use ports/cortex_m/paced_output.h, and give vc_paced_dac instead. */
static const vc_dac_port dac = {.play = dac_play};

/* Step 7. */
int main(void)
{
    static const vc_controller_settings settings = {
        .build = VC_BUILD,
        .hardware = VC_HARDWARE,
        .actuator = &VC_ACTUATOR(vc_piezo_stack_12_bits),
        .public_key = (const uint8_t *)VC_PUBLIC_KEY,
        .verify_signature = vc_port_verify_signature,
        .watchdog_ms = 2000,
    };
    board_start();
    if (vc_loop_start(&settings, &flash, &dac) != VC_OK)
        return 1; /* settings that cannot be, or a key without a verifier: the board does nothing */
    /* The loop never sleeps. Where an interrupt comes every millisecond at least, such as that of
     * ports/cortex_m/systick.h, the board may save power: call vc_wait_for_interrupt() if vc_loop_turn() returns 0. */
    for (;;) {
        watchdog_feed();
        vc_loop_turn();
    }
}
