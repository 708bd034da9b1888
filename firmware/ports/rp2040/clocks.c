/* Clocks, subsystems, interrupts and the watchdog. RP2040 datasheet: 2.14 to 2.18, 4.7; Armv6-M ARM (DDI 0419), B3.4.
 */
#include "board.h"

#define WATCHDOG_US 4000000u

static inline void wait_for(volatile uint32_t *control, uint32_t bits)
{
    while ((*control & bits) != bits) {
    }
}

void vc_board_enable(uint32_t subsystems)
{
    VC_RESETS_RESET &= ~subsystems;
    wait_for(&VC_RESETS_DONE, subsystems);
}

void vc_clocks_start(void)
{
    VC_XOSC_STARTUP = 3000; /* in 256 cycles: 64 ms, for boards whose crystal starts slowly, such as some Feathers */
    VC_XOSC_CTRL = VC_XOSC_ENABLE | VC_XOSC_1_TO_15_MHZ;
    wait_for(&VC_XOSC_STATUS, VC_XOSC_STABLE);
    VC_CLK_REF_CTRL = VC_CLK_REF_XOSC;
    wait_for(&VC_CLK_REF_SELECTED, 1 << VC_CLK_REF_XOSC);
    /* The processor leaves the PLL, in case that a debugger started the program, while it is set up. */
    VC_CLK_SYS_CTRL = 0;
    wait_for(&VC_CLK_SYS_SELECTED, 1);
    VC_RESETS_RESET |= VC_RESET_PLL_SYS;
    vc_board_enable(VC_RESET_PLL_SYS);
    VC_PLL_SYS_CS = 1;      /* 12 MHz / 1 */
    VC_PLL_SYS_FBDIV = 120; /* x 120 = 1440 MHz */
    VC_PLL_SYS_PWR &= ~(uint32_t)(VC_PLL_PD | VC_PLL_VCOPD);
    wait_for(&VC_PLL_SYS_CS, VC_PLL_LOCK);
    VC_PLL_SYS_PRIM = 6u << 16 | 2u << 12; /* / 6 / 2 = 120 MHz */
    VC_PLL_SYS_PWR &= ~(uint32_t)VC_PLL_POSTDIVPD;
    VC_CLK_SYS_CTRL = VC_CLK_SYS_AUX;
    wait_for(&VC_CLK_SYS_SELECTED, 1 << VC_CLK_SYS_AUX);
    VC_CLK_PERI_CTRL = VC_CLK_PERI_ENABLE; /* from the system clock */
    /* 4.7.2: one tick a microsecond, for watchdog and timer */
    VC_WATCHDOG_TICK = VC_CRYSTAL_HZ / 1000000 | VC_WATCHDOG_TICK_ENABLE;
    vc_board_enable(VC_RESET_TIMER | VC_RESET_IO_BANK0 | VC_RESET_PADS_BANK0);
}

void vc_watchdog_start(void)
{
    VC_PSM_WDSEL = 0x1FFFC; /* all but the oscillators */
    vc_watchdog_feed();
    VC_WATCHDOG_CTRL = VC_WATCHDOG_ENABLE;
}

void vc_watchdog_feed(void)
{
    VC_WATCHDOG_LOAD = 2 * WATCHDOG_US; /* it counts down twice a tick: erratum RP2040-E1 */
}

void vc_board_enable_interrupt(unsigned line, unsigned priority)
{
    volatile uint32_t *word = &VC_REGISTER(0xE000E400u + line / 4 * 4); /* by words only */
    const unsigned shift = line % 4 * 8 + 6;
    *word = (*word & ~(3u << shift)) | priority << shift;
    VC_REGISTER(0xE000E100u) = 1u << line;
}
