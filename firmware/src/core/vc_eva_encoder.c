/* Encoder of `eva`: levels of latents to packets; see vc_eva.h. */
#include "vc_eva_latents.h"

struct vc_eva_encoder {
    vc_eva_model model;
    vc_eva_configuration configuration;
    uint32_t refresh_packets, sequence;
    vc_quantiser_offset quantiser_offset;
    vc_eva_contexts channels[VC_MAX_CHANNELS];
};

size_t vc_eva_encoder_size(void)
{
    return sizeof(vc_eva_encoder);
}

int vc_eva_encoder_init(vc_eva_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, const uint8_t *model, size_t model_length, uint32_t refresh_packets)
{
    int status;
    memset(encoder, 0, sizeof *encoder);
    encoder->refresh_packets = refresh_packets;
    status = vc_eva_model_read(&encoder->model, model, model_length);
    if (status != VC_OK)
        return status;
    return vc_eva_configuration_read(&encoder->configuration, configuration, configuration_length, channels);
}

int32_t vc_eva_encode(vc_eva_encoder *encoder, const int32_t *levels, int32_t quantiser_offset, uint8_t *packet,
                      size_t capacity)
{
    const vc_eva_configuration *configuration = &encoder->configuration;
    const size_t latents = encoder->model.latents;
    const int refresh =
        encoder->sequence == 0 || (encoder->refresh_packets != 0 && encoder->sequence % encoder->refresh_packets == 0);
    vc_range_coder coder;
    uint8_t *payload;
    int32_t column_levels[VC_EVA_MAX_WIDTH];
    uint32_t column;
    unsigned channel;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    payload = packet + vc_packet_head_write(packet, encoder->sequence, refresh);
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_eva_contexts_reset(&encoder->channels[channel], &encoder->model);
    if (refresh)
        vc_quantiser_offset_reset(&encoder->quantiser_offset);
    vc_range_encoder_init(&coder, payload, capacity - (size_t)(payload - packet));
    if (configuration->rate_controlled)
        vc_quantiser_offset_encode(&coder, &encoder->quantiser_offset, quantiser_offset);
    for (channel = 0; channel < configuration->channels; channel++)
        for (column = 0; column < configuration->packet_columns; column++, levels += latents) {
            memcpy(column_levels, levels, latents * sizeof *levels);
            vc_eva_code_column(&coder, 1, &encoder->channels[channel], &encoder->model, column_levels);
        }
    encoder->sequence++;
    payload += vc_range_encoder_finish(&coder, payload);
    return coder.overflow ? VC_PACKET_TOO_LARGE : (int32_t)(payload - packet);
}
