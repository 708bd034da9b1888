/* Decoder of `mdct`: packets to levels, levels to samples by fixed-point inverse MDCT, fades where packets miss. */
#include "decoder_memory.h"

#define FADE_BLOCKS 8u /* longest time that concealment sounds */

size_t vc_mdct_decoder_size(void)
{
    return sizeof(vc_mdct_decoder);
}

int vc_configuration_read(vc_mdct_configuration *configuration, const uint8_t *bytes, size_t length, unsigned channels)
{
    vc_mdct_configuration read;
    uint32_t head;
    size_t used;
    unsigned channel;
    if (channels < 1 || channels > VC_MAX_CHANNELS || length < 1)
        return VC_BAD_CONFIGURATION;
    head = bytes[0];
    used = 1;
    if (head & 0x80u) {
        if (length < 2 || (bytes[1] & 0x80u))
            return VC_BAD_CONFIGURATION;
        head = (head & 0x7Fu) | (uint32_t)bytes[1] << 7;
        used = 2;
    }
    if (head >> 2 < 1 || head >> 2 > VC_MAX_PACKET_BLOCKS || length != used + 2 * channels)
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    read.hop = 16u << (head & 3u);
    read.packet_blocks = head >> 2;
    read.channels = channels;
    for (channel = 0; channel < channels; channel++) {
        uint32_t code = bytes[used + 2 * channel] | (uint32_t)bytes[used + 2 * channel + 1] << 8;
        uint32_t fill = code >> VC_STEP_CODE_BITS;
        code &= (1u << VC_STEP_CODE_BITS) - 1;
        if (code >= VC_STEP_CODES)
            return VC_BAD_CONFIGURATION;
        read.step[channel] = vc_step_of(code);
        read.fill[channel] = (int32_t)((int64_t)read.step[channel] * fill / 128);
    }
    *configuration = read;
    return VC_OK;
}

int vc_mdct_decoder_init(vc_mdct_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                         unsigned channels, const uint8_t *tables, size_t tables_length)
{
    int status;
    memset(decoder, 0, sizeof *decoder);
    decoder->tables = tables == NULL ? vc_builtin_tables : tables;
    status = vc_model_check_tables(tables, tables_length);
    if (status != VC_OK)
        return status;
    decoder->model.network = vc_model_network(tables, tables_length);
    return vc_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
}

uint32_t vc_mdct_decoder_packet_samples(const vc_mdct_decoder *decoder)
{
    return decoder->configuration.packet_blocks * decoder->configuration.hop;
}

uint32_t vc_mdct_decoder_delay_samples(const vc_mdct_decoder *decoder)
{
    return decoder->configuration.hop;
}

/* A coefficient that is not 0, and 2 k + 1. */
typedef struct {
    int32_t value;
    uint32_t frequency;
} spectral_line;

/* sum_k X[k] cos(angle (2 k + 1)), in 1/2^24, and the same a quarter of a turn later; angles in 1/1024 of a turn. By
 * itself, so that all of the loop stays in registers. */
__attribute__((noinline)) static void cosine_sums(const spectral_line *lines, uint32_t count, uint32_t angle,
                                                  int64_t *sums)
{
    const spectral_line *const end = lines + count;
    int64_t first = 0, second = 0;
    for (; lines != end; lines++) {
        const uint32_t turned = angle * lines->frequency;
        first += (int64_t)lines->value * vc_cosine[turned & 1023u];
        second += (int64_t)lines->value * vc_cosine[(turned + 256 * lines->frequency) & 1023u];
    }
    sums[0] = first;
    sums[1] = second;
}

/* sqrt(2 / N) in 1/2^24. */
static int32_t norm(uint32_t hop)
{
    return hop == 16 ? 5931642 : hop == 32 ? 4194304 : hop == 64 ? 2965821 : 2097152;
}

/* sin(pi (n + 1/2) / (2 N)) in 1/2^24, 0 <= n < N: the rising half of the sine window. */
static int32_t window(uint32_t hop, uint32_t n)
{
    return vc_cosine[((2 * n + 1) * (128 / hop) + 768) & 1023u];
}

/* Writes the next hop samples of a channel, `stride` apart: inverse MDCT of its spectrum,
 * sqrt(2 / N) sum_k X[k] cos(pi / N (n + 1/2 + N/2) (k + 1/2)), windowed and overlap-added (Princen, Johnson and
 * Bradley 1987). The first half of the transform's output is odd about its middle, the second half even. */
static void synthesise(vc_mdct_channel *channel, uint32_t hop, int16_t *samples, unsigned stride)
{
    spectral_line lines[VC_MAX_BINS];
    uint32_t count = 0, k, n;
    for (k = 0; k < hop; k++)
        if (channel->spectrum[k] != 0) {
            lines[count].value = channel->spectrum[k];
            lines[count++].frequency = 2 * k + 1;
        }
    for (n = 0; n < hop / 2; n++) {
        const uint32_t mirror = hop - 1 - n;
        const int32_t rising = window(hop, n), falling = window(hop, mirror);
        int64_t sums[2]; /* of samples n and N + n */
        int32_t first, second;
        cosine_sums(lines, count, (2 * n + 1 + hop) * (128 / hop), sums); /* N divides 128 */
        first = vc_weighted(vc_scaled_down(sums[0]), norm(hop));
        second = vc_weighted(vc_scaled_down(sums[1]), norm(hop));
        samples[n * stride] = vc_rounded_sample((int64_t)channel->overlap[n] + vc_weighted(first, rising));
        samples[mirror * stride] = vc_rounded_sample((int64_t)channel->overlap[mirror] - vc_weighted(first, falling));
        channel->overlap[n] = vc_weighted(second, falling);
        channel->overlap[mirror] = vc_weighted(second, rising);
    }
}

/* Pseudo-random sign from a linear congruential generator (Numerical Recipes' constants). */
static int32_t random_sign(vc_mdct_decoder *decoder)
{
    decoder->random = decoder->random * 1664525u + 1013904223u;
    return decoder->random >> 31 ? -1 : 1;
}

static void decode_block(vc_mdct_decoder *decoder, vc_range_coder *coder, unsigned number)
{
    const uint32_t hop = decoder->configuration.hop;
    const int32_t step = decoder->configuration.step[number];
    vc_mdct_channel *channel = &decoder->channels[number];
    int32_t fill;
    uint32_t k;
    vc_block_decode(coder, &decoder->model, &channel->block, hop, channel->spectrum);
    fill = channel->block.history.silent_history & 1 ? 0 : decoder->configuration.fill[number];
    for (k = 0; k < hop; k++)
        channel->spectrum[k] =
            channel->spectrum[k] == 0 ? fill * random_sign(decoder) : vc_reconstruct(channel->spectrum[k], step);
}

int vc_mdct_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    const vc_mdct_configuration *configuration = &decoder->configuration;
    vc_range_coder coder;
    uint32_t sequence, block;
    int refresh;
    unsigned channel;
    size_t head = vc_packet_head_read(packet, length, &sequence, &refresh);
    if (head == 0)
        return VC_BAD_PACKET;
    if (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence)) {
        vc_mdct_conceal(decoder, samples);
        return VC_CONCEALED;
    }
    if (refresh)
        vc_model_reset(&decoder->model, decoder->tables);
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_block_reset(&decoder->channels[channel].block);
    decoder->in_sequence = 1;
    decoder->next_sequence = sequence + 1;
    decoder->random = sequence; /* so that a decoder that begins here fills alike */
    vc_range_decoder_init(&coder, packet + head, length - head);
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++) {
            decode_block(decoder, &coder, channel);
            synthesise(&decoder->channels[channel], configuration->hop, samples + channel, configuration->channels);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->hop * configuration->channels;
        }
    return VC_OK;
}

void vc_mdct_conceal(vc_mdct_decoder *decoder, int16_t *samples)
{
    const vc_mdct_configuration *configuration = &decoder->configuration;
    const uint32_t fade = configuration->packet_blocks < FADE_BLOCKS ? configuration->packet_blocks : FADE_BLOCKS;
    uint32_t block, k;
    unsigned channel;
    decoder->in_sequence = 0;
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++) {
            vc_mdct_channel *state = &decoder->channels[channel];
            /* Each block repeats the last spectrum with random signs, scaled so that it ramps to zero. */
            for (k = 0; k < configuration->hop; k++)
                state->spectrum[k] = block < fade ? state->spectrum[k] / (int32_t)(fade - block) *
                                                        (int32_t)(fade - block - 1) * random_sign(decoder)
                                                  : 0;
            synthesise(state, configuration->hop, samples + channel, configuration->channels);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->hop * configuration->channels;
        }
}
