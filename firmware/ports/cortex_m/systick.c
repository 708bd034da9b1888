/* A clock in microseconds by the processor's own timer, whose interrupt also ends every wait within a millisecond. */
#include "systick.h"
#include "cortex_m.h"

static uint32_t ticks_per_us;
static volatile uint32_t milliseconds;
static uint32_t last_ms;
static uint64_t elapsed_ms, last_us;

void vc_systick_start(uint32_t processor_mhz)
{
    ticks_per_us = processor_mhz;
    VC_SYSTICK_RELOAD = 1000 * processor_mhz - 1;
    VC_SYSTICK_VALUE = 0;
    VC_SYSTICK_CONTROL = 7; /* processor clock, interrupt, on */
}

VC_IN_RAM void SysTick_Handler(void)
{
    milliseconds++;
}

uint64_t vc_systick_now_us(void)
{
    uint32_t ms, ticks;
    uint64_t now_us;
    do {
        ms = milliseconds;
        ticks = VC_SYSTICK_VALUE;
    } while (ms != milliseconds);
    elapsed_ms += ms - last_ms;
    last_ms = ms;
    now_us = elapsed_ms * 1000 + (1000 * ticks_per_us - 1 - ticks) / ticks_per_us;
    /* If the timer has restarted and its interrupt is still pending, this is a millisecond too early. */
    if (now_us > last_us)
        last_us = now_us;
    return last_us;
}
