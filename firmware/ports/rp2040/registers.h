/* Registers of the RP2040 that this port uses; section numbers of its datasheet. */
#ifndef VIBROCAST_RP2040_REGISTERS_H
#define VIBROCAST_RP2040_REGISTERS_H

#include "cortex_m.h"

/* Resets of subsystems, 2.14.3 */
#define VC_RESETS_RESET VC_REGISTER(0x4000C000u)
#define VC_RESETS_DONE VC_REGISTER(0x4000C008u)
enum {
    VC_RESET_DMA = 1 << 2,
    VC_RESET_I2C0 = 1 << 3,
    VC_RESET_IO_BANK0 = 1 << 5,
    VC_RESET_PADS_BANK0 = 1 << 8,
    VC_RESET_PIO0 = 1 << 10,
    VC_RESET_PLL_SYS = 1 << 12,
    VC_RESET_PWM = 1 << 14,
    VC_RESET_TIMER = 1 << 21,
    VC_RESET_UART0 = 1 << 22
};

/* Clocks, 2.15.7 */
#define VC_CLK_REF_CTRL VC_REGISTER(0x40008030u)
#define VC_CLK_REF_SELECTED VC_REGISTER(0x40008038u)
#define VC_CLK_SYS_CTRL VC_REGISTER(0x4000803Cu)
#define VC_CLK_SYS_SELECTED VC_REGISTER(0x40008044u)
#define VC_CLK_PERI_CTRL VC_REGISTER(0x40008048u)
enum {
    VC_CLK_REF_XOSC = 2, /* source, and its number in SELECTED */
    VC_CLK_SYS_AUX = 1,  /* the auxiliary source, of which number 0 is pll_sys */
    VC_CLK_PERI_ENABLE = 1 << 11
};

/* Crystal oscillator, 2.16.7 */
#define VC_XOSC_CTRL VC_REGISTER(0x40024000u)
#define VC_XOSC_STATUS VC_REGISTER(0x40024004u)
#define VC_XOSC_STARTUP VC_REGISTER(0x4002400Cu)
enum { VC_XOSC_ENABLE = 0xFAB << 12, VC_XOSC_1_TO_15_MHZ = 0xAA0 };
#define VC_XOSC_STABLE 0x80000000u

/* PLL of the system clock, 2.18.4 */
#define VC_PLL_SYS_CS VC_REGISTER(0x40028000u)
#define VC_PLL_SYS_PWR VC_REGISTER(0x40028004u)
#define VC_PLL_SYS_FBDIV VC_REGISTER(0x40028008u)
#define VC_PLL_SYS_PRIM VC_REGISTER(0x4002800Cu)
#define VC_PLL_LOCK 0x80000000u
enum { VC_PLL_PD = 1 << 0, VC_PLL_POSTDIVPD = 1 << 3, VC_PLL_VCOPD = 1 << 5 };

/* Power-on state machine, 2.13.5: which parts the watchdog resets */
#define VC_PSM_WDSEL VC_REGISTER(0x40010008u)

/* Pins: 2.19.6.1 (function), 2.19.6.3 (pad) */
#define VC_GPIO_CTRL(pin) VC_REGISTER(0x40014004u + 8 * (pin))
#define VC_GPIO_PAD(pin) VC_REGISTER(0x4001C004u + 4 * (pin))
enum {
    VC_GPIO_UART = 2,
    VC_GPIO_I2C = 3,
    VC_GPIO_PWM = 4,
    VC_GPIO_PIO0 = 6,
    VC_PAD_SCHMITT = 1 << 1,
    VC_PAD_PULL_UP = 1 << 3,
    VC_PAD_4_MA = 1 << 4,
    VC_PAD_INPUT = 1 << 6
};

/* UART0, 4.2.8 */
#define VC_UART0 0x40034000u
#define VC_UART_DR VC_REGISTER(VC_UART0 + 0x00)
#define VC_UART_FR VC_REGISTER(VC_UART0 + 0x18)
#define VC_UART_IBRD VC_REGISTER(VC_UART0 + 0x24)
#define VC_UART_FBRD VC_REGISTER(VC_UART0 + 0x28)
#define VC_UART_LCR_H VC_REGISTER(VC_UART0 + 0x2C)
#define VC_UART_CR VC_REGISTER(VC_UART0 + 0x30)
#define VC_UART_IFLS VC_REGISTER(VC_UART0 + 0x34)
#define VC_UART_IMSC VC_REGISTER(VC_UART0 + 0x38)
#define VC_UART_ICR VC_REGISTER(VC_UART0 + 0x44)
enum {
    VC_UART_RXFE = 1 << 4, /* of FR: nothing received */
    VC_UART_TXFF = 1 << 5, /* no room to send */
    VC_UART_FIFO = 1 << 4, /* of LCR_H */
    VC_UART_8_BITS = 3 << 5,
    VC_UART_ON = 1 << 0 | 1 << 8 | 1 << 9, /* of CR: UARTEN, TXE, RXE */
    VC_UART_RX = 1 << 4,                   /* of IMSC and ICR */
    VC_UART_TX = 1 << 5,
    VC_UART_RX_TIMEOUT = 1 << 6
};

/* I2C0, 4.3.17 */
#define VC_I2C0 0x40044000u
#define VC_I2C_CON VC_REGISTER(VC_I2C0 + 0x00)
#define VC_I2C_TAR VC_REGISTER(VC_I2C0 + 0x04)
#define VC_I2C_DATA_CMD VC_REGISTER(VC_I2C0 + 0x10)
#define VC_I2C_FS_HCNT VC_REGISTER(VC_I2C0 + 0x1C)
#define VC_I2C_FS_LCNT VC_REGISTER(VC_I2C0 + 0x20)
#define VC_I2C_INTR_MASK VC_REGISTER(VC_I2C0 + 0x30)
#define VC_I2C_RAW_INTR_STAT VC_REGISTER(VC_I2C0 + 0x34)
#define VC_I2C_CLR_TX_ABRT VC_REGISTER(VC_I2C0 + 0x54)
#define VC_I2C_ENABLE VC_REGISTER(VC_I2C0 + 0x6C)
#define VC_I2C_TXFLR VC_REGISTER(VC_I2C0 + 0x74) /* entries that wait to be sent */
#define VC_I2C_SDA_HOLD VC_REGISTER(VC_I2C0 + 0x7C)
#define VC_I2C_FS_SPKLEN VC_REGISTER(VC_I2C0 + 0xA0)
enum {
    VC_I2C_MASTER_FAST = 0x65, /* of CON: master, fast mode, restart, no slave; an empty FIFO does not stop */
    VC_I2C_STOP = 1 << 9,      /* of DATA_CMD */
    VC_I2C_TX_ABRT = 1 << 6    /* of RAW_INTR_STAT: an address or a byte was not acknowledged */
};

/* PWM, 4.5.3 */
#define VC_PWM 0x40050000u
#define VC_PWM_CSR(slice) VC_REGISTER(VC_PWM + 0x14 * (slice) + 0x00)
#define VC_PWM_DIV(slice) VC_REGISTER(VC_PWM + 0x14 * (slice) + 0x04)
#define VC_PWM_CTR(slice) VC_REGISTER(VC_PWM + 0x14 * (slice) + 0x08)
#define VC_PWM_CC(slice) VC_REGISTER(VC_PWM + 0x14 * (slice) + 0x0C)
#define VC_PWM_TOP(slice) VC_REGISTER(VC_PWM + 0x14 * (slice) + 0x10)
#define VC_PWM_EN VC_REGISTER(VC_PWM + 0xA0)
#define VC_PWM_INTR VC_REGISTER(VC_PWM + 0xA4)
#define VC_PWM_INTE VC_REGISTER(VC_PWM + 0xA8)

/* DMA, 2.5.7: channels 0 and 1, both at interrupt 0 */
#define VC_DMA 0x50000000u
#define VC_DMA_READ(channel) VC_REGISTER(VC_DMA + 0x40 * (channel) + 0x00)
#define VC_DMA_WRITE(channel) VC_REGISTER(VC_DMA + 0x40 * (channel) + 0x04)
#define VC_DMA_COUNT(channel) VC_REGISTER(VC_DMA + 0x40 * (channel) + 0x08)
#define VC_DMA_START(channel) VC_REGISTER(VC_DMA + 0x40 * (channel) + 0x0C) /* CTRL_TRIG */
#define VC_DMA_CONTROL(channel)                                                                                        \
    VC_REGISTER(VC_DMA + 0x40 * (channel) + 0x10) /* AL1_CTRL: the same, without a start                               \
                                                   */
#define VC_DMA_INTE0 VC_REGISTER(VC_DMA + 0x404)
#define VC_DMA_INTS0 VC_REGISTER(VC_DMA + 0x40C)
enum {
    VC_DMA_ENABLE = 1 << 0,
    VC_DMA_WORDS = 2 << 2,
    VC_DMA_READ_ON = 1 << 4, /* INCR_READ */
    VC_DMA_RING_SIZE = 6,    /* the place of the bits of read addresses that change */
    VC_DMA_CHAIN_TO = 11,    /* the place of the channel that starts at the end */
    VC_DMA_PIO0_QUEUE = 0    /* TREQ_SEL: room in the queue of state machine 0 */
};

/* State machine 0 of PIO0, 3.7 */
#define VC_PIO0 0x50200000u
#define VC_PIO_CTRL VC_REGISTER(VC_PIO0 + 0x00)
#define VC_PIO_QUEUE (VC_PIO0 + 0x10u) /* address of TXF0 */
#define VC_PIO_MEMORY(place) VC_REGISTER(VC_PIO0 + 0x48 + 4 * (place))
#define VC_PIO_CLKDIV VC_REGISTER(VC_PIO0 + 0xC8)
#define VC_PIO_EXECCTRL VC_REGISTER(VC_PIO0 + 0xCC)
#define VC_PIO_SHIFTCTRL VC_REGISTER(VC_PIO0 + 0xD0)
#define VC_PIO_INSTRUCTION VC_REGISTER(VC_PIO0 + 0xD8) /* runs at once */
#define VC_PIO_PINCTRL VC_REGISTER(VC_PIO0 + 0xDC)
enum {
    VC_PIO_WRAP_TOP = 12, /* of EXECCTRL: the place of the last instruction's number */
    VC_PIO_AUTOPULL = 1 << 17,
    VC_PIO_OUT_BASE = 0, /* of PINCTRL: places of pins and their counts */
    VC_PIO_SET_BASE = 5,
    VC_PIO_SIDE_BASE = 10,
    VC_PIO_OUT_COUNT = 20,
    VC_PIO_SET_COUNT = 26,
    VC_PIO_SIDE_COUNT = 29
};

/* Timer, 4.6.5 */
#define VC_TIMER_RAW_HIGH VC_REGISTER(0x40054024u)
#define VC_TIMER_RAW_LOW VC_REGISTER(0x40054028u)

/* Watchdog, 4.7.6 */
#define VC_WATCHDOG_CTRL VC_REGISTER(0x40058000u)
#define VC_WATCHDOG_LOAD VC_REGISTER(0x40058004u)
#define VC_WATCHDOG_TICK VC_REGISTER(0x4005802Cu)
enum { VC_WATCHDOG_ENABLE = 1 << 30, VC_WATCHDOG_TICK_ENABLE = 1 << 9 };

/* Interface to the flash, 4.10.13; pads of its pins, 2.19.6.4 */
#define VC_SSI 0x18000000u
#define VC_SSI_CTRLR0 VC_REGISTER(VC_SSI + 0x00)
#define VC_SSI_CTRLR1 VC_REGISTER(VC_SSI + 0x04)
#define VC_SSI_ENR VC_REGISTER(VC_SSI + 0x08)
#define VC_SSI_BAUDR VC_REGISTER(VC_SSI + 0x14)
#define VC_SSI_SR VC_REGISTER(VC_SSI + 0x28)
#define VC_SSI_DR0 VC_REGISTER(VC_SSI + 0x60)
#define VC_SSI_RX_SAMPLE_DLY VC_REGISTER(VC_SSI + 0xF0)
#define VC_SSI_SPI_CTRLR0 VC_REGISTER(VC_SSI + 0xF4)
#define VC_PAD_QSPI_SCLK VC_REGISTER(0x40020004u)
#define VC_QSPI_SS_CTRL VC_REGISTER(0x4001800Cu) /* chip select: 2.19.6.2 */
enum {
    VC_SSI_RECEIVED = 1 << 3, /* of SR: RFNE */
    VC_QSPI_SS_LOW = 2 << 8,  /* OUTOVER */
    VC_QSPI_SS_HIGH = 3 << 8
};

/* Lines of the interrupt controller, 2.3.2 */
enum { VC_PWM_LINE = 4, VC_DMA_LINE = 11, VC_UART0_LINE = 20, VC_LINES = 26 };

#endif
