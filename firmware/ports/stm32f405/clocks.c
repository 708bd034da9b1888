/* The processor's clock, and the watchdog. RM0090: 7.2 and 7.3 (clocks), 3.5 (flash latency), 21.3 (watchdog). */
#include "board.h"

/* Some ms at any clock: the crystal takes 2 ms (datasheet DS8626, table 42), the PLL 0.3 ms. */
#define LONGEST_WAIT 200000u

static int becomes(volatile uint32_t *control, uint32_t mask, uint32_t value)
{
    uint32_t turns;
    for (turns = 0; turns < LONGEST_WAIT; turns++)
        if ((*control & mask) == value)
            return 1;
    return 0;
}

void vc_clocks_start(void)
{
    /* PLL: input 2 MHz, times 168, divided by 2; 336 MHz / 7 for peripherals that want 48 MHz. 7.3.2 */
    uint32_t source = 8; /* the internal oscillator, 16 MHz, divided by 8 */
    VC_RCC_CR |= VC_RCC_HSEON;
    if (becomes(&VC_RCC_CR, VC_RCC_HSERDY, VC_RCC_HSERDY))
        source = VC_RCC_PLLSRC_HSE | 6; /* the crystal, 12 MHz, divided by 6 */
    VC_RCC_PLLCFGR = source | 168u << 6 | 7u << 24;
    VC_RCC_CR |= VC_RCC_PLLON;
    (void)becomes(&VC_RCC_CR, VC_RCC_PLLRDY, VC_RCC_PLLRDY);
    VC_FLASH_ACR = VC_FLASH_LATENCY_5 | VC_FLASH_PREFETCH | VC_FLASH_INSTRUCTION_CACHE | VC_FLASH_DATA_CACHE;
    VC_RCC_CFGR = VC_RCC_PPRE1_4 | VC_RCC_PPRE2_2;
    /* The switch happens when the PLL is ready (7.3.3). Without it, everything would run at a tenth of its speed, and
     * no host could understand the board: then nothing plays. */
    VC_RCC_CFGR |= VC_RCC_SW_PLL;
    (void)becomes(&VC_RCC_CFGR, VC_RCC_SWS, VC_RCC_SWS_PLL);
}

void vc_watchdog_start(void)
{
    VC_IWDG_KR = VC_IWDG_START;
    VC_IWDG_KR = VC_IWDG_UNLOCK;
    VC_IWDG_PR = 3; /* 32 kHz / 32 */
    VC_IWDG_RLR = 4000;
    vc_watchdog_feed();
}
