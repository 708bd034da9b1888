/* Encoder of `mdct`: a search for the levels of least distortion + lambda * rate, then the decoder's steps mirrored. */
#include "mdct.h"

#define STATES 4
#define UNREACHED INT64_MAX
#define MAX_DIFFERENCE (1 << 27)

typedef struct {
    vc_history history;
    unsigned state;
} channel_state;

/* The best way into each state of dependent quantisation after one bin. */
typedef struct {
    int64_t cost; /* squared error + lambda * rate, in 1/65536 of a squared step */
    uint32_t level, level_below;
} path;

struct vc_mdct_encoder {
    vc_mdct_configuration configuration;
    const uint8_t *tables;
    uint32_t refresh_packets, lambda, sequence;
    vc_model model;
    channel_state channels[VC_MAX_CHANNELS];
    uint32_t chosen[VC_MAX_HOP][STATES]; /* index that leads into a state */
    uint8_t origin[VC_MAX_HOP][STATES];  /* and the state that it leads from */
    uint32_t indices[VC_MAX_HOP];
};

size_t vc_mdct_encoder_size(void)
{
    return sizeof(vc_mdct_encoder);
}

int vc_mdct_encoder_init(vc_mdct_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                         unsigned channels, const uint8_t *tables, size_t tables_length, uint32_t refresh_packets,
                         uint32_t lambda)
{
    int status;
    memset(encoder, 0, sizeof *encoder);
    encoder->tables = tables;
    encoder->refresh_packets = refresh_packets;
    encoder->lambda = lambda;
    status = vc_model_check_tables(tables, tables_length);
    if (status != VC_OK)
        return status;
    return vc_configuration_read(&encoder->configuration, configuration, configuration_length, channels);
}

void vc_mdct_encoder_tables(const vc_mdct_encoder *encoder, uint8_t *tables)
{
    vc_model_export(&encoder->model, tables);
}

static uint32_t magnitude_of(int32_t value)
{
    int64_t magnitude = value < 0 ? -(int64_t)value : value;
    return (uint32_t)(magnitude < VC_MAX_COEFFICIENT ? magnitude : VC_MAX_COEFFICIENT);
}

/* Estimated rate of an index in 1/256 bit: by the first context's adaptive probabilities alone, not mixed. */
static int64_t estimated_cost(const vc_model *model, unsigned quantiser, unsigned context, uint32_t index)
{
    int64_t cost = index > 0 ? 256 : 0;
    uint32_t decision;
    for (decision = 0; decision <= index && decision < VC_UNARY_LIMIT; decision++) {
        unsigned kind = decision < VC_DECISIONS ? decision : VC_DECISIONS - 1;
        unsigned probability = model->probability[kind][quantiser][0][context] >> 5;
        cost += vc_cost[index > decision ? probability : 2047 - probability];
    }
    if (index >= VC_UNARY_LIMIT)
        cost += 256 * (1 + 2 * (int64_t)vc_floor_log2(index - VC_UNARY_LIMIT + 1));
    return cost;
}

/* Squared difference of a magnitude (in 1/256 step) and what the level is reconstructed to, in 1/65536 of a squared
 * step. */
static int64_t distortion(uint32_t magnitude, uint32_t level)
{
    int64_t difference = (int64_t)magnitude - (int64_t)level * 256;
    if (difference > MAX_DIFFERENCE) /* then the sum over a block stays below 2^62 */
        difference = MAX_DIFFERENCE;
    return difference * difference;
}

/* Extends one path by bin k, trying the indices around the magnitude and zero. */
static void extend(vc_mdct_encoder *encoder, const vc_history *history, uint32_t k, uint32_t magnitude, unsigned state,
                   const path *from, path *paths)
{
    const unsigned quantiser = vc_quantiser_of(state);
    const unsigned context = vc_first_context(history, encoder->configuration.hop, k, from->level, from->level_below);
    const uint32_t nearest = (magnitude / 256 + quantiser) / 2;
    uint32_t candidates[4];
    unsigned count = 0, i;
    candidates[count++] = nearest;
    candidates[count++] = nearest + 1;
    if (nearest > 0)
        candidates[count++] = nearest - 1;
    if (nearest == 2)
        candidates[count++] = 0;
    for (i = 0; i < count; i++) {
        uint32_t index = candidates[i], level = vc_level_of(index, quantiser);
        unsigned next = vc_next_state(state, index);
        int64_t cost = from->cost + distortion(magnitude, level) +
                       encoder->lambda * estimated_cost(&encoder->model, quantiser, context, index);
        if (cost < paths[next].cost) {
            paths[next].cost = cost;
            paths[next].level = vc_kept_magnitude(level);
            paths[next].level_below = from->level;
            encoder->chosen[k][next] = index;
            encoder->origin[k][next] = (uint8_t)state;
        }
    }
}

/* Chooses the indices of one block into encoder->indices (Viterbi search); returns 1 when the block is best left
 * silent. */
static int search(vc_mdct_encoder *encoder, const channel_state *channel, const int32_t *coefficients, int32_t step)
{
    const uint32_t hop = encoder->configuration.hop;
    const uint32_t silence = vc_silence_predict(&encoder->model, &channel->history) >> 5;
    path paths[2][STATES];
    path *now = paths[0], *next = paths[1];
    int64_t silent_cost = (int64_t)encoder->lambda * vc_cost[silence];
    uint32_t k, largest = 0, any = 0;
    unsigned state, best = 0;
    for (k = 0; k < hop; k++)
        if (magnitude_of(coefficients[k]) > largest)
            largest = magnitude_of(coefficients[k]);
    if (2 * (uint64_t)largest < (uint32_t)step)
        return 1;
    for (state = 0; state < STATES; state++)
        now[state].cost = UNREACHED;
    now[channel->state].cost = (int64_t)encoder->lambda * vc_cost[2047 - silence];
    now[channel->state].level = now[channel->state].level_below = 0;
    for (k = 0; k < hop; k++) {
        uint32_t magnitude = (uint32_t)(((uint64_t)magnitude_of(coefficients[k]) << 8) / (uint32_t)step);
        path *swap = now;
        silent_cost += distortion(magnitude, 0);
        for (state = 0; state < STATES; state++)
            next[state].cost = UNREACHED;
        for (state = 0; state < STATES; state++)
            if (now[state].cost != UNREACHED)
                extend(encoder, &channel->history, k, magnitude, state, &now[state], next);
        now = next;
        next = swap;
    }
    for (state = 1; state < STATES; state++)
        if (now[state].cost < now[best].cost)
            best = state;
    if (silent_cost < now[best].cost)
        return 1;
    for (k = hop; k-- > 0; best = encoder->origin[k][best]) {
        encoder->indices[k] = encoder->chosen[k][best];
        any |= encoder->indices[k];
    }
    return any == 0;
}

static void encode_decision(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned decision,
                            unsigned quantiser, int bit)
{
    vc_prediction prediction;
    vc_range_encode(coder, bit, vc_predict(model, contexts, decision, quantiser, &prediction));
    vc_update(&prediction, bit);
}

static void encode_index(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned quantiser,
                         uint32_t index)
{
    uint32_t decision;
    for (decision = 0; decision <= index && decision < VC_UNARY_LIMIT; decision++)
        encode_decision(coder, model, contexts, decision, quantiser, index > decision);
    if (index >= VC_UNARY_LIMIT)
        vc_golomb_encode(coder, index - VC_UNARY_LIMIT);
}

static void encode_block(vc_mdct_encoder *encoder, vc_range_coder *coder, channel_state *channel,
                         const int32_t *coefficients, int32_t step)
{
    const uint32_t hop = encoder->configuration.hop;
    vc_history *history = &channel->history;
    vc_model *model = &encoder->model;
    uint32_t k, block_sum = 0;
    int silent = search(encoder, channel, coefficients, step);
    vc_range_encode(coder, silent, vc_silence_predict(model, history));
    vc_silence_update(model, history, silent);
    history->silent_history = (uint8_t)((history->silent_history << 1 | silent) & 3);
    if (silent)
        channel->state = 0;
    for (k = 0; k < hop && !silent; k++) {
        unsigned quantiser = vc_quantiser_of(channel->state);
        uint32_t index = encoder->indices[k];
        vc_contexts contexts;
        vc_contexts_find(&contexts, history, hop, k, block_sum);
        encode_index(coder, model, &contexts, quantiser, index);
        if (index != 0)
            vc_range_encode(coder, coefficients[k] < 0, VC_EVEN_ODDS);
        channel->state = vc_next_state(channel->state, index);
        block_sum += vc_history_set(history, k, vc_level_of(index, quantiser));
    }
    vc_history_next_block(history, hop);
}

int32_t vc_mdct_encode(vc_mdct_encoder *encoder, const int32_t *coefficients, uint8_t *packet, size_t capacity)
{
    const vc_mdct_configuration *configuration = &encoder->configuration;
    const int refresh =
        encoder->sequence == 0 || (encoder->refresh_packets != 0 && encoder->sequence % encoder->refresh_packets == 0);
    vc_range_coder coder;
    uint8_t *payload;
    uint32_t block;
    unsigned channel;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    payload = packet + vc_packet_head_write(packet, encoder->sequence, refresh);
    if (refresh)
        vc_model_reset(&encoder->model, encoder->tables);
    for (channel = 0; channel < configuration->channels && refresh; channel++) {
        vc_history_reset(&encoder->channels[channel].history);
        encoder->channels[channel].state = 0;
    }
    vc_range_encoder_init(&coder, payload, capacity - (size_t)(payload - packet));
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++, coefficients += configuration->hop)
            encode_block(encoder, &coder, &encoder->channels[channel], coefficients, configuration->step[channel]);
    encoder->sequence++;
    payload += vc_range_encoder_finish(&coder, payload);
    return coder.overflow ? VC_PACKET_TOO_LARGE : (int32_t)(payload - packet);
}
