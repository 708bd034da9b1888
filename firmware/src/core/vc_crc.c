/* The checksums of frames, records and model images, half a byte at a time: 32 and 64 bytes of tables; see vc_crc.h. */
#include "vc_crc.h"

/* Entry i: the remainder of i * x^16 by x^16 + x^12 + x^5 + 1. */
static const uint16_t crc16_of[16] = {0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5, 0x60C6, 0x70E7,
                                      0x8108, 0x9129, 0xA14A, 0xB16B, 0xC18C, 0xD1AD, 0xE1CE, 0xF1EF};

/* Entry i: four steps of the reflected polynomial 0xEDB88320 from state i. */
static const uint32_t crc32_of[16] = {0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4,
                                      0x4DB26158, 0x5005713C, 0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C,
                                      0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C};

uint16_t vc_crc16(const uint8_t *data, size_t length, uint16_t start)
{
    uint32_t crc = start;
    size_t i;
    for (i = 0; i < length; i++) {
        crc = (crc << 4 & 0xFFFFu) ^ crc16_of[crc >> 12 ^ data[i] >> 4];
        crc = (crc << 4 & 0xFFFFu) ^ crc16_of[crc >> 12 ^ (data[i] & 0x0Fu)];
    }
    return (uint16_t)crc;
}

uint32_t vc_crc32(const uint8_t *data, size_t length, uint32_t start)
{
    uint32_t crc = ~start;
    size_t i;
    for (i = 0; i < length; i++) {
        crc ^= data[i];
        crc = crc >> 4 ^ crc32_of[crc & 0x0Fu];
        crc = crc >> 4 ^ crc32_of[crc & 0x0Fu];
    }
    return ~crc;
}
