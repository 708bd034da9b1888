/* Packet heads, adaptive decisions and codes of whole numbers; see vc_common.h. */
#include "vc_common.h"

#define MAX_GOLOMB_BITS 24u
#define MIN_PROBABILITY 32u

size_t vc_packet_head_read(const uint8_t *packet, size_t length, uint32_t *sequence, int *refresh)
{
    uint64_t head = 0;
    size_t i;
    for (i = 0; i < length && i < VC_PACKET_HEAD_BYTES; i++) {
        head |= (uint64_t)(packet[i] & 0x7Fu) << (7 * i);
        if (packet[i] < 0x80u) {
            *refresh = (int)(head & 1u);
            *sequence = (uint32_t)(head >> 1);
            return i + 1;
        }
    }
    return 0;
}

size_t vc_packet_head_write(uint8_t *packet, uint32_t sequence, int refresh)
{
    uint64_t head = (uint64_t)sequence * 2 + (unsigned)(refresh != 0);
    size_t length = 0;
    for (; head >= 0x80u; head >>= 7)
        packet[length++] = (uint8_t)(head | 0x80u);
    packet[length++] = (uint8_t)head;
    return length;
}

static uint32_t limited(uint32_t probability)
{
    return probability < MIN_PROBABILITY           ? MIN_PROBABILITY
           : probability > 65536 - MIN_PROBABILITY ? 65536 - MIN_PROBABILITY
                                                   : probability;
}

static void adapt(uint16_t *probability, int bit, unsigned shift)
{
    *probability = (uint16_t)(*probability + (bit ? (65535 - *probability) >> shift : -(*probability >> shift)));
}

void vc_adaptive_encode(vc_range_coder *coder, int bit, uint16_t *probability, unsigned shift)
{
    vc_range_encode(coder, bit, limited(*probability));
    adapt(probability, bit, shift);
}

int vc_adaptive_decode(vc_range_coder *coder, uint16_t *probability, unsigned shift)
{
    int bit = vc_range_decode(coder, limited(*probability));
    adapt(probability, bit, shift);
    return bit;
}

int vc_adaptive_code(vc_range_coder *coder, int encoding, int bit, uint16_t *probability, unsigned shift)
{
    if (!encoding)
        return vc_adaptive_decode(coder, probability, shift);
    vc_adaptive_encode(coder, bit, probability, shift);
    return bit;
}

void vc_golomb_encode(vc_range_coder *coder, uint32_t value)
{
    unsigned bits = vc_floor_log2(value + 1), i;
    for (i = 0; i < bits; i++)
        vc_range_encode(coder, 1, VC_EVEN_ODDS);
    vc_range_encode(coder, 0, VC_EVEN_ODDS);
    for (i = bits; i-- > 0;)
        vc_range_encode(coder, (int)((value + 1) >> i & 1u), VC_EVEN_ODDS);
}

uint32_t vc_golomb_decode(vc_range_coder *coder)
{
    unsigned bits = 0;
    while (bits < MAX_GOLOMB_BITS && vc_range_decode_bits(coder, 1))
        bits++;
    return (1u << bits | vc_range_decode_bits(coder, bits)) - 1;
}
