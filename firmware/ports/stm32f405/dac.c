/* The DAC: one sample of both channels at each interrupt of TIM6. RM0090: 14.3 (DAC), 20.3 (timer), 8.3 (pins). */
#include "board.h"
#include "paced_output.h"

#define REST 2048

VC_INSIDE_RAM void write_levels(const int32_t *level)
{
    VC_DAC_DHR12RD = (uint32_t)(level[0] + REST) | (uint32_t)(level[1] + REST) << 16;
}

void vc_dac_output_start(uint32_t dac_rate_hz, unsigned dac_bits)
{
    static const int32_t rest[VC_PACED_CHANNELS];
    /* The counter has 16 bits; without the divider it reaches down to 1282 Hz. */
    const uint32_t divider = VC_APB1_TIMERS_HZ / dac_rate_hz / 65536 + 1;
    vc_paced_start(dac_rate_hz, (int)dac_bits - 12);
    VC_RCC_AHB1ENR |= VC_RCC_GPIOA;
    VC_RCC_APB1ENR |= VC_RCC_DAC | VC_RCC_TIM6;
    (void)VC_RCC_APB1ENR;                 /* as in uart.c */
    VC_GPIO_MODER(VC_GPIOA) |= 0xFu << 8; /* PA4 and PA5: analogue */
    write_levels(rest);                   /* before the outputs are on: dividers hold rest until then */
    VC_DAC_CR = VC_DAC_EN1 | VC_DAC_EN2;
    VC_TIM6_PSC = divider - 1;
    VC_TIM6_ARR = VC_APB1_TIMERS_HZ / divider / dac_rate_hz - 1;
    VC_TIM6_DIER = 1;
    VC_TIM6_CR1 = 1;
    vc_enable_interrupt(VC_TIM6_LINE, 0);
}

VC_IN_RAM void TIM6_DAC_IRQHandler(void)
{
    VC_TIM6_SR = 0;
    write_levels(vc_paced_next());
}

void vc_dac_output_rest(void)
{
    for (;;) {
        volatile uint32_t turns;
        write_levels(vc_paced_rest());
        for (turns = 0; turns < 1000; turns++) {
        }
    }
}
