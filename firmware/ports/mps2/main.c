/* A controller on an MPS2 board. */
#include "actuator_tables.h"
#include "board.h"
#include "port.h"
#include "sizes.h"

static int64_t profile[VC_PROFILE_WORDS];

int main(void)
{
    static const vc_controller_settings settings = {
        .build = VC_BUILD,
        .hardware = VC_HARDWARE,
        .actuator = &vc_piezo_stack,
        .watchdog_ms = 2000,
        .profile = (vc_profile *)profile,
    };
    vc_board_start();
    vc_loop_start(&settings, &vc_board_flash);
    for (;;)
        if (!vc_loop_turn())
            vc_board_wait();
}

void vc_port_play(void *context, const int16_t *codes, uint32_t samples, unsigned channels)
{
    (void)context;
    VC_OUTPUT_CODES = (uint32_t)(uintptr_t)codes;
    VC_OUTPUT_CHANNELS = channels;
    VC_OUTPUT_SAMPLES = samples;
}
