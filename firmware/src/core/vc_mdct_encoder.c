/* Encoder of `mdct`: coefficients in quantiser steps, for the block coder. */
#include "vc_block_coder.h"
#include "vc_mdct_synthesis.h"

struct vc_mdct_encoder {
    vc_mdct_configuration configuration;
    const uint8_t *tables;
    uint32_t refresh_packets, lambda, sequence;
    vc_model model;
    vc_quantiser_offset quantiser_offset;
    vc_block_state channels[VC_MAX_CHANNELS];
    vc_block_search search;
    int32_t steps[VC_MAX_CHANNELS][VC_MAX_BINS]; /* of this packet */
    uint32_t random;                             /* the decoder's generator of signs of noise filling */
    uint64_t squared_errors[VC_MAX_CHANNELS];
    const vc_mdct_encoder *before; /* its model is that of the first refresh; NULL = the tables */
    vc_centroid_sums sums;         /* while training */
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
    encoder->tables = tables == NULL ? vc_builtin_tables : tables;
    encoder->refresh_packets = refresh_packets;
    encoder->lambda = lambda;
    status = vc_model_check_tables(tables, tables_length);
    if (status != VC_OK)
        return status;
    vc_model_reset(&encoder->model, encoder->tables);
    vc_model_begin(&encoder->model);
    return vc_configuration_read(&encoder->configuration, configuration, configuration_length, channels);
}

void vc_mdct_encoder_tables(const vc_mdct_encoder *encoder, uint8_t *tables)
{
    vc_model_export(&encoder->model, tables);
    if (encoder->search.sums != NULL)
        vc_centroids_export(&encoder->sums, tables);
}

void vc_mdct_encoder_follow(vc_mdct_encoder *encoder, const vc_mdct_encoder *before)
{
    encoder->search.sums = &encoder->sums;
    encoder->before = before;
    if (before != NULL)
        encoder->sums = before->sums;
}

/* At a refresh. */
static void restart(vc_mdct_encoder *encoder)
{
    unsigned channel;
    vc_model_reset(&encoder->model, encoder->tables);
    vc_model_begin(&encoder->model);
    if (encoder->before != NULL) {
        encoder->model = encoder->before->model;
        encoder->model.tables = encoder->tables;
        encoder->before = NULL;
    }
    vc_quantiser_offset_reset(&encoder->quantiser_offset);
    for (channel = 0; channel < encoder->configuration.channels; channel++)
        vc_block_reset(&encoder->channels[channel]);
}

/* Folds the 2 N samples of a block under their window, which the transform then turns into its spectrum. */
static void analyse_block(const int32_t *first, unsigned stride, uint32_t hop, int32_t *coefficients)
{
    const int32_t *const second = first + (size_t)hop * stride;
    int32_t folded[VC_MAX_BINS] = {0};
    unsigned shift;
    uint32_t n;
    for (n = 0; n < hop / 2; n++) {
        const uint32_t mirror = hop - 1 - n;
        const int64_t rising = vc_window(hop, n), falling = vc_window(hop, mirror);
        folded[hop / 2 + n] = (int32_t)vc_rounded(first[n * stride] * rising - first[mirror * stride] * falling);
        folded[hop / 2 - 1 - n] = (int32_t)vc_rounded(-second[n * stride] * falling - second[mirror * stride] * rising);
    }
    shift = vc_cosine_transform(folded, hop, coefficients);
    for (n = 0; n < hop; n++)
        coefficients[n] = vc_weighted(coefficients[n], vc_norm(hop)) * (1 << shift);
}

void vc_mdct_analyse(const int32_t *samples, uint32_t blocks, unsigned channels, uint32_t hop, int32_t *coefficients)
{
    uint32_t block;
    unsigned channel;
    for (block = 0; block < blocks; block++, samples += (size_t)hop * channels)
        for (channel = 0; channel < channels; channel++, coefficients += hop)
            analyse_block(samples + channel, channels, hop, coefficients);
}

static uint32_t magnitude_of(int32_t value)
{
    int64_t magnitude = value < 0 ? -(int64_t)value : value;
    return (uint32_t)(magnitude < VC_MAX_COEFFICIENT ? magnitude : VC_MAX_COEFFICIENT);
}

/* Adds the squared error of the block that has just been coded; `state`: of dependent quantisation, before it. */
static void add_error(vc_mdct_encoder *encoder, unsigned channel, const int32_t *coefficients, unsigned state)
{
    const vc_mdct_configuration *configuration = &encoder->configuration;
    const int silent = encoder->channels[channel].history.silent_history & 1;
    uint64_t sum = 0;
    uint32_t k;
    for (k = 0; k < configuration->hop; k++) {
        const int32_t step = encoder->steps[channel][k];
        const int32_t fill = silent ? 0 : (int32_t)((int64_t)step * configuration->fill[channel] / 128);
        const uint32_t index = silent ? 0 : encoder->search.indices[k];
        const int32_t level = (int32_t)vc_level_of(index, vc_quantiser_of(state));
        const int32_t value =
            level == 0 ? fill * vc_random_sign(&encoder->random)
                       : vc_reconstruct(coefficients[k] < 0 ? -level : level, encoder->search.offsets[k], step);
        const int64_t error = vc_clamped(coefficients[k] - value, VC_MAX_COEFFICIENT);
        state = vc_next_state(state, index);
        sum += (uint64_t)(error * error) >> 4; /* so that the sum of a block fits */
    }
    encoder->squared_errors[channel] += sum >> 4;
}

static void encode_block(vc_mdct_encoder *encoder, vc_range_coder *coder, unsigned channel, const int32_t *coefficients,
                         uint32_t lambda)
{
    const vc_mdct_configuration *configuration = &encoder->configuration;
    const unsigned state = encoder->channels[channel].state;
    uint32_t magnitudes[VC_MAX_BINS], k;
    for (k = 0; k < configuration->hop; k++) {
        const int32_t step = encoder->steps[channel][k];
        magnitudes[k] = (uint32_t)(((uint64_t)magnitude_of(coefficients[k]) << 8) / (uint32_t)step);
    }
    vc_block_encode(coder, &encoder->model, &encoder->channels[channel], &encoder->search, configuration->hop,
                    magnitudes, coefficients, lambda);
    add_error(encoder, channel, coefficients, state);
}

uint64_t vc_mdct_squared_error(const vc_mdct_encoder *encoder, unsigned channel)
{
    return encoder->squared_errors[channel];
}

/* Begins the next packet: its head, and at a refresh a new start. Returns where its payload begins. */
static uint8_t *begin_packet(vc_mdct_encoder *encoder, vc_range_coder *coder, int refresh, uint8_t *packet,
                             size_t capacity)
{
    uint8_t *payload = packet + vc_packet_head_write(packet, encoder->sequence, refresh);
    encoder->random = encoder->sequence++;
    if (refresh)
        restart(encoder);
    vc_range_encoder_init(coder, payload, capacity - (size_t)(payload - packet));
    return payload;
}

static int32_t end_packet(vc_range_coder *coder, const uint8_t *packet, uint8_t *payload)
{
    payload += vc_range_encoder_finish(coder, payload);
    return coder->overflow ? VC_PACKET_TOO_LARGE : (int32_t)(payload - packet);
}

static void find_steps(vc_mdct_encoder *encoder)
{
    const vc_mdct_configuration *configuration = &encoder->configuration;
    unsigned channel;
    uint32_t k;
    for (channel = 0; channel < configuration->channels; channel++) {
        const int32_t flat_code = vc_flat_code(configuration, channel, encoder->quantiser_offset.value);
        for (k = 0; k < configuration->hop; k++)
            encoder->steps[channel][k] = vc_bin_step(configuration, flat_code, k);
    }
}

int32_t vc_mdct_encode(vc_mdct_encoder *encoder, const int32_t *coefficients, int32_t quantiser_offset, uint8_t *packet,
                       size_t capacity)
{
    const vc_mdct_configuration *configuration = &encoder->configuration;
    const int refresh =
        encoder->sequence == 0 || (encoder->refresh_packets != 0 && encoder->sequence % encoder->refresh_packets == 0);
    vc_range_coder coder;
    uint8_t *payload;
    uint32_t block, lambda = encoder->lambda;
    unsigned channel;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    payload = begin_packet(encoder, &coder, refresh, packet, capacity);
    if (configuration->rate_controlled)
        lambda = vc_quantiser_offset_encode_fours(&coder, &encoder->quantiser_offset, quantiser_offset, lambda);
    find_steps(encoder);
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++, coefficients += configuration->hop)
            encode_block(encoder, &coder, channel, coefficients, lambda);
    return end_packet(&coder, packet, payload);
}

int vc_mdct_read_levels(vc_mdct_encoder *reader, const uint8_t *packet, size_t length, int32_t *levels, uint8_t *silent,
                        int32_t *quantiser_offset)
{
    const vc_mdct_configuration *configuration = &reader->configuration;
    vc_range_coder coder;
    uint32_t sequence, block;
    int8_t offsets[VC_MAX_BINS];
    int refresh;
    unsigned channel;
    const size_t head = vc_packet_head_read(packet, length, &sequence, &refresh);
    if (head == 0 || sequence != reader->sequence || (sequence == 0 && !refresh))
        return VC_BAD_PACKET;
    reader->sequence++;
    if (refresh)
        restart(reader);
    vc_range_decoder_init(&coder, packet + head, length - head);
    if (configuration->rate_controlled)
        vc_quantiser_offset_decode(&coder, &reader->quantiser_offset);
    *quantiser_offset = reader->quantiser_offset.value;
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++, levels += configuration->hop) {
            vc_block_state *state = &reader->channels[channel];
            vc_block_decode(&coder, &reader->model, state, configuration->hop, levels, offsets);
            *silent++ = state->history.silent_history & 1u;
        }
    return VC_OK;
}

int32_t vc_mdct_write_levels(vc_mdct_encoder *writer, const int32_t *levels, const uint8_t *silent,
                             int32_t quantiser_offset, int refresh, uint8_t *packet, size_t capacity)
{
    const vc_mdct_configuration *configuration = &writer->configuration;
    vc_range_coder coder;
    uint8_t *payload;
    uint32_t block;
    unsigned channel;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    payload = begin_packet(writer, &coder, refresh, packet, capacity);
    if (configuration->rate_controlled)
        vc_quantiser_offset_encode(&coder, &writer->quantiser_offset, quantiser_offset);
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++, levels += configuration->hop)
            vc_block_write(&coder, &writer->model, &writer->channels[channel], &writer->search, configuration->hop,
                           levels, *silent++);
    return end_packet(&coder, packet, payload);
}
