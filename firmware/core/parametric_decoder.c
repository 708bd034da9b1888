/* Decoder of `parametric`: packets to a description; from it, noise with its band levels by an inverse MDCT, and ridges
 * by oscillators; fades at missing packets. */
#include "codec.h"
#include "decoder_memory.h"
#include "mdct_synthesis.h"

#define FADE_BLOCKS 8u /* longest time that concealment sounds */

size_t vc_parametric_decoder_size(void)
{
    return sizeof(vc_parametric_decoder);
}

int vc_parametric_decoder_init(vc_parametric_decoder *decoder, const uint8_t *configuration,
                               size_t configuration_length, unsigned channels)
{
    memset(decoder, 0, sizeof *decoder);
    return vc_parametric_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
}

uint32_t vc_parametric_decoder_packet_samples(const vc_parametric_decoder *decoder)
{
    return decoder->configuration.packet_frames * vc_parametric_frame_samples(&decoder->configuration);
}

uint32_t vc_parametric_decoder_delay_samples(const vc_parametric_decoder *decoder)
{
    return decoder->configuration.hop;
}

/* Amplitude of a level, `time` above it, in 1/256 of a least significant bit. */
static int32_t amplitude(const vc_parametric_configuration *configuration, int32_t level, int32_t time)
{
    const int32_t levels = vc_parametric_levels(configuration);
    const int32_t sum = level + time > levels ? levels : level + time;
    return level > 0 && sum > 0 ? vc_step_of((uint32_t)(sum - 1) << (6 - configuration->level_bits)) : 0;
}

/* Adds the next block of the ridges to the output: harmonics whose amplitudes move to `target` in a straight line.
 * Phase shifts of pi h^2 / 8 keep their crests apart (M. R. Schroeder, "Synthesis of low-peak-factor signals and binary
 * sequences with low autocorrelation", IEEE Trans. IT 16, 1970). */
static void add_ridges(vc_parametric_synthesis *synthesis, uint32_t *phase, uint32_t hop, const int32_t *target)
{
    unsigned i;
    uint32_t n;
    for (i = 0; i < VC_PARAMETRIC_MAX_HARMONICS; i++) {
        const uint32_t turn = (i + 1) * synthesis->turn;
        const int32_t change = (target[i] - synthesis->amplitudes[i]) / (int32_t)hop;
        int32_t now = synthesis->amplitudes[i];
        uint32_t angle = (i + 1) * *phase + (i + 1) * (i + 1) * (1u << 28);
        if (now == 0 && target[i] == 0)
            continue;
        for (n = 0; n < hop; n++, angle += turn, now += change)
            synthesis->overlap[n] =
                vc_limited((int64_t)synthesis->overlap[n] + vc_rounded((int64_t)now * vc_cosine[angle >> 22]));
        synthesis->amplitudes[i] = target[i];
    }
    *phase += hop * synthesis->turn;
}

/* Puts out one frame of a channel. */
static void play(vc_parametric_decoder *decoder, unsigned number, const vc_parametric_frame *frame, int16_t *samples)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    const uint32_t hop = configuration->hop;
    vc_parametric_synthesis *synthesis = &decoder->synthesis[number];
    uint32_t block, k;
    unsigned i;
    if (frame->pitch >= 0)
        synthesis->turn = vc_parametric_turn(frame->pitch);
    for (block = 0; block < configuration->frame_blocks; block++) {
        const int32_t time = frame->times[block / configuration->level_blocks];
        int32_t target[VC_PARAMETRIC_MAX_HARMONICS];
        for (i = 0; i < VC_PARAMETRIC_MAX_HARMONICS; i++)
            target[i] = amplitude(configuration, frame->harmonics[i], time);
        for (i = 0; i < configuration->bands; i++) {
            const int32_t magnitude = amplitude(configuration, frame->bands[i], time);
            for (k = configuration->edges[i]; k < configuration->edges[i + 1]; k++)
                synthesis->spectrum[k] = magnitude * vc_random_sign(&decoder->random);
        }
        add_ridges(synthesis, &decoder->channels[number].phase, hop, target);
        vc_mdct_synthesise(synthesis->spectrum, synthesis->overlap, hop, samples, configuration->channels);
        samples += (size_t)hop * configuration->channels;
    }
}

int vc_parametric_decode(vc_parametric_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    vc_range_coder coder;
    vc_parametric_frame frame;
    uint32_t sequence, index;
    int refresh;
    unsigned channel;
    size_t head = vc_packet_head_read(packet, length, &sequence, &refresh);
    if (head == 0)
        return VC_BAD_PACKET;
    if (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence)) {
        vc_parametric_conceal(decoder, samples);
        return VC_CONCEALED;
    }
    if (refresh)
        vc_parametric_model_reset(&decoder->model);
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_parametric_channel_reset(&decoder->channels[channel]);
    decoder->in_sequence = 1;
    decoder->next_sequence = sequence + 1;
    decoder->random = sequence; /* so that a decoder that begins here draws the same numbers */
    vc_range_decoder_init(&coder, packet + head, length - head);
    for (index = 0; index < configuration->packet_frames; index++) {
        for (channel = 0; channel < configuration->channels; channel++) {
            memset(&frame, 0, sizeof frame);
            vc_parametric_code_frame(&coder, 0, &decoder->model, &decoder->channels[channel], configuration,
                                     refresh && index == 0, &frame);
            play(decoder, channel, &frame, samples + channel);
        }
        samples += (size_t)vc_parametric_frame_samples(configuration) * configuration->channels;
    }
    return VC_OK;
}

/* Returns the next value of a ramp to zero that has `left` steps left. */
static int32_t faded(int32_t value, uint32_t left)
{
    return left > 1 ? value / (int32_t)left * (int32_t)(left - 1) : 0;
}

void vc_parametric_conceal(vc_parametric_decoder *decoder, int16_t *samples)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    const uint32_t blocks = configuration->packet_frames * configuration->frame_blocks;
    const uint32_t fade = blocks < FADE_BLOCKS ? blocks : FADE_BLOCKS;
    uint32_t block, k;
    unsigned channel, i;
    decoder->in_sequence = 0;
    for (block = 0; block < blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++) {
            /* Each block repeats the last one with random signs, scaled to ramp to zero. */
            const uint32_t left = block < fade ? fade - block : 0;
            vc_parametric_synthesis *synthesis = &decoder->synthesis[channel];
            int32_t target[VC_PARAMETRIC_MAX_HARMONICS];
            for (i = 0; i < VC_PARAMETRIC_MAX_HARMONICS; i++)
                target[i] = faded(synthesis->amplitudes[i], left);
            for (k = 0; k < configuration->hop; k++)
                synthesis->spectrum[k] = faded(synthesis->spectrum[k], left) * vc_random_sign(&decoder->random);
            add_ridges(synthesis, &decoder->channels[channel].phase, configuration->hop, target);
            vc_mdct_synthesise(synthesis->spectrum, synthesis->overlap, configuration->hop, samples + channel,
                               configuration->channels);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->hop * configuration->channels;
        }
}

static int check(vc_coding *coding)
{
    vc_parametric_configuration read;
    const int status =
        vc_parametric_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_frames * vc_parametric_frame_samples(&read);
        coding->delay_samples = read.hop;
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_parametric_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels);
}

static int decode(void *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_parametric_decode(decoder, packet, length, samples);
}

static void conceal(void *decoder, int16_t *samples)
{
    vc_parametric_conceal(decoder, samples);
}

const vc_codec vc_parametric_codec = {11, "parametric", 0, NULL, check, init, decode, conceal};
