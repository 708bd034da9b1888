/* The serial port by interrupts. RM0090: 30.3 (USART), 8.3 (pins). */
#include "board.h"
#include "vibrocast/port.h"
#include "vibrocast/ring.h"

#define BAUD 921600u

/* Bytes received while a packet is decoded or flash is written: 178 ms of the link. */
static uint8_t received_bytes[1 << 14] VC_CORE_MEMORY, sending_bytes[1 << 10] VC_CORE_MEMORY;
static vc_ring received = {received_bytes, sizeof received_bytes, 0, 0};
static vc_ring sending = {sending_bytes, sizeof sending_bytes, 0, 0};

void vc_uart_start(void)
{
    VC_RCC_AHB1ENR |= VC_RCC_GPIOB;
    VC_RCC_APB1ENR |= VC_RCC_USART3;
    (void)VC_RCC_APB1ENR; /* the clock needs two cycles: errata ES0182, 2.1.13 */
    /* PB10 and PB11: alternate function 7 (DS8626, table 9), pulled up, so that an open line is silent. */
    VC_GPIO_AFRH(VC_GPIOB) = (VC_GPIO_AFRH(VC_GPIOB) & ~0xFF00u) | 0x7700u;
    VC_GPIO_PUPDR(VC_GPIOB) = (VC_GPIO_PUPDR(VC_GPIOB) & ~(0xFu << 20)) | 0x5u << 20;
    VC_GPIO_MODER(VC_GPIOB) = (VC_GPIO_MODER(VC_GPIOB) & ~(0xFu << 20)) | 0xAu << 20;
    /* 30.3.4: 42 MHz / 46 = 913 kbaud, 0.9 % slow; 3.3 % are allowed (30.3.5). */
    VC_USART_BRR = (VC_APB1_HZ + BAUD / 2) / BAUD;
    VC_USART_CR1 = VC_USART_UE | VC_USART_TE | VC_USART_RE | VC_USART_RXNEIE;
    vc_enable_interrupt(VC_USART3_LINE, 1);
}

/* Sends as much as the port takes at once, and leaves the rest to the interrupt. */
VC_INSIDE_RAM void send_waiting(void)
{
    uint8_t byte;
    while (VC_USART_SR & VC_USART_TXE) {
        if (!vc_ring_take(&sending, &byte)) {
            VC_USART_CR1 &= ~(uint32_t)VC_USART_TXEIE;
            return;
        }
        VC_USART_DR = byte;
    }
    VC_USART_CR1 |= VC_USART_TXEIE;
}

VC_IN_RAM void USART3_IRQHandler(void)
{
    /* An overrun keeps the interrupt up until the data register is read after the status (30.6.1). */
    if (VC_USART_SR & (VC_USART_RXNE | VC_USART_ORE))
        (void)vc_ring_put(&received, (uint8_t)VC_USART_DR); /* a byte without room is lost, and a CRC shows it */
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
