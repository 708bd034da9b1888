/* The sample clock: PWM slice 0, which drives no pin, wraps once a sample. RP2040 datasheet: 4.5.2. */
#include "board.h"

void vc_sample_clock_start(uint32_t rate_hz, uint32_t others)
{
    /* A slice counts to 65 535, so it reaches down to 1832 Hz without the divider, whose unit is 1/16. */
    const uint32_t divider = VC_PROCESSOR_HZ / rate_hz / 65536 + 1;
    VC_PWM_DIV(0) = divider << 4;
    VC_PWM_TOP(0) = VC_PROCESSOR_HZ / divider / rate_hz - 1;
    VC_PWM_CTR(0) = 0;
    VC_PWM_INTR = 1;
    VC_PWM_INTE = 1;
    VC_PWM_EN = 1 | others; /* all at once */
    vc_board_enable_interrupt(VC_PWM_LINE, 0);
}
