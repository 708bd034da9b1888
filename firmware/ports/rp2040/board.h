/* A board with an RP2040, a 12 MHz crystal and 2 MB of flash, such as a Raspberry Pi Pico; the parts of its port.
 *
 * Pins: GPIO0 (TX) and GPIO1 (RX) are the serial port, 921 600 baud, 8 data bits, no parity, 1 stop bit. The output is
 * a PWM signal of 24 kHz on GPIO2 and GPIO3, a haptic driver of the DRV260x family at GPIO4 (SDA) and GPIO5 (SCL), or
 * an amplifier with I2S at GPIO6 to GPIO8.
 *
 * Program and constants lie in flash; at the start, the program is copied to RAM, where it runs. So flash can be
 * erased meanwhile, and no instruction waits for it.
 */
#ifndef VIBROCAST_RP2040_BOARD_H
#define VIBROCAST_RP2040_BOARD_H

#include "vibrocast/controller.h"
#include "registers.h"

#define VC_CRYSTAL_HZ 12000000u
/* A whole number of PWM periods, in whole cycles, is a sample at 3000 and at 8000 Hz. */
#define VC_PROCESSOR_HZ 120000000u

/* Runs processor, peripherals and timer from the crystal. Without a crystal, it waits for ever. */
void vc_clocks_start(void);

/* Takes subsystems out of reset: bits VC_RESET_.... */
void vc_board_enable(uint32_t subsystems);

/* Starts the watchdog, which resets the board 4 s after the last feed. Clocks run already. */
void vc_watchdog_start(void);
void vc_watchdog_feed(void);

/* Enables an interrupt line of the NVIC, at priority 0 (most urgent) to 3. */
void vc_board_enable_interrupt(unsigned line, unsigned priority);

/* Starts a sample clock by PWM slice 0, whose interrupt is VC_PWM_LINE. Slices in `others` start with it,
 * at the same cycle: bit 1 is slice 1. */
void vc_sample_clock_start(uint32_t rate_hz, uint32_t others);
static inline void vc_sample_clock_clear(void)
{
    VC_PWM_INTR = 1;
}

/* The output: pwm/, haptic/ or i2s/output.c. Start brings it to rest; then it plays the samples of vc_paced_dac, by the
 * interrupt of its line. */
extern const vc_actuator *const vc_output_actuator;
extern const unsigned vc_output_line;
void vc_output_start(void);
void vc_output_interrupt(void);

/* For a fault: brings the output to rest, without interrupts. Does not return; the watchdog resets the board. */
void vc_output_rest(void);

void vc_uart_start(void);
void UART0_IRQ_Handler(void);

/* Reads the unique number of the flash chip, VC_UNIQUE_BYTES. Call it before interrupts are on. */
enum { VC_UNIQUE_BYTES = 8 };
void vc_flash_read_unique(uint8_t *unique);

/* Model images: the second MiB, and 32 KiB of records before it. */
extern const vc_flash vc_board_flash;

#endif
