/* UART and clock by interrupts; the processor sleeps between them. */
#include "board.h"
#include "vibrocast/port.h"
#include "vibrocast/ring.h"
#include "systick.h"

static uint8_t received_bytes[1 << 14], sending_bytes[1 << 10];
static vc_ring received = {received_bytes, sizeof received_bytes, 0, 0};
static vc_ring sending = {sending_bytes, sizeof sending_bytes, 0, 0};

void vc_board_start(void)
{
    vc_systick_start(VC_CLOCK_MHZ);
    VC_UART_DIVIDER = 16; /* the fastest */
    VC_UART_CONTROL = VC_UART_SENDS | VC_UART_RECEIVES | VC_UART_SEND_INTERRUPT | VC_UART_RECEIVE_INTERRUPT;
    vc_enable_interrupt(VC_UART_RECEIVE_LINE, 1);
    vc_enable_interrupt(VC_UART_SEND_LINE, 1);
}

/* SysTick ends the wait after a millisecond at most, even if a byte came after the loop's last look. */
void vc_board_wait(void)
{
    vc_wait_for_interrupt();
}

uint64_t vc_port_now_us(void)
{
    return vc_systick_now_us();
}

size_t vc_port_read(uint8_t *data, size_t capacity)
{
    return vc_ring_read(&received, data, capacity);
}

/* Sends the next byte, if the UART has room; called by the interrupt, and with interrupts off. */
static void send_next(void)
{
    uint8_t byte;
    if (!(VC_UART_STATE & VC_UART_SEND_FULL) && vc_ring_take(&sending, &byte))
        VC_UART_DATA = byte;
}

size_t vc_port_write(const uint8_t *data, size_t length)
{
    const size_t taken = vc_ring_write(&sending, data, length);
    /* The interrupt comes when a byte has left: the first one is sent from here. */
    __asm volatile("cpsid i" ::: "memory");
    send_next();
    __asm volatile("cpsie i" ::: "memory");
    return taken;
}

static void take_received(void)
{
    VC_UART_INTERRUPTS = VC_UART_RECEIVE_PENDING;
    while (VC_UART_STATE & VC_UART_RECEIVE_FULL)
        (void)vc_ring_put(&received, (uint8_t)VC_UART_DATA); /* a byte without room is lost, and a CRC shows it */
}

static void go_on_sending(void)
{
    VC_UART_INTERRUPTS = VC_UART_SEND_PENDING;
    send_next();
}

/* After a fault the board stands still until it is reset. */
static void halt(void)
{
    for (;;) {
    }
}

static const struct {
    vc_core_vectors core;
    vc_handler lines[VC_UART_LINES];
} vectors __attribute__((section(".vectors"), used)) = {
    .core = VC_CORE_VECTORS(halt, SysTick_Handler),
    .lines = {[VC_UART_RECEIVE_LINE] = take_received, [VC_UART_SEND_LINE] = go_on_sending},
};
