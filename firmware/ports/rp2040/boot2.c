/* The second stage of the boot: sets up fast reads of flash. RP2040 datasheet: 2.8.1.3.1 (boot), 4.10 (flash).
 *
 * The boot ROM copies the first 256 bytes of flash to RAM and runs them, if the last four are the CRC of the others.
 * firmware/rp2040.py writes this CRC. The code runs at any address and has no data.
 */
#include "board.h"
#include "boot2.h"

/* "Fast read dual output", 3Bh: command, 24 bits of address and 8 clocks of waiting on one wire, then data on two. All
 * usual flash chips know it, and none needs a mode to be set for it. At 60 MHz: the W25Q16JV takes 133 MHz. */
__attribute__((always_inline)) static inline void set_up_reads(void)
{
    VC_PAD_QSPI_SCLK = 2 << 4 | 1; /* 8 mA, fast edges */
    VC_SSI_ENR = 0;
    VC_SSI_BAUDR = 2;           /* of the processor's clock */
    VC_SSI_RX_SAMPLE_DLY = 1;   /* the answer of the chip takes longer than half a clock */
    VC_SSI_CTRLR0 = 1u << 21 |  /* SPI_FRF: data on two wires */
                    31u << 16 | /* DFS_32: words of 32 bits */
                    3u << 8;    /* TMOD: send command and address, then receive */
    VC_SSI_CTRLR1 = 0;          /* one word each */
    VC_SSI_SPI_CTRLR0 = 0x3Bu << 24 | 8u << 11 /* clocks of waiting */ | 2u << 8 /* command of 8 bits */ |
                        6u << 2 /* address of 24 bits */;
    VC_SSI_ENR = 1;
}

/* As the ROM enters it: sets up reads, then starts the program by its vector table. */
__attribute__((section(".boot2"), used, noreturn)) void vc_boot2(void)
{
    const volatile uint32_t *vectors = (const volatile uint32_t *)VC_FLASH_VECTORS; /* read behind the set-up */
    set_up_reads();
    VC_VECTOR_TABLE = VC_FLASH_VECTORS;
    __asm volatile("msr msp, %0\nbx %1" ::"r"(vectors[0]), "r"(vectors[1]));
    __builtin_unreachable();
}

void vc_flash_reads_start(void)
{
    set_up_reads();
}
