/* Encoder of `parametric`, its integer half: codes frames that describe a texture. */
#include "vc_parametric_frame.h"

struct vc_parametric_encoder {
    vc_parametric_configuration configuration;
    uint32_t refresh_packets, sequence;
    vc_parametric_model model;
    vc_parametric_channel channels[VC_MAX_CHANNELS];
};

size_t vc_parametric_encoder_size(void)
{
    return sizeof(vc_parametric_encoder);
}

int vc_parametric_encoder_init(vc_parametric_encoder *encoder, const uint8_t *configuration,
                               size_t configuration_length, unsigned channels, uint32_t refresh_packets)
{
    memset(encoder, 0, sizeof *encoder);
    encoder->refresh_packets = refresh_packets;
    return vc_parametric_configuration_read(&encoder->configuration, configuration, configuration_length, channels);
}

static uint32_t times_of(const vc_parametric_configuration *configuration)
{
    return configuration->frame_blocks / configuration->level_blocks;
}

uint32_t vc_parametric_frame_values(const vc_parametric_encoder *encoder)
{
    const vc_parametric_configuration *configuration = &encoder->configuration;
    return 1 + times_of(configuration) + configuration->bands + configuration->harmonics;
}

static void encode_frame(vc_parametric_encoder *encoder, vc_range_coder *coder, unsigned number, int refresh,
                         const int16_t *values)
{
    const vc_parametric_configuration *configuration = &encoder->configuration;
    const uint32_t times = times_of(configuration);
    vc_parametric_channel *channel = &encoder->channels[number];
    vc_parametric_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.pitch = values[0];
    memcpy(frame.times, values + 1, times * sizeof *values);
    memcpy(frame.bands, values + 1 + times, configuration->bands * sizeof *values);
    memcpy(frame.harmonics, values + 1 + times + configuration->bands, configuration->harmonics * sizeof *values);
    vc_parametric_code_frame(coder, 1, &encoder->model, channel, configuration, refresh, &frame);
    if (frame.pitch >= 0)
        channel->phase += vc_parametric_turn(frame.pitch) * vc_parametric_frame_samples(configuration);
}

int32_t vc_parametric_encode(vc_parametric_encoder *encoder, const int16_t *frames, uint8_t *packet, size_t capacity)
{
    const vc_parametric_configuration *configuration = &encoder->configuration;
    const uint32_t values = vc_parametric_frame_values(encoder);
    const int refresh =
        encoder->sequence == 0 || (encoder->refresh_packets > 0 && encoder->sequence % encoder->refresh_packets == 0);
    vc_range_coder coder;
    uint32_t frame;
    unsigned channel;
    size_t head;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    head = vc_packet_head_write(packet, encoder->sequence, refresh);
    if (refresh)
        vc_parametric_model_reset(&encoder->model);
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_parametric_channel_reset(&encoder->channels[channel]);
    vc_range_encoder_init(&coder, packet + head, capacity - head);
    for (frame = 0; frame < configuration->packet_frames; frame++)
        for (channel = 0; channel < configuration->channels; channel++, frames += values)
            encode_frame(encoder, &coder, channel, refresh && frame == 0, frames);
    encoder->sequence++;
    head += vc_range_encoder_finish(&coder, packet + head);
    return coder.overflow ? VC_PACKET_TOO_LARGE : (int32_t)head;
}
