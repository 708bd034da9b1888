/* Decoder of `slp`: packets to residual spectra, spectra to samples, fades where packets miss. */
#include "codec.h"
#include "decoder_memory.h"

#define FADE_SAMPLES 256u /* longest time that concealment sounds */

size_t vc_slp_decoder_size(void)
{
    return sizeof(vc_slp_decoder);
}

int vc_slp_decoder_init(vc_slp_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels)
{
    memset(decoder, 0, sizeof *decoder);
    return vc_slp_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
}

uint32_t vc_slp_decoder_packet_samples(const vc_slp_decoder *decoder)
{
    return decoder->configuration.packet_frames * decoder->configuration.frame;
}

/* Plays one channel's next frame, of this spectrum of the residual, into its samples; `rising`: from silence. */
static void play(vc_slp_decoder *decoder, unsigned number, const int32_t *spectrum, int rising, int16_t *samples)
{
    vc_slp_channel *channel = &decoder->channels[number];
    const uint32_t frame = decoder->configuration.frame;
    int32_t residual[VC_SLP_MAX_FRAME], output[VC_SLP_MAX_FRAME];
    uint32_t n;
    vc_slp_inverse_dct(spectrum, frame, residual);
    vc_slp_synthesise(&decoder->configuration, channel->reflections, channel->backward, residual, output);
    for (n = 0; n < frame; n++) {
        int64_t value = rising ? (int64_t)output[n] * n / frame : output[n];
        decoder->last[number][n] = vc_rounded_sample(value);
        samples[n * decoder->configuration.channels] = decoder->last[number][n];
    }
}

int vc_slp_decode(vc_slp_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    vc_range_coder coder;
    vc_slp_frame frame;
    int32_t spectrum[VC_SLP_MAX_FRAME];
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
    if (refresh) {
        vc_slp_model_reset(&decoder->model);
        vc_quantiser_offset_reset(&decoder->quantiser_offset);
    }
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_slp_channel_reset(&decoder->channels[channel], configuration, channel);
    decoder->in_sequence = 1;
    decoder->next_sequence = sequence + 1;
    decoder->concealed = 0;
    vc_range_decoder_init(&coder, packet + head, length - head);
    if (configuration->rate_controlled)
        vc_quantiser_offset_decode(&coder, &decoder->quantiser_offset);
    for (index = 0; index < configuration->packet_frames; index++)
        for (channel = 0; channel < configuration->channels; channel++) {
            vc_slp_channel *state = &decoder->channels[channel];
            memset(&frame, 0, sizeof frame);
            vc_slp_code_frame(&coder, 0, &decoder->model, state, configuration, channel, &frame);
            for (k = 0; k < configuration->frame; k++)
                spectrum[k] = frame.levels[k] == 0
                                  ? 0
                                  : vc_slp_reconstruct(frame.levels[k],
                                                       vc_slp_step(state->log_steps[k], &decoder->quantiser_offset));
            play(decoder, channel, spectrum, rising && index == 0, samples + channel);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->frame * configuration->channels;
        }
    return VC_OK;
}

void vc_slp_conceal(vc_slp_decoder *decoder, int16_t *samples)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    const uint32_t packet_samples = vc_slp_decoder_packet_samples(decoder), frame = configuration->frame;
    const uint32_t fade = packet_samples < FADE_SAMPLES ? packet_samples : FADE_SAMPLES;
    uint32_t n;
    unsigned channel;
    decoder->in_sequence = 0;
    for (n = 0; n < packet_samples; n++) {
        /* The last frame backwards, forwards and so on, without a step where it turns. */
        const uint32_t turn = decoder->concealed % (2 * frame);
        const uint32_t from = turn < frame ? frame - 1 - turn : turn - frame;
        const int32_t weight = (int32_t)(fade - decoder->concealed);
        for (channel = 0; channel < configuration->channels; channel++)
            *samples++ = (int16_t)(decoder->last[channel][from] * weight / (int32_t)fade);
        if (decoder->concealed < fade)
            decoder->concealed++;
    }
}

static int check(vc_coding *coding)
{
    vc_slp_configuration read;
    const int status =
        vc_slp_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_frames * read.frame;
        coding->delay_samples = 0;
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_slp_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels);
}

static int decode(void *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_slp_decode(decoder, packet, length, samples);
}

static void conceal(void *decoder, int16_t *samples)
{
    vc_slp_conceal(decoder, samples);
}

const vc_codec vc_slp_codec = {3, "slp", 0, NULL, check, init, decode, conceal};
