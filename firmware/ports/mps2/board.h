/* Arm's MPS2 boards with the FPGA images AN386 (Cortex-M4), AN500 (Cortex-M7) and AN505 (Cortex-M33, secure side).
 *
 * Addresses and clocks: application notes DAI 0386, DAI 0500 and DAI 0505; registers of UART and timer: Cortex-M System
 * Design Kit Technical Reference Manual (DDI 0479), 4.3 and 4.4.
 */
#ifndef VIBROCAST_MPS2_BOARD_H
#define VIBROCAST_MPS2_BOARD_H

#ifdef VC_AN505
#define VC_PERIPHERALS 0x50000000u
#define VC_UART (VC_PERIPHERALS + 0x200000u)
#define VC_CLOCK_MHZ 20
#define VC_OUTPUT (VC_PERIPHERALS + 0x301000u)
#define VC_UART_RECEIVE_LINE 32
#define VC_UART_SEND_LINE 33
#define VC_UART_LINES 34
#else
#define VC_PERIPHERALS 0x40000000u
#define VC_UART (VC_PERIPHERALS + 0x4000u)
#define VC_CLOCK_MHZ 25
#define VC_OUTPUT (VC_PERIPHERALS + 0x24000u)
#define VC_UART_RECEIVE_LINE 0
#define VC_UART_SEND_LINE 1
#define VC_UART_LINES 2
#endif

#include "vibrocast/controller.h"
#include "cortex_m.h"

#define VC_UART_DATA VC_REGISTER(VC_UART)
#define VC_UART_STATE VC_REGISTER(VC_UART + 0x04)
#define VC_UART_CONTROL VC_REGISTER(VC_UART + 0x08)
#define VC_UART_INTERRUPTS VC_REGISTER(VC_UART + 0x0C)
#define VC_UART_DIVIDER VC_REGISTER(VC_UART + 0x10)

enum {
    VC_UART_SEND_FULL = 1, /* of the state */
    VC_UART_RECEIVE_FULL = 2,
    VC_UART_SENDS = 1, /* of the control */
    VC_UART_RECEIVES = 2,
    VC_UART_SEND_INTERRUPT = 4,
    VC_UART_RECEIVE_INTERRUPT = 8,
    VC_UART_SEND_PENDING = 1, /* of the interrupts; written to clear them */
    VC_UART_RECEIVE_PENDING = 2
};

#define VC_TIMER (VC_PERIPHERALS + 0x2000u) /* the dual timer's first */
#define VC_TIMER_VALUE VC_REGISTER(VC_TIMER + 0x04)
#define VC_TIMER_CONTROL VC_REGISTER(VC_TIMER + 0x08)

enum {
    VC_TIMER_32_BITS = 1 << 1,
    VC_TIMER_BY_16 = 1 << 2, /* the clock divided by 16 */
    VC_TIMER_ON = 1 << 7
};

/* The boards have no DAC. The port writes three words in place of the audio controller's, as to a DMA controller; an
 * emulator may watch them: the address of the codes, the channels and, last, the samples. */
#define VC_OUTPUT_CODES VC_REGISTER(VC_OUTPUT)
#define VC_OUTPUT_CHANNELS VC_REGISTER(VC_OUTPUT + 0x04)
#define VC_OUTPUT_SAMPLES VC_REGISTER(VC_OUTPUT + 0x08)

/* Starts UART and clock. */
void vc_board_start(void);

/* Waits for the next byte, or a short time. */
void vc_board_wait(void);

/* The linker script places it in memory. Model images need nothing but vc_flash. */
extern const vc_flash vc_board_flash;

#endif
