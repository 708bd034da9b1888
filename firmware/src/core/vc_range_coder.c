/* Binary range coder; see vc_range_coder.h. Carry-less, as in Mahoney's lpaq. */
#include "vc_range_coder.h"

static uint32_t split_point(const vc_range_coder *coder, uint32_t probability)
{
    const uint32_t range = coder->high - coder->low;
    return coder->low + (range >> 16) * probability + ((range & 0xFFFFu) * probability >> 16);
}

static void narrow(vc_range_coder *coder, int bit, uint32_t split)
{
    if (bit)
        coder->high = split;
    else
        coder->low = split + 1;
}

static int top_byte_settled(const vc_range_coder *coder)
{
    return ((coder->low ^ coder->high) >> 24) == 0;
}

static void drop_top_byte(vc_range_coder *coder)
{
    coder->low <<= 8;
    coder->high = (coder->high << 8) | 0xFFu;
}

static void put_byte(vc_range_coder *coder, uint8_t byte)
{
    if (coder->output == coder->output_end)
        coder->overflow = 1;
    else
        *coder->output++ = byte;
}

static uint8_t next_byte(vc_range_coder *coder)
{
    return coder->input == coder->input_end ? 0 : *coder->input++;
}

/* Replaces the top bytes that both bounds share by new ones. */
static inline void read_settled(vc_range_coder *coder)
{
    while (top_byte_settled(coder)) {
        drop_top_byte(coder);
        coder->value = (coder->value << 8) | next_byte(coder);
    }
}

void vc_range_encoder_init(vc_range_coder *coder, uint8_t *output, size_t capacity)
{
    coder->low = 0;
    coder->high = 0xFFFFFFFFu;
    coder->output = output;
    coder->output_end = output + capacity;
    coder->overflow = 0;
}

void vc_range_decoder_init(vc_range_coder *coder, const uint8_t *input, size_t length)
{
    int index;
    coder->low = 0;
    coder->high = 0xFFFFFFFFu;
    coder->value = 0;
    coder->input = input;
    coder->input_end = input + length;
    for (index = 0; index < 4; index++)
        coder->value = (coder->value << 8) | next_byte(coder);
}

void vc_range_encode(vc_range_coder *coder, int bit, uint32_t probability)
{
    narrow(coder, bit, split_point(coder, probability));
    while (top_byte_settled(coder)) {
        put_byte(coder, (uint8_t)(coder->low >> 24));
        drop_top_byte(coder);
    }
}

int vc_range_decode(vc_range_coder *coder, uint32_t probability)
{
    uint32_t split = split_point(coder, probability);
    int bit = coder->value <= split;
    narrow(coder, bit, split);
    read_settled(coder);
    return bit;
}

uint32_t vc_range_decode_bits(vc_range_coder *coder, unsigned count)
{
    vc_range_coder local = *coder; /* in registers */
    uint32_t bits = 0;
    for (; count > 0; count--) {
        const uint32_t split = local.low + (local.high - local.low) / 2;
        const int bit = local.value <= split;
        bits = bits << 1 | (uint32_t)bit;
        narrow(&local, bit, split);
        read_settled(&local);
    }
    *coder = local;
    return bits;
}

size_t vc_range_encoder_finish(vc_range_coder *coder, const uint8_t *start)
{
    uint8_t *end;
    /* low and high differ in their top byte. Unless low is 0, the shortest number between them starts with the byte
     * above low's. */
    if (coder->low != 0)
        put_byte(coder, (uint8_t)((coder->low >> 24) + 1));
    end = coder->output;
    while (end != start && end[-1] == 0)
        end--;
    return (size_t)(end - start);
}
