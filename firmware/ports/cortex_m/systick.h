/* A clock in microseconds by the processor's own timer, whose interrupt also ends every wait within a millisecond. */
#ifndef VIBROCAST_SYSTICK_H
#define VIBROCAST_SYSTICK_H

#include <stdint.h>

/* Starts the clock at 0. `processor_mhz`: at most 16777 */
void vc_systick_start(uint32_t processor_mhz);
uint64_t vc_systick_now_us(void);
void SysTick_Handler(void);

#endif
