/* The serial port by interrupts. RP2040 datasheet: 4.2. */
#include "board.h"
#include "vibrocast/port.h"
#include "vibrocast/ring.h"

#define BAUD 921600u
#define TX_PIN 0u
#define RX_PIN 1u

/* Bytes received while a packet is decoded or flash is written: 178 ms of the link. */
static uint8_t received_bytes[1 << 14] VC_CORE_MEMORY, sending_bytes[1 << 10] VC_CORE_MEMORY;
static vc_ring received = {received_bytes, sizeof received_bytes, 0, 0};
static vc_ring sending = {sending_bytes, sizeof sending_bytes, 0, 0};

void vc_uart_start(void)
{
    /* 4.2.7.1: in 1/64; 120 MHz / 16 / 8.141 = 921 305 baud, 0.03 % slow */
    const uint32_t divisor = (4 * VC_PROCESSOR_HZ + BAUD / 2) / BAUD;
    vc_board_enable(VC_RESET_UART0);
    VC_UART_IBRD = divisor / 64;
    VC_UART_FBRD = divisor % 64;
    VC_UART_LCR_H = VC_UART_8_BITS | VC_UART_FIFO; /* behind the divisor, which it latches */
    VC_UART_IFLS = 2u << 3 | 0;                    /* interrupts: 4 bytes received, half of the sent ones gone */
    VC_UART_CR = VC_UART_ON;
    VC_GPIO_PAD(RX_PIN) = VC_PAD_INPUT | VC_PAD_PULL_UP | VC_PAD_SCHMITT; /* an open line is silent */
    VC_GPIO_PAD(TX_PIN) = VC_PAD_4_MA;
    VC_GPIO_CTRL(RX_PIN) = VC_GPIO_UART;
    VC_GPIO_CTRL(TX_PIN) = VC_GPIO_UART;
    VC_UART_IMSC = VC_UART_RX | VC_UART_RX_TIMEOUT | VC_UART_TX;
    vc_board_enable_interrupt(VC_UART0_LINE, 1);
}

/* Sends as much as the port takes at once. If more is left, the port is full, and its interrupt comes when it is half
 * empty again. */
static inline void send_waiting(void)
{
    uint8_t byte;
    while (!(VC_UART_FR & VC_UART_TXFF) && vc_ring_take(&sending, &byte))
        VC_UART_DR = byte;
}

void UART0_IRQ_Handler(void)
{
    VC_UART_ICR = VC_UART_RX | VC_UART_RX_TIMEOUT | VC_UART_TX;
    while (!(VC_UART_FR & VC_UART_RXFE))
        (void)vc_ring_put(&received, (uint8_t)VC_UART_DR); /* a byte without room is lost, and a CRC shows it */
    send_waiting();
}

size_t vc_port_read(uint8_t *data, size_t capacity)
{
    return vc_ring_read(&received, data, capacity);
}

size_t vc_port_write(const uint8_t *data, size_t length)
{
    const size_t taken = vc_ring_write(&sending, data, length);
    __asm volatile("cpsid i" ::: "memory");
    send_waiting();
    __asm volatile("cpsie i" ::: "memory");
    return taken;
}
