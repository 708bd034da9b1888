/* Encoder of `slp`, its integer half: chooses predictors, quantises the residual in a closed loop, codes the frames. */
#include "vc_slp_frame.h"

/* Frames that a new predictor is expected to serve: its bits are divided by this before they are compared with the
 * savings in one frame. */
#define PREDICTOR_LIFE 6

struct vc_slp_encoder {
    vc_slp_configuration configuration;
    uint32_t refresh_packets, rounding, sequence;
    vc_slp_model model;
    vc_quantiser_offset quantiser_offset;
    vc_slp_channel channels[VC_MAX_CHANNELS];
};

/* A candidate predictor for a frame, and the residual that it leaves. */
typedef struct {
    int8_t reflections[VC_SLP_MAX_ORDER];
    int32_t log_steps[VC_SLP_MAX_FRAME], steps[VC_SLP_MAX_FRAME];
    int32_t spectrum[VC_SLP_MAX_FRAME]; /* of the residual */
    int32_t cost;                       /* estimated, in 1/256 bit */
} candidate;

size_t vc_slp_encoder_size(void)
{
    return sizeof(vc_slp_encoder);
}

int vc_slp_encoder_init(vc_slp_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, uint32_t refresh_packets, uint32_t rounding)
{
    memset(encoder, 0, sizeof *encoder);
    encoder->refresh_packets = refresh_packets;
    encoder->rounding = rounding;
    return vc_slp_configuration_read(&encoder->configuration, configuration, configuration_length, channels);
}

static uint32_t magnitude_of(int32_t value)
{
    return (uint32_t)(value < 0 ? -value : value);
}

/* Finds the steps and the residual of a frame from the state of the decoder's filter, and estimates its bits: of a
 * coefficient c, log2(1 + |c| / step). */
static void measure(candidate *tried, const vc_slp_encoder *encoder, const vc_slp_channel *channel,
                    const int32_t *samples)
{
    const vc_slp_configuration *configuration = &encoder->configuration;
    int32_t residual[VC_SLP_MAX_FRAME], backward[VC_SLP_MAX_ORDER + 1];
    uint32_t n;
    memcpy(backward, channel->backward, sizeof backward);
    vc_slp_analyse(configuration, tried->reflections, backward, samples, residual);
    vc_slp_dct(residual, configuration->frame, tried->spectrum);
    tried->cost = 0;
    for (n = 0; n < configuration->frame; n++) {
        tried->steps[n] = vc_slp_step(tried->log_steps[n], &encoder->quantiser_offset);
        tried->cost +=
            vc_slp_log2(256 + ((uint64_t)magnitude_of(tried->spectrum[n]) << 8) / (uint32_t)tried->steps[n]) - 8 * 256;
    }
}

/* Estimated bits of a predictor that differs from the last one, in 1/256 bit. */
static int32_t predictor_cost(const int8_t *reflections, const int8_t *last, unsigned order)
{
    int32_t cost = 4 * 256;
    unsigned i;
    for (i = 0; i < order; i++)
        cost += 256 + 2 * (vc_slp_log2(1 + magnitude_of(reflections[i] - last[i])));
    return cost;
}

static int32_t quantised(int32_t value, int32_t step, uint32_t rounding)
{
    uint64_t level = (((uint64_t)magnitude_of(value) << 8) / (uint32_t)step + rounding) >> 8;
    if (level > VC_SLP_MAX_LEVEL)
        level = VC_SLP_MAX_LEVEL;
    return value < 0 ? -(int32_t)level : (int32_t)level;
}

static void encode_frame(vc_slp_encoder *encoder, vc_range_coder *coder, unsigned number, const int32_t *samples,
                         const int8_t *reflections, int silent)
{
    const vc_slp_configuration *configuration = &encoder->configuration;
    vc_slp_channel *channel = &encoder->channels[number];
    candidate kept, fresh, *chosen = &kept;
    vc_slp_frame frame;
    int32_t residual[VC_SLP_MAX_FRAME], output[VC_SLP_MAX_FRAME];
    int differs = 0;
    uint32_t k;
    memcpy(kept.reflections, channel->reflections, sizeof kept.reflections);
    memcpy(kept.log_steps, channel->log_steps, sizeof kept.log_steps);
    measure(&kept, encoder, channel, samples);
    memset(fresh.reflections, 0, sizeof fresh.reflections);
    memcpy(fresh.reflections, reflections, configuration->order);
    for (k = 0; k < configuration->order; k++)
        differs |= fresh.reflections[k] != kept.reflections[k];
    if (differs) {
        vc_slp_log_steps(configuration, number, fresh.reflections, fresh.log_steps);
        measure(&fresh, encoder, channel, samples);
        if (fresh.cost + predictor_cost(fresh.reflections, kept.reflections, configuration->order) / PREDICTOR_LIFE <
            kept.cost)
            chosen = &fresh;
    }
    memcpy(frame.reflections, chosen->reflections, sizeof frame.reflections);
    frame.silent = 1;
    for (k = 0; k < configuration->frame; k++) {
        frame.levels[k] = silent ? 0 : quantised(chosen->spectrum[k], chosen->steps[k], encoder->rounding);
        frame.silent &= frame.levels[k] == 0;
    }
    vc_slp_code_frame(coder, 1, &encoder->model, channel, configuration, number, &frame);
    for (k = 0; k < configuration->frame; k++)
        chosen->spectrum[k] =
            vc_slp_reconstruct(frame.levels[k], vc_slp_step(channel->log_steps[k], &encoder->quantiser_offset));
    vc_slp_inverse_dct(chosen->spectrum, configuration->frame, residual);
    vc_slp_synthesise(configuration, channel->reflections, channel->backward, residual, output);
}

int32_t vc_slp_encode(vc_slp_encoder *encoder, const int32_t *samples, const int8_t *reflections,
                      int32_t quantiser_offset, uint8_t *packet, size_t capacity)
{
    const vc_slp_configuration *configuration = &encoder->configuration;
    const int refresh =
        encoder->sequence == 0 || (encoder->refresh_packets != 0 && encoder->sequence % encoder->refresh_packets == 0);
    vc_range_coder coder;
    uint8_t *payload;
    uint32_t index;
    unsigned channel;
    const int silent = configuration->rate_controlled && quantiser_offset == VC_SLP_SILENT;
    if (capacity < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    payload = packet + vc_packet_head_write(packet, encoder->sequence, refresh);
    if (refresh) {
        vc_slp_model_reset(&encoder->model, configuration);
        vc_quantiser_offset_reset(&encoder->quantiser_offset);
    }
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_slp_channel_reset(&encoder->channels[channel], configuration, channel);
    vc_range_encoder_init(&coder, payload, capacity - (size_t)(payload - packet));
    if (configuration->rate_controlled)
        vc_quantiser_offset_encode(&coder, &encoder->quantiser_offset,
                                   silent ? encoder->quantiser_offset.value : quantiser_offset);
    for (index = 0; index < configuration->packet_frames; index++)
        for (channel = 0; channel < configuration->channels; channel++) {
            encode_frame(encoder, &coder, channel, samples, reflections, silent);
            samples += configuration->frame;
            reflections += configuration->order;
        }
    encoder->sequence++;
    payload += vc_range_encoder_finish(&coder, payload);
    return coder.overflow ? VC_PACKET_TOO_LARGE : (int32_t)(payload - packet);
}
