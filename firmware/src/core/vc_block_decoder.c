/* Decoder of blocks: bits to levels; see vc_block_coder.h. */
#include "vc_block_coder.h"
#include "vc_mdct_mixing.h"

void vc_block_reset(vc_block_state *state)
{
    vc_history_reset(&state->history);
    state->state = 0;
}

static int decode_decision(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned decision,
                           unsigned quantiser)
{
    vc_prediction prediction;
    int bit;
    vc_begin_cells(model, contexts, decision, quantiser);
    bit = vc_range_decode(coder, vc_predict(model, contexts, decision, quantiser, &prediction));
    vc_update(&prediction, bit);
    return bit;
}

static uint32_t decode_index(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned quantiser)
{
    uint32_t index = 0;
    while (index < VC_UNARY_LIMIT && decode_decision(coder, model, contexts, index, quantiser))
        index++;
    return index < VC_UNARY_LIMIT ? index : index + vc_golomb_decode(coder);
}

void vc_block_decode(vc_range_coder *coder, vc_model *model, vc_block_state *state, uint32_t bins, int32_t *levels,
                     int8_t *offsets)
{
    vc_history *history = &state->history;
    vc_below below = {0, 0};
    vc_contexts contexts;
    vc_bin bin;
    uint32_t k, means_below = 0;
    int silent = vc_range_decode(coder, vc_silence_predict(model, history));
    vc_silence_update(model, history, silent);
    history->silent_history = (uint8_t)((history->silent_history << 1 | silent) & 3);
    if (silent) {
        memset(levels, 0, bins * sizeof *levels);
        state->state = 0;
    }
    for (k = 0; k < bins && !silent; k++) {
        unsigned quantiser = vc_quantiser_of(state->state);
        uint32_t index, level;
        vc_bin_find(&bin, history, bins, k, &means_below);
        vc_contexts_find(&contexts, &bin, k, &below);
        index = decode_index(coder, model, &contexts, quantiser);
        level = vc_level_of(index, quantiser);
        levels[k] = index != 0 && vc_range_decode_bits(coder, 1) ? -(int32_t)level : (int32_t)level;
        offsets[k] = vc_level_offset(model, quantiser, contexts.centroid_class, level);
        state->state = vc_next_state(state->state, index);
        vc_below_add(&below, vc_history_set(history, k, level));
    }
    vc_history_next_block(history, bins);
}
