/* The quantiser offset of a rate-controlled stream's packets; see vc_quantiser_offset.h. */
#include "vc_quantiser_offset.h"

#define STEERED 1u
#define ADAPTATION_SHIFT 2 /* fast, because a live stream has few packets from one refresh to the next */

int vc_rate_control_read(const uint8_t *bytes, size_t length, size_t fields_length, int *rate_controlled)
{
    *rate_controlled = length == fields_length + 1 && bytes[fields_length] == STEERED;
    return *rate_controlled || length == fields_length;
}

void vc_quantiser_offset_reset(vc_quantiser_offset *quantiser_offset)
{
    quantiser_offset->value = 0;
    quantiser_offset->same = VC_UNTRAINED;
}

static int32_t limited(int32_t value)
{
    return value > VC_MAX_QUANTISER_OFFSET    ? VC_MAX_QUANTISER_OFFSET
           : value < -VC_MAX_QUANTISER_OFFSET ? -VC_MAX_QUANTISER_OFFSET
                                              : value;
}

void vc_quantiser_offset_encode(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset, int32_t value)
{
    const int32_t change = limited(value) - quantiser_offset->value;
    vc_adaptive_encode(coder, change == 0, &quantiser_offset->same, ADAPTATION_SHIFT);
    if (change != 0) {
        const uint32_t more = (uint32_t)(change < 0 ? -change : change) - 1;
        vc_range_encode(coder, change < 0, VC_EVEN_ODDS);
        vc_golomb_encode(coder, more / 2);
        vc_range_encode(coder, (int)(more % 2), VC_EVEN_ODDS);
    }
    quantiser_offset->value += change;
}

uint32_t vc_quantiser_offset_encode_fours(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset, int32_t value,
                                          uint32_t lambda)
{
    /* 2^(3/16) for each, in 1/256, from -1 on: within it the search for levels loses almost nothing. */
    static const uint32_t weights[4] = {225, 256, 292, 332};
    const int32_t most = 4 * VC_MAX_QUANTISER_OFFSET;
    const uint32_t above_least = (uint32_t)((value > most ? most : value < -most ? -most : value) + most + 1);
    vc_quantiser_offset_encode(coder, quantiser_offset, (int32_t)(above_least / 4) - VC_MAX_QUANTISER_OFFSET);
    return lambda * weights[above_least % 4] / 256;
}

void vc_quantiser_offset_decode(vc_range_coder *coder, vc_quantiser_offset *quantiser_offset)
{
    if (!vc_adaptive_decode(coder, &quantiser_offset->same, ADAPTATION_SHIFT)) {
        const int finer = (int)vc_range_decode_bits(coder, 1);
        int32_t change = 2 * (int32_t)vc_golomb_decode(coder) + 1;
        change += (int32_t)vc_range_decode_bits(coder, 1);
        quantiser_offset->value = limited(quantiser_offset->value + (finer ? -change : change));
    }
}
