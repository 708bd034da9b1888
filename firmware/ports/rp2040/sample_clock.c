/* The sample clock: PWM slice 0, which drives no pin, wraps once a sample. RP2040 datasheet: 4.5.2. */
#include "board.h"

void vc_sample_clock_start(uint32_t rate_hz, uint32_t others)
{
    /* A slice counts to 65 535; every rate from 1832 Hz on is in reach. */
    VC_PWM_TOP(0) = VC_PROCESSOR_HZ / rate_hz - 1;
    VC_PWM_CTR(0) = 0;
    VC_PWM_INTR = 1;
    VC_PWM_INTE = 1;
    VC_PWM_EN = 1 | others; /* all at once */
    vc_board_enable_interrupt(VC_PWM_LINE, 0);
}
