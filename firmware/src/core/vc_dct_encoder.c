/* Range coding of `dct`, the mirror of vc_dct_decoder.c. */
#include "vc_dct_model.h"

static void encode_rank(vc_range_coder *coder, vc_dct_context context, uint32_t rank)
{
    const uint32_t quotient = rank >> context.low_bits;
    uint32_t decision;
    unsigned bit;
    for (decision = 0; decision < VC_DCT_UNARY_LIMIT && decision <= quotient; decision++)
        vc_adaptive_encode(coder, quotient > decision, &context.above[decision], VC_DCT_ADAPTATION);
    if (quotient >= VC_DCT_UNARY_LIMIT)
        vc_golomb_encode(coder, quotient - VC_DCT_UNARY_LIMIT);
    for (bit = context.low_bits; bit-- > 0;)
        vc_range_encode(coder, (int)(rank >> bit & 1u), VC_EVEN_ODDS);
}

static void encode_block(vc_range_coder *coder, vc_dct_model *model, const uint32_t *values, uint32_t bins,
                         uint32_t block, uint32_t first_pair, uint32_t zeros)
{
    uint32_t bin;
    for (bin = 0; bin < bins; bin++) {
        const vc_dct_context context = vc_dct_context_find(model, bin, block);
        const int zero = values[bin] < zeros;
        const uint32_t value = values[bin] - zeros;
        uint32_t rank = context.expected;
        if (zeros)
            vc_adaptive_encode(coder, zero, context.zero, VC_DCT_ADAPTATION);
        if (!zero) {
            rank = value < first_pair ? value : (value + first_pair) / 2;
            encode_rank(coder, context, rank);
            if (rank >= first_pair)
                vc_range_encode(coder, (int)((value + first_pair) & 1u), VC_EVEN_ODDS);
        }
        vc_dct_model_set(model, bin, rank, zero);
    }
}

int32_t vc_dct_range_encode(const uint32_t *values, uint32_t rows, uint32_t blocks, uint32_t bins, int logarithmic,
                            int zeros, uint8_t *output, size_t capacity)
{
    const uint32_t first_pair = vc_dct_first_pair(logarithmic);
    vc_dct_model model;
    vc_range_coder coder;
    uint32_t row, block;
    size_t length;
    if (bins > VC_DCT_MAX_BLOCK)
        return VC_BAD_CONFIGURATION;
    vc_dct_model_reset(&model);
    vc_range_encoder_init(&coder, output, capacity);
    if (logarithmic)
        vc_range_encode(&coder, zeros != 0, VC_EVEN_ODDS);
    for (row = 0; row < rows; row++) {
        vc_dct_model_next_channel(&model);
        for (block = 0; block < blocks; block++, values += bins)
            encode_block(&coder, &model, values, bins, block, first_pair, zeros != 0);
    }
    length = vc_range_encoder_finish(&coder, output);
    return coder.overflow ? VC_PACKET_TOO_LARGE : (int32_t)length;
}
