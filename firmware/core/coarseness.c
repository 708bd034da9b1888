/* The coarseness of a steered stream's packets; see coarseness.h. */
#include "coarseness.h"

#define STEERED 1u
#define ADAPTATION_SHIFT 2 /* fast: a live stream has few packets from one refresh to the next */
#define LOW_BITS 2         /* of a change, less 1, that have even odds */

int vc_steering_read(const uint8_t *bytes, size_t length, size_t fields_length, int *steered)
{
    *steered = length == fields_length + 1 && bytes[fields_length] == STEERED;
    return *steered || length == fields_length;
}

void vc_coarseness_reset(vc_coarseness *coarseness)
{
    coarseness->value = 0;
    coarseness->same = VC_UNTRAINED;
}

/* A change's magnitude, less 1: an exponential-Golomb code of order LOW_BITS. */
static void encode_magnitude(vc_range_coder *coder, uint32_t value)
{
    unsigned bit;
    vc_golomb_encode(coder, value >> LOW_BITS);
    for (bit = LOW_BITS; bit-- > 0;)
        vc_range_encode(coder, (int)(value >> bit & 1u), VC_EVEN_ODDS);
}

static uint32_t decode_magnitude(vc_range_coder *coder)
{
    uint32_t value = vc_golomb_decode(coder);
    unsigned bit;
    for (bit = LOW_BITS; bit-- > 0;)
        value = value << 1 | (uint32_t)vc_range_decode(coder, VC_EVEN_ODDS);
    return value;
}

static int32_t limited(int32_t value)
{
    return value > VC_MAX_COARSENESS ? VC_MAX_COARSENESS : value < -VC_MAX_COARSENESS ? -VC_MAX_COARSENESS : value;
}

void vc_coarseness_encode(vc_range_coder *coder, vc_coarseness *coarseness, int32_t value)
{
    const int32_t change = limited(value) - coarseness->value;
    vc_adaptive_encode(coder, change == 0, &coarseness->same, ADAPTATION_SHIFT);
    if (change != 0) {
        vc_range_encode(coder, change < 0, VC_EVEN_ODDS);
        encode_magnitude(coder, (uint32_t)(change < 0 ? -change : change) - 1);
    }
    coarseness->value += change;
}

void vc_coarseness_decode(vc_range_coder *coder, vc_coarseness *coarseness)
{
    if (!vc_adaptive_decode(coder, &coarseness->same, ADAPTATION_SHIFT)) {
        const int finer = vc_range_decode(coder, VC_EVEN_ODDS);
        const int32_t change = (int32_t)decode_magnitude(coder) + 1;
        coarseness->value = limited(coarseness->value + (finer ? -change : change));
    }
}
