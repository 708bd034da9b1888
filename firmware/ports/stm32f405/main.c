/* A controller on an Adafruit Feather STM32F405 Express. */
#include "vibrocast/actuator_tables.h"
#include "board.h"
#include "paced_output.h"
#include "vibrocast/port.h"
#include "vibrocast/sizes.h"
#include "systick.h"

#define ACTUATOR VC_ACTUATOR(vc_piezo_stack_12_bits)
/* Of the processor's time, decoding may take 7 parts in 10; the rest is for messages and the output. */
#define DECODING_KILOCYCLES_PER_S (VC_PROCESSOR_HZ / 1000 / 10 * 7)

/* In RAM, because flash cannot be read while it is being erased; aligned as VTOR requires for 98 entries. */
static struct {
    vc_core_vectors core;
    vc_handler lines[VC_LINES];
} vectors __attribute__((aligned(512)));

static const vc_core_vectors boot_vectors __attribute__((section(".vectors"), used)) =
    VC_CORE_VECTORS(vc_dac_output_rest, SysTick_Handler);

static int64_t profile[VC_PROFILE_WORDS] VC_CORE_MEMORY;

/* Writes the chip's unique number as hexadecimal digits. */
static const char *serial_number(void)
{
    static char text[2 * VC_UNIQUE_BYTES + 1];
    unsigned digit;
    for (digit = 0; digit < 2 * VC_UNIQUE_BYTES; digit++)
        text[digit] = "0123456789abcdef"[vc_unique[digit / 2] >> (digit % 2 ? 0 : 4) & 0xF];
    return text;
}

int main(void)
{
    static vc_controller_settings settings = {.build = VC_BUILD,
                                              .hardware = VC_HARDWARE,
                                              .actuator = &ACTUATOR,
                                              .public_key = (const uint8_t *)VC_PUBLIC_KEY,
                                              .verify_signature = vc_port_verify_signature,
                                              .watchdog_ms = 2000,
                                              .profile = (vc_profile *)profile,
                                              .decoding_kilocycles_per_s = DECODING_KILOCYCLES_PER_S};
    unsigned line;
    vc_watchdog_start();
    vc_clocks_start();
    settings.serial_number = serial_number();
    vectors.core = boot_vectors;
    for (line = 0; line < VC_LINES; line++)
        vectors.lines[line] = vc_dac_output_rest;
    vectors.lines[VC_USART3_LINE] = USART3_IRQHandler;
    vectors.lines[VC_TIM6_LINE] = TIM6_DAC_IRQHandler;
    VC_VECTOR_TABLE = (uint32_t)(uintptr_t)&vectors;
    vc_systick_start(VC_PROCESSOR_HZ / 1000000);
    vc_dac_output_start(ACTUATOR.dac_rate_hz, ACTUATOR.dac_bits);
    vc_uart_start();
    if (vc_loop_start(&settings, &vc_board_flash, &vc_paced_dac) != VC_OK)
        return 1; /* settings that cannot be, or a key without a verifier: the board does nothing */
    for (;;) {
        vc_watchdog_feed();
        if (!vc_loop_turn())
            vc_wait_for_interrupt();
    }
}

uint64_t vc_port_now_us(void)
{
    return vc_systick_now_us();
}
