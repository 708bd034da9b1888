/* A controller on an MPS2 board. */
#include "vibrocast/actuator_tables.h"
#include "board.h"
#include "vibrocast/port.h"
#include "vibrocast/sizes.h"

static int64_t profile[VC_PROFILE_WORDS];

static void play(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    (void)context;
    (void)due_us;
    VC_OUTPUT_CODES = (uint32_t)(uintptr_t)codes;
    VC_OUTPUT_CHANNELS = channels;
    VC_OUTPUT_SAMPLES = samples;
}

int main(void)
{
    static const vc_controller_settings settings = {
        .build = VC_BUILD,
        .hardware = VC_HARDWARE,
        .serial_number = "emulated",
        .actuator = &VC_ACTUATOR(vc_piezo_stack),
        .public_key = (const uint8_t *)VC_PUBLIC_KEY,
        .verify_signature = vc_port_verify_signature,
        .watchdog_ms = 2000,
        .profile = VC_PROFILE_SAMPLES > 0 ? (vc_profile *)profile : NULL,
    };
    static const vc_dac_port dac = {.play = play};
    vc_board_start();
    if (vc_loop_start(&settings, &vc_board_flash, &dac) != VC_OK)
        return 1; /* settings that cannot be, or a key without a verifier: the board does nothing */
    for (;;)
        if (!vc_loop_turn())
            vc_board_wait();
}
