/* Decoder of `slp`: packets to residual spectra, spectra to samples, fades where packets miss. */
#include "vc_codec.h"
#include "vc_decoder_memory.h"

#define FADE_SAMPLES 256u /* longest time that concealment sounds */
/* For a sample of a channel, and for each sample of its frame, a tenth more; docs/benchmarks/firmware.md. */
#define CYCLES 1800u
#define CYCLES_BY_FRAME 29u

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

int vc_slp_feed(vc_slp_decoder *decoder, const uint8_t *packet, size_t length)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    uint32_t sequence;
    int refresh;
    unsigned channel;
    const size_t head = packet == NULL ? 0 : vc_packet_head_read(packet, length, &sequence, &refresh);
    if (packet != NULL && head == 0)
        return VC_BAD_PACKET;
    decoder->index = 0;
    decoder->concealing = packet == NULL || (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence));
    decoder->in_sequence = !decoder->concealing;
    if (decoder->concealing)
        return VC_CONCEALED;
    decoder->rising = decoder->concealed > 0 || sequence != decoder->next_sequence;
    if (refresh) {
        vc_slp_model_reset(&decoder->model, configuration);
        vc_quantiser_offset_reset(&decoder->quantiser_offset);
    }
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_slp_channel_reset(&decoder->channels[channel], configuration, channel);
    decoder->next_sequence = sequence + 1;
    decoder->concealed = 0;
    vc_range_decoder_init(&decoder->coder, packet + head, length - head);
    if (configuration->rate_controlled)
        vc_quantiser_offset_decode(&decoder->coder, &decoder->quantiser_offset);
    return VC_OK;
}

static void decode_frame(vc_slp_decoder *decoder, unsigned channel, int16_t *samples)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    vc_slp_channel *state = &decoder->channels[channel];
    vc_slp_frame frame;
    int32_t spectrum[VC_SLP_MAX_FRAME];
    uint32_t k;
    memset(&frame, 0, sizeof frame);
    vc_slp_code_frame(&decoder->coder, 0, &decoder->model, state, configuration, channel, &frame);
    for (k = 0; k < configuration->frame; k++)
        spectrum[k] =
            frame.levels[k] == 0
                ? 0
                : vc_slp_reconstruct(frame.levels[k], vc_slp_step(state->log_steps[k], &decoder->quantiser_offset));
    play(decoder, channel, spectrum, decoder->rising && decoder->index == 0, samples);
}

/* Writes a frame of all channels: the last one backwards, forwards and so on, without a step where it turns. */
static void conceal_frame(vc_slp_decoder *decoder, int16_t *samples)
{
    const vc_slp_configuration *configuration = &decoder->configuration;
    const uint32_t packet_samples = vc_slp_decoder_packet_samples(decoder), frame = configuration->frame;
    const uint32_t fade = packet_samples < FADE_SAMPLES ? packet_samples : FADE_SAMPLES;
    uint32_t n;
    unsigned channel;
    for (n = 0; n < frame; n++) {
        const uint32_t turn = decoder->concealed % (2 * frame);
        const uint32_t from = turn < frame ? frame - 1 - turn : turn - frame;
        const int32_t weight = (int32_t)(fade - decoder->concealed);
        for (channel = 0; channel < configuration->channels; channel++)
            *samples++ = (int16_t)(decoder->last[channel][from] * weight / (int32_t)fade);
        if (decoder->concealed < fade)
            decoder->concealed++;
    }
}

uint32_t vc_slp_poll(vc_slp_decoder *decoder, int16_t *samples)
{
    const unsigned channels = decoder->configuration.channels;
    const uint32_t frame = decoder->configuration.frame;
    unsigned channel;
    samples += (size_t)decoder->index * frame * channels;
    if (decoder->concealing)
        conceal_frame(decoder, samples);
    for (channel = 0; channel < channels && !decoder->concealing; channel++)
        decode_frame(decoder, channel, samples + channel);
    return ++decoder->index * frame;
}

int vc_slp_decode(vc_slp_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_codec_decode(&vc_slp_codec, decoder, vc_slp_decoder_packet_samples(decoder), packet, length, samples);
}

static int check(vc_coding *coding)
{
    vc_slp_configuration read;
    const int status =
        vc_slp_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_frames * read.frame;
        coding->delay_samples = 0;
        coding->cycles_per_sample = coding->channels * (CYCLES + CYCLES_BY_FRAME * read.frame);
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_slp_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels);
}

static int feed(void *decoder, const uint8_t *packet, size_t length)
{
    return vc_slp_feed(decoder, packet, length);
}

static uint32_t poll(void *decoder, int16_t *samples)
{
    return vc_slp_poll(decoder, samples);
}

const vc_codec vc_slp_codec = {3, "slp", sizeof(struct vc_slp_decoder), 0, NULL, check, init, feed, poll};
