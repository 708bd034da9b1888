/* The checksums of frames, records and model images. */
#ifndef VIBROCAST_CRC_H
#define VIBROCAST_CRC_H

#include <stddef.h>
#include <stdint.h>

#define VC_CRC16_START 0xFFFFu

/* cffi: begin */
/* CRC-16/IBM-3740 (also CCITT-FALSE): polynomial 0x1021, not reflected, no final XOR. `start`: the CRC of the bytes
 * before, or VC_CRC16_START. */
uint16_t vc_crc16(const uint8_t *data, size_t length, uint16_t start);

/* CRC-32 as in zlib: polynomial 0x04C11DB7, reflected, initial value and final XOR 0xFFFFFFFF. `start`: the CRC of the
 * bytes before, or 0. */
uint32_t vc_crc32(const uint8_t *data, size_t length, uint32_t start);
/* cffi: end */

#endif
