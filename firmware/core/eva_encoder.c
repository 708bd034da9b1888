/* Encoder of `eva`: latents in quantiser steps to packets, the decoder's steps mirrored; see eva.h. */
#include "eva_model.h"

#define MAX_MAGNITUDE (1 << 30)

struct vc_eva_encoder {
    vc_eva_model model;
    vc_eva_configuration configuration;
    uint32_t refresh_packets, lambda, sequence;
    vc_model prior;
    vc_quantiser_offset quantiser_offset;
    vc_block_state channels[VC_MAX_CHANNELS];
    vc_block_search search;
};

size_t vc_eva_encoder_size(void)
{
    return sizeof(vc_eva_encoder);
}

int vc_eva_encoder_init(vc_eva_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, const uint8_t *model, size_t model_length, uint32_t refresh_packets,
                        uint32_t lambda)
{
    int status;
    memset(encoder, 0, sizeof *encoder);
    encoder->refresh_packets = refresh_packets;
    encoder->lambda = lambda;
    status = vc_eva_model_read(&encoder->model, model, model_length);
    if (status != VC_OK)
        return status;
    return vc_eva_configuration_read(&encoder->configuration, &encoder->model, configuration, configuration_length,
                                     channels);
}

void vc_eva_encoder_tables(const vc_eva_encoder *encoder, uint8_t *tables)
{
    vc_model_export(&encoder->prior, tables);
}

static void encode_factorised(vc_range_coder *coder, const uint8_t *probabilities, uint32_t magnitude, int negative)
{
    uint32_t level = (magnitude + 128) / 256;
    unsigned decision;
    for (decision = 0; decision <= level && decision < VC_UNARY_LIMIT; decision++)
        vc_range_encode(coder, level > decision, vc_eva_probability(probabilities, decision));
    if (level >= VC_UNARY_LIMIT)
        vc_golomb_encode(coder, level - VC_UNARY_LIMIT);
    if (level != 0)
        vc_range_encode(coder, negative, vc_eva_probability(probabilities, VC_UNARY_LIMIT));
}

static void encode_column(vc_eva_encoder *encoder, vc_range_coder *coder, unsigned channel, const int32_t *latents,
                          uint32_t lambda)
{
    const vc_eva_model *model = &encoder->model;
    const uint32_t quality =
        vc_eva_packet_quality(model, &encoder->configuration, channel, encoder->quantiser_offset.value);
    uint32_t magnitudes[VC_EVA_MAX_WIDTH], k;
    for (k = 0; k < model->latents; k++) {
        int64_t magnitude = latents[k] < 0 ? -(int64_t)latents[k] : latents[k];
        magnitudes[k] = (uint32_t)(magnitude < MAX_MAGNITUDE ? magnitude : MAX_MAGNITUDE);
        if (!model->adapts)
            encode_factorised(coder, vc_eva_probabilities(model, quality, k), magnitudes[k], latents[k] < 0);
    }
    if (model->adapts)
        vc_block_encode(coder, &encoder->prior, &encoder->channels[channel], &encoder->search, model->latents,
                        magnitudes, latents, lambda);
}

int32_t vc_eva_encode(vc_eva_encoder *encoder, const int32_t *latents, int32_t quantiser_offset, uint8_t *packet,
                      size_t capacity)
{
    const vc_eva_configuration *configuration = &encoder->configuration;
    const int refresh =
        encoder->sequence == 0 || (encoder->refresh_packets != 0 && encoder->sequence % encoder->refresh_packets == 0);
    vc_range_coder coder;
    uint8_t *payload;
    uint32_t column, lambda = encoder->lambda;
    unsigned channel;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    payload = packet + vc_packet_head_write(packet, encoder->sequence, refresh);
    if (refresh && encoder->model.adapts)
        vc_model_reset(&encoder->prior, encoder->model.prior);
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_block_reset(&encoder->channels[channel]);
    if (refresh)
        vc_quantiser_offset_reset(&encoder->quantiser_offset);
    vc_range_encoder_init(&coder, payload, capacity - (size_t)(payload - packet));
    if (configuration->rate_controlled)
        lambda = vc_quantiser_offset_encode_fours(&coder, &encoder->quantiser_offset, quantiser_offset, lambda);
    for (channel = 0; channel < configuration->channels; channel++)
        for (column = 0; column < configuration->packet_columns; column++, latents += encoder->model.latents)
            encode_column(encoder, &coder, channel, latents, lambda);
    encoder->sequence++;
    payload += vc_range_encoder_finish(&coder, payload);
    return coder.overflow ? VC_PACKET_TOO_LARGE : (int32_t)(payload - packet);
}
