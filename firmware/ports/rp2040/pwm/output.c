/* The output by PWM: both channels of slice 1. RP2040 datasheet: 4.5.2.
 *
 * The signal has 5000 steps at 24 kHz, eight periods a sample at 3000 Hz. Both slices started at the same cycle, so a
 * level that the interrupt writes takes effect when the next period begins: the clock of the samples is the hardware's.
 */
#include "vibrocast/actuator_tables.h"
#include "board.h"
#include "paced_output.h"
#include "vibrocast/port.h"

#define STEPS 5000
#define REST (STEPS / 2)
#define DAC_BITS 12 /* 4096 of the 5000 steps */
#define FIRST_PIN 2u

const vc_actuator *const vc_output_actuator = &VC_ACTUATOR(vc_piezo_stack_12_bits);
const unsigned vc_output_line = VC_PWM_LINE;

static inline void write_levels(const int32_t *level)
{
    VC_PWM_CC(1) = (uint32_t)(level[0] + REST) | (uint32_t)(level[1] + REST) << 16;
}

void vc_output_start(void)
{
    static const int32_t rest[VC_PACED_CHANNELS] = {0};
    unsigned pin;
    vc_paced_start(vc_output_actuator->dac_rate_hz, vc_output_actuator->dac_bits - DAC_BITS);
    vc_board_enable(VC_RESET_PWM);
    VC_PWM_TOP(1) = STEPS - 1;
    VC_PWM_CTR(1) = 0;
    write_levels(rest);
    vc_sample_clock_start(vc_output_actuator->dac_rate_hz, 1 << 1);
    /* Last, so that the pins pass from the divider's rest to that of the signal. */
    for (pin = FIRST_PIN; pin < FIRST_PIN + VC_PACED_CHANNELS; pin++) {
        VC_GPIO_PAD(pin) = VC_PAD_4_MA;
        VC_GPIO_CTRL(pin) = VC_GPIO_PWM;
    }
}

void vc_output_interrupt(void)
{
    vc_sample_clock_clear();
    write_levels(vc_paced_next());
}

void vc_output_rest(void)
{
    for (;;) {
        volatile uint32_t turns;
        write_levels(vc_paced_rest());
        for (turns = 0; turns < 1000; turns++) {
        }
    }
}
