/* A controller on a board with an RP2040. */
#include "board.h"
#include "paced_output.h"
#include "vibrocast/port.h"
#include "vibrocast/sizes.h"

/* In cycles of a Cortex-M4, of which this processor needs four times as many: it has no long multiplication. Decoding
 * may take 7 parts in 10 of its time. */
#define DECODING_KILOCYCLES_PER_S (VC_PROCESSOR_HZ / 1000 / 10 * 7 / 4)

/* In RAM, because flash cannot be read while it is being erased; aligned as VTOR requires for 42 entries. */
static struct {
    vc_core_vectors core;
    vc_handler lines[VC_LINES];
} vectors __attribute__((aligned(256)));

static const vc_core_vectors boot_vectors __attribute__((section(".vectors"), used)) =
    VC_CORE_VECTORS(vc_output_rest, vc_output_rest);

static int64_t profile[VC_PROFILE_WORDS] VC_CORE_MEMORY;

/* Writes the flash chip's unique number as hexadecimal digits. */
static const char *serial_number(void)
{
    static char text[2 * VC_UNIQUE_BYTES + 1];
    uint8_t unique[VC_UNIQUE_BYTES];
    unsigned digit;
    vc_flash_read_unique(unique);
    for (digit = 0; digit < 2 * VC_UNIQUE_BYTES; digit++)
        text[digit] = "0123456789abcdef"[unique[digit / 2] >> (digit % 2 ? 0 : 4) & 0xF];
    return text;
}

int main(void)
{
    static vc_controller_settings settings = {.build = VC_BUILD,
                                              .hardware = VC_HARDWARE,
                                              .public_key = (const uint8_t *)VC_PUBLIC_KEY,
                                              .verify_signature = vc_port_verify_signature,
                                              .watchdog_ms = 2000,
                                              .profile = (vc_profile *)profile,
                                              .decoding_kilocycles_per_s = DECODING_KILOCYCLES_PER_S};
    unsigned line;
    vectors.core = boot_vectors;
    for (line = 0; line < VC_LINES; line++)
        vectors.lines[line] = vc_output_rest;
    vectors.lines[vc_output_line] = vc_output_interrupt;
    vectors.lines[VC_UART0_LINE] = UART0_IRQ_Handler;
    VC_VECTOR_TABLE = (uint32_t)(uintptr_t)&vectors;
    vc_clocks_start();
    vc_watchdog_start();
    settings.actuator = vc_output_actuator;
    settings.serial_number = serial_number();
    vc_output_start();
    vc_uart_start();
    if (vc_loop_start(&settings, &vc_board_flash, &vc_paced_dac) != VC_OK)
        return 1; /* settings that cannot be, or a key without a verifier: the board does nothing */
    for (;;) {
        vc_watchdog_feed();
        if (!vc_loop_turn())
            vc_wait_for_interrupt();
    }
}

/* The timer counts microseconds of the crystal, which also clocks the samples. */
uint64_t vc_port_now_us(void)
{
    uint32_t high, low;
    do {
        high = VC_TIMER_RAW_HIGH;
        low = VC_TIMER_RAW_LOW;
    } while (high != VC_TIMER_RAW_HIGH);
    return (uint64_t)high << 32 | low;
}
