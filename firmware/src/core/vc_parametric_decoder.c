/* Decoder of `parametric`: packets to a description; from it, noise with its band levels by an inverse MDCT, and ridges
 * by oscillators; fades at missing packets. */
#include "vc_codec.h"
#include "vc_decoder_memory.h"
#include "vc_mdct_synthesis.h"

#define FADE_BLOCKS 8u /* longest time that concealment sounds */
#define CYCLES 1560u   /* for a sample of a channel, a tenth more than found; docs/benchmarks/firmware.md */

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

int vc_parametric_feed(vc_parametric_decoder *decoder, const uint8_t *packet, size_t length)
{
    uint32_t sequence;
    int refresh;
    unsigned channel;
    const size_t head = packet == NULL ? 0 : vc_packet_head_read(packet, length, &sequence, &refresh);
    if (packet != NULL && head == 0)
        return VC_BAD_PACKET;
    decoder->block = 0;
    decoder->concealing = packet == NULL || (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence));
    decoder->in_sequence = !decoder->concealing;
    if (decoder->concealing)
        return VC_CONCEALED;
    if (refresh)
        vc_parametric_model_reset(&decoder->model);
    for (channel = 0; channel < decoder->configuration.channels && refresh; channel++)
        vc_parametric_channel_reset(&decoder->channels[channel]);
    decoder->refresh = refresh;
    decoder->next_sequence = sequence + 1;
    decoder->random = sequence; /* so that a decoder that begins here draws the same numbers */
    vc_range_decoder_init(&decoder->coder, packet + head, length - head);
    return VC_OK;
}

/* Reads the next frame of every channel. Each channel draws its random signs where the one before has drawn all those
 * of its frame, as if the frames were put out one after the other. */
static void read_frames(vc_parametric_decoder *decoder)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    const uint32_t drawn =
        (configuration->edges[configuration->bands] - configuration->edges[0]) * configuration->frame_blocks;
    unsigned channel;
    for (channel = 0; channel < configuration->channels; channel++) {
        vc_parametric_synthesis *synthesis = &decoder->synthesis[channel];
        memset(&synthesis->frame, 0, sizeof synthesis->frame);
        vc_parametric_code_frame(&decoder->coder, 0, &decoder->model, &decoder->channels[channel], configuration,
                                 decoder->refresh && decoder->block == 0, &synthesis->frame);
        if (synthesis->frame.pitch >= 0)
            synthesis->turn = vc_parametric_turn(synthesis->frame.pitch);
        synthesis->random = decoder->random;
        vc_random_skip(&decoder->random, drawn);
    }
}

/* Puts out the next block of a channel's frame. */
static void play_block(vc_parametric_decoder *decoder, unsigned channel, int16_t *samples)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    vc_parametric_synthesis *synthesis = &decoder->synthesis[channel];
    const vc_parametric_frame *frame = &synthesis->frame;
    const uint32_t block = decoder->block % configuration->frame_blocks;
    const int32_t time = frame->times[block / configuration->level_blocks];
    int32_t target[VC_PARAMETRIC_MAX_HARMONICS];
    uint32_t k;
    unsigned i;
    for (i = 0; i < VC_PARAMETRIC_MAX_HARMONICS; i++)
        target[i] = amplitude(configuration, frame->harmonics[i], time);
    for (i = 0; i < configuration->bands; i++) {
        const int32_t magnitude = amplitude(configuration, frame->bands[i], time);
        for (k = configuration->edges[i]; k < configuration->edges[i + 1]; k++)
            synthesis->spectrum[k] = magnitude * vc_random_sign(&synthesis->random);
    }
    add_ridges(synthesis, &decoder->channels[channel].phase, configuration->hop, target);
    vc_mdct_synthesise(synthesis->spectrum, synthesis->overlap, configuration->hop, samples, configuration->channels);
}

/* Returns the next value of a ramp to zero that has `left` steps left. */
static int32_t faded(int32_t value, uint32_t left)
{
    return left > 1 ? value / (int32_t)left * (int32_t)(left - 1) : 0;
}

/* Repeats the last block of a channel with random signs, scaled so that the blocks of a packet ramp to zero. */
static void conceal_block(vc_parametric_decoder *decoder, unsigned channel, int16_t *samples)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    const uint32_t blocks = configuration->packet_frames * configuration->frame_blocks;
    const uint32_t fade = blocks < FADE_BLOCKS ? blocks : FADE_BLOCKS;
    const uint32_t left = decoder->block < fade ? fade - decoder->block : 0;
    vc_parametric_synthesis *synthesis = &decoder->synthesis[channel];
    int32_t target[VC_PARAMETRIC_MAX_HARMONICS];
    uint32_t k;
    unsigned i;
    for (i = 0; i < VC_PARAMETRIC_MAX_HARMONICS; i++)
        target[i] = faded(synthesis->amplitudes[i], left);
    for (k = 0; k < configuration->hop; k++)
        synthesis->spectrum[k] = faded(synthesis->spectrum[k], left) * vc_random_sign(&decoder->random);
    add_ridges(synthesis, &decoder->channels[channel].phase, configuration->hop, target);
    vc_mdct_synthesise(synthesis->spectrum, synthesis->overlap, configuration->hop, samples, configuration->channels);
}

uint32_t vc_parametric_poll(vc_parametric_decoder *decoder, int16_t *samples)
{
    const vc_parametric_configuration *configuration = &decoder->configuration;
    const unsigned channels = configuration->channels;
    unsigned channel;
    samples += (size_t)decoder->block * configuration->hop * channels;
    if (!decoder->concealing && decoder->block % configuration->frame_blocks == 0)
        read_frames(decoder);
    for (channel = 0; channel < channels; channel++)
        if (decoder->concealing)
            conceal_block(decoder, channel, samples + channel);
        else
            play_block(decoder, channel, samples + channel);
    return ++decoder->block * configuration->hop;
}

int vc_parametric_decode(vc_parametric_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_codec_decode(&vc_parametric_codec, decoder, vc_parametric_decoder_packet_samples(decoder), packet, length,
                           samples);
}

static int check(vc_coding *coding)
{
    vc_parametric_configuration read;
    const int status =
        vc_parametric_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_frames * vc_parametric_frame_samples(&read);
        coding->delay_samples = read.hop;
        coding->cycles_per_sample = coding->channels * CYCLES;
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_parametric_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels);
}

static int feed(void *decoder, const uint8_t *packet, size_t length)
{
    return vc_parametric_feed(decoder, packet, length);
}

static uint32_t poll(void *decoder, int16_t *samples)
{
    return vc_parametric_poll(decoder, samples);
}

const vc_codec vc_parametric_codec = {11,   "parametric", sizeof(struct vc_parametric_decoder), 0, NULL, check, init,
                                      feed, poll};
