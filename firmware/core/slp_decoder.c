/* Decoder of `slp`: packets to residual spectra, spectra to samples, fades where packets miss. */
#include "slp_frame.h"

#define FADE_SAMPLES 256u /* longest time that concealment sounds */

struct vc_slp_decoder {
    vc_slp_configuration configuration;
    vc_slp_model model;
    uint32_t next_sequence;
    int in_sequence;    /* packets since the last refresh all came */
    uint32_t concealed; /* samples of the gap so far, at most FADE_SAMPLES */
    uint32_t random;    /* state of the generator that gives concealment its signs */
    vc_slp_channel channels[VC_MAX_CHANNELS];
    int32_t spectrum[VC_MAX_CHANNELS][VC_SLP_MAX_FRAME]; /* of the last residual */
};

size_t vc_slp_decoder_size(void)
{
    return sizeof(vc_slp_decoder);
}

int vc_slp_decoder_init(vc_slp_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels)
{
    memset(decoder, 0, sizeof *decoder);
    decoder->random = 1;
    return vc_slp_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
}

uint32_t vc_slp_decoder_packet_samples(const vc_slp_decoder *decoder)
{
    return decoder->configuration.packet_frames * decoder->configuration.frame;
}

/* Plays one channel's next frame into samples `stride` apart; sample n is weighed by (start + slope n) / length. */
static void play(vc_slp_decoder *decoder, unsigned number, uint32_t start, int slope, uint32_t length, int16_t *samples)
{
    vc_slp_channel *channel = &decoder->channels[number];
    int32_t residual[VC_SLP_MAX_FRAME], output[VC_SLP_MAX_FRAME];
    uint32_t n;
    vc_slp_inverse_dct(decoder->spectrum[number], decoder->configuration.frame, residual);
    vc_slp_synthesise(&decoder->configuration, channel->reflections, channel->backward, residual, output);
    for (n = 0; n < decoder->configuration.frame; n++) {
        int64_t weight = (int64_t)start + slope * (int64_t)n;
        samples[n * decoder->configuration.channels] =
            vc_rounded_sample(output[n] * (weight < 0 ? 0 : weight) / length);
    }
}

int vc_slp_decode(vc_slp_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    vc_range_coder coder;
    vc_slp_frame frame;
    uint32_t sequence, index, k;
    int refresh, rising;
    unsigned channel;
    size_t head = vc_packet_head_read(packet, length, &sequence, &refresh);
    if (head == 0)
        return VC_BAD_PACKET;
    if (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence)) {
        vc_slp_conceal(decoder, samples);
        return VC_CONCEALED;
    }
    rising = decoder->concealed > 0 || sequence != decoder->next_sequence;
    if (refresh)
        vc_slp_model_reset(&decoder->model);
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_slp_channel_reset(&decoder->channels[channel], configuration, channel);
    decoder->in_sequence = 1;
    decoder->next_sequence = sequence + 1;
    decoder->concealed = 0;
    vc_range_decoder_init(&coder, packet + head, length - head);
    for (index = 0; index < configuration->packet_frames; index++)
        for (channel = 0; channel < configuration->channels; channel++) {
            vc_slp_channel *state = &decoder->channels[channel];
            memset(&frame, 0, sizeof frame);
            vc_slp_code_frame(&coder, 0, &decoder->model, state, configuration, channel, &frame);
            for (k = 0; k < configuration->frame; k++)
                decoder->spectrum[channel][k] = vc_slp_reconstruct(frame.levels[k], state->steps[k]);
            if (rising && index == 0)
                play(decoder, channel, 0, 1, configuration->frame, samples + channel);
            else
                play(decoder, channel, 1, 0, 1, samples + channel);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->frame * configuration->channels;
        }
    return VC_OK;
}

/* Pseudo-random sign from a linear congruential generator (Numerical Recipes' constants). */
static int32_t random_sign(vc_slp_decoder *decoder)
{
    decoder->random = decoder->random * 1664525u + 1013904223u;
    return decoder->random >> 31 ? -1 : 1;
}

void vc_slp_conceal(vc_slp_decoder *decoder, int16_t *samples)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    const uint32_t packet_samples = vc_slp_decoder_packet_samples(decoder);
    const uint32_t fade = packet_samples < FADE_SAMPLES ? packet_samples : FADE_SAMPLES;
    uint32_t index, k;
    unsigned channel;
    decoder->in_sequence = 0;
    for (index = 0; index < configuration->packet_frames; index++) {
        /* Each frame repeats the last residual with random signs through the last filter, the output ramped to zero. */
        for (channel = 0; channel < configuration->channels; channel++) {
            for (k = 0; k < configuration->frame; k++)
                decoder->spectrum[channel][k] *= random_sign(decoder);
            play(decoder, channel, fade - decoder->concealed, -1, fade, samples + channel);
        }
        samples += (size_t)configuration->frame * configuration->channels;
        decoder->concealed += configuration->frame;
        if (decoder->concealed > fade)
            decoder->concealed = fade;
    }
}
