/* Registers of the STM32F405 that this port uses; section numbers of its reference manual, RM0090. */
#ifndef VIBROCAST_STM32F405_REGISTERS_H
#define VIBROCAST_STM32F405_REGISTERS_H

#include "cortex_m.h"

/* Unique device identifier, 39.1 */
enum { VC_UNIQUE_BYTES = 12 };
extern const volatile uint8_t vc_unique[VC_UNIQUE_BYTES]; /* its place is in the linker script */

/* Reset and clock control, 7.3 */
#define VC_RCC 0x40023800u
#define VC_RCC_CR VC_REGISTER(VC_RCC + 0x00)      /* 7.3.1: clock control */
#define VC_RCC_PLLCFGR VC_REGISTER(VC_RCC + 0x04) /* 7.3.2 */
#define VC_RCC_CFGR VC_REGISTER(VC_RCC + 0x08)    /* 7.3.3 */
#define VC_RCC_AHB1ENR VC_REGISTER(VC_RCC + 0x30) /* 7.3.10 */
#define VC_RCC_APB1ENR VC_REGISTER(VC_RCC + 0x40) /* 7.3.13 */
enum {
    VC_RCC_HSEON = 1 << 16,
    VC_RCC_HSERDY = 1 << 17,
    VC_RCC_PLLON = 1 << 24,
    VC_RCC_PLLRDY = 1 << 25,
    VC_RCC_PLLSRC_HSE = 1 << 22,
    VC_RCC_SW_PLL = 2,
    VC_RCC_SWS = 3 << 2,
    VC_RCC_SWS_PLL = 2 << 2,
    VC_RCC_PPRE1_4 = 5 << 10, /* APB1: processor clock / 4 */
    VC_RCC_PPRE2_2 = 4 << 13, /* APB2: processor clock / 2 */
    VC_RCC_GPIOA = 1 << 0,    /* of AHB1ENR */
    VC_RCC_GPIOB = 1 << 1,
    VC_RCC_TIM6 = 1 << 4, /* of APB1ENR */
    VC_RCC_USART3 = 1 << 18,
    VC_RCC_DAC = 1 << 29
};

/* Embedded flash, 3.9 */
#define VC_FLASH_INTERFACE 0x40023C00u
#define VC_FLASH_ACR VC_REGISTER(VC_FLASH_INTERFACE + 0x00)  /* 3.9.1: access */
#define VC_FLASH_KEYR VC_REGISTER(VC_FLASH_INTERFACE + 0x04) /* 3.9.2 */
#define VC_FLASH_SR VC_REGISTER(VC_FLASH_INTERFACE + 0x0C)   /* 3.9.4: status */
#define VC_FLASH_CR VC_REGISTER(VC_FLASH_INTERFACE + 0x10)   /* 3.9.5: control */
enum {
    VC_FLASH_LATENCY_5 = 5, /* wait states at 168 MHz and 2.7 to 3.6 V: table 10 */
    VC_FLASH_PREFETCH = 1 << 8,
    VC_FLASH_INSTRUCTION_CACHE = 1 << 9,
    VC_FLASH_DATA_CACHE = 1 << 10,
    VC_FLASH_DATA_CACHE_RESET = 1 << 12,
    VC_FLASH_ERRORS = 0xF2, /* OPERR, WRPERR, PGAERR, PGPERR, PGSERR; written to clear them */
    VC_FLASH_BUSY = 1 << 16,
    VC_FLASH_PROGRAM = 1 << 0,
    VC_FLASH_SECTOR_ERASE = 1 << 1,
    VC_FLASH_SECTOR_SHIFT = 3,
    VC_FLASH_BY_WORDS = 2 << 8, /* parallelism of 32 bits, from 2.7 V on: table 7 */
    VC_FLASH_START = 1 << 16
};
#define VC_FLASH_LOCK 0x80000000u
#define VC_FLASH_KEY_1 0x45670123u
#define VC_FLASH_KEY_2 0xCDEF89ABu

/* General-purpose input and output, 8.4 */
#define VC_GPIOA 0x40020000u
#define VC_GPIOB 0x40020400u
#define VC_GPIO_MODER(port) VC_REGISTER((port) + 0x00) /* 8.4.1 */
#define VC_GPIO_PUPDR(port) VC_REGISTER((port) + 0x0C) /* 8.4.4 */
#define VC_GPIO_AFRH(port) VC_REGISTER((port) + 0x24)  /* 8.4.10 */

/* USART3, 30.6 */
#define VC_USART3 0x40004800u
#define VC_USART_SR VC_REGISTER(VC_USART3 + 0x00)  /* 30.6.1 */
#define VC_USART_DR VC_REGISTER(VC_USART3 + 0x04)  /* 30.6.2 */
#define VC_USART_BRR VC_REGISTER(VC_USART3 + 0x08) /* 30.6.3 */
#define VC_USART_CR1 VC_REGISTER(VC_USART3 + 0x0C) /* 30.6.4 */
enum {
    VC_USART_ORE = 1 << 3,
    VC_USART_RXNE = 1 << 5,
    VC_USART_TXE = 1 << 7,
    VC_USART_RE = 1 << 2, /* of CR1 */
    VC_USART_TE = 1 << 3,
    VC_USART_RXNEIE = 1 << 5,
    VC_USART_TXEIE = 1 << 7,
    VC_USART_UE = 1 << 13
};

/* Basic timer TIM6, 20.4 */
#define VC_TIM6 0x40001000u
#define VC_TIM6_CR1 VC_REGISTER(VC_TIM6 + 0x00)  /* 20.4.1 */
#define VC_TIM6_DIER VC_REGISTER(VC_TIM6 + 0x0C) /* 20.4.3 */
#define VC_TIM6_SR VC_REGISTER(VC_TIM6 + 0x10)   /* 20.4.4 */
#define VC_TIM6_PSC VC_REGISTER(VC_TIM6 + 0x28)  /* 20.4.7 */
#define VC_TIM6_ARR VC_REGISTER(VC_TIM6 + 0x2C)  /* 20.4.8 */

/* Digital-to-analogue converter, 14.5 */
#define VC_DAC 0x40007400u
#define VC_DAC_CR VC_REGISTER(VC_DAC + 0x00)      /* 14.5.1 */
#define VC_DAC_DHR12RD VC_REGISTER(VC_DAC + 0x20) /* 14.5.9: both channels, right-aligned */
enum { VC_DAC_EN1 = 1 << 0, VC_DAC_EN2 = 1 << 16 };

/* Independent watchdog, 21.4 */
#define VC_IWDG 0x40003000u
#define VC_IWDG_KR VC_REGISTER(VC_IWDG + 0x00)  /* 21.4.1 */
#define VC_IWDG_PR VC_REGISTER(VC_IWDG + 0x04)  /* 21.4.2 */
#define VC_IWDG_RLR VC_REGISTER(VC_IWDG + 0x08) /* 21.4.3 */
enum { VC_IWDG_UNLOCK = 0x5555, VC_IWDG_FEED = 0xAAAA, VC_IWDG_START = 0xCCCC };

/* Lines of the interrupt controller, 12.2, table 61 */
enum { VC_USART3_LINE = 39, VC_TIM6_LINE = 54, VC_LINES = 82 };

#endif
