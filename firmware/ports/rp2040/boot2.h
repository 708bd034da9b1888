/* Fast reads of flash, set up at the boot and after each change of flash. */
#ifndef VIBROCAST_RP2040_BOOT2_H
#define VIBROCAST_RP2040_BOOT2_H

#define VC_FLASH_BASE 0x10000000u
#define VC_FLASH_VECTORS 0x10000100u /* the vector table: board.ld */

void vc_flash_reads_start(void);

#endif
