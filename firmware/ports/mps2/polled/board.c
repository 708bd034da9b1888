/* UART and clock without interrupts: runs on processor emulators that have none. */
#include "board.h"
#include "cortex_m.h"
#include "vibrocast/port.h"

void vc_board_start(void)
{
    VC_UART_DIVIDER = 16; /* the fastest */
    VC_UART_CONTROL = VC_UART_SENDS | VC_UART_RECEIVES;
    VC_TIMER_CONTROL = VC_TIMER_ON | VC_TIMER_BY_16 | VC_TIMER_32_BITS;
}

/* There is no interrupt to wait for: the emulator goes on when time has passed. */
void vc_board_wait(void)
{
    vc_wait_for_interrupt();
}

size_t vc_port_read(uint8_t *data, size_t capacity)
{
    size_t length = 0;
    while (length < capacity && VC_UART_STATE & VC_UART_RECEIVE_FULL)
        data[length++] = (uint8_t)VC_UART_DATA;
    return length;
}

size_t vc_port_write(const uint8_t *data, size_t length)
{
    size_t taken = 0;
    while (taken < length && !(VC_UART_STATE & VC_UART_SEND_FULL))
        VC_UART_DATA = data[taken++];
    return taken;
}

/* The timer counts down and restarts after 45 minutes at least. */
uint64_t vc_port_now_us(void)
{
    static uint32_t last;
    static uint64_t ticks;
    uint32_t count = 0u - VC_TIMER_VALUE;
    ticks += (uint32_t)(count - last);
    last = count;
    return ticks * 16 / VC_CLOCK_MHZ;
}

/* After a fault the board stands still until it is reset. */
static void halt(void)
{
    for (;;) {
    }
}

static const vc_core_vectors vectors __attribute__((section(".vectors"), used)) = VC_CORE_VECTORS(halt, halt);
