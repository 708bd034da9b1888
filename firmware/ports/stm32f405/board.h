/* Adafruit Feather STM32F405 Express: STM32F405RG with a 12 MHz crystal; the parts of its port.
 *
 * Pins: TX and RX (PB10, PB11) are the serial port, 921 600 baud, 8 data bits, no parity, 1 stop bit. A0 and A1 (PA4,
 * PA5) are the DAC's channels 1 and 2: 0 V to 3.3 V, at rest in the middle.
 */
#ifndef VIBROCAST_STM32F405_BOARD_H
#define VIBROCAST_STM32F405_BOARD_H

#include "vibrocast/controller.h"
#include "registers.h"

#define VC_PROCESSOR_HZ 168000000u
#define VC_APB1_HZ (VC_PROCESSOR_HZ / 4)
#define VC_APB1_TIMERS_HZ (VC_PROCESSOR_HZ / 2) /* 7.2: twice APB1's clock where that is divided */

/* Runs the processor at VC_PROCESSOR_HZ, from the crystal or, if that does not start, from the internal oscillator. */
void vc_clocks_start(void);

/* Starts the watchdog. It resets the board about 4 s after the last feed: at least 2.7 s, because its oscillator varies
 * from 17 to 47 kHz. A turn of the loop takes far less, but for the erasure of flash. */
void vc_watchdog_start(void);
static inline void vc_watchdog_feed(void)
{
    VC_IWDG_KR = VC_IWDG_FEED;
}

/* Turns both outputs on at rest, where a divider at each holds it until then. They play the codes that vc_paced_dac
 * takes. `dac_bits`: of the codes. */
void vc_dac_output_start(uint32_t dac_rate_hz, unsigned dac_bits);
void TIM6_DAC_IRQHandler(void);

/* For a fault: brings both outputs to rest, without interrupts. Does not return; the watchdog resets the board. */
void vc_dac_output_rest(void);

void vc_uart_start(void);
void USART3_IRQHandler(void);

/* Sectors 1 and 2 hold records, 8 to 11 model images: board.ld keeps code out of them. */
extern const vc_flash vc_board_flash;

#endif
