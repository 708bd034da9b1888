/* Decoder of `dct`: packets to coded values, values to levels, levels to samples by a fixed-point inverse DCT. */
#include "vc_codec.h"
#include "vc_decoder_memory.h"

#define MAX_PACKET_BLOCKS 4095u
#define MAX_PACKET_SAMPLES (1u << 18)
#define WHOLE 7u /* in place of a block's size: a packet is one transform */
#define LOGARITHMIC 0x08u
#define LINEAR 0x20u    /* absent from older streams, whose linear levels were others */
#define FIRST_CLASS 16u /* symbols from here on stand for classes of values, eight an octave */
#define ONE (1 << 24)
/* For a sample of a channel, the longest block and a tenth more; docs/benchmarks/firmware.md. */
#define CYCLES 1600u
#define POLLED_BINS 128u      /* most that a poll decodes */
#define ROOT_OF_HALF 11863283 /* sqrt(1 / 2) in 1/2^24 */

size_t vc_dct_decoder_size(void)
{
    return sizeof(vc_dct_decoder);
}

static uint32_t number_at(const uint8_t *bytes)
{
    return bytes[0] | (uint32_t)bytes[1] << 8;
}

int vc_dct_configuration_read(vc_dct_configuration *configuration, const uint8_t *bytes, size_t length,
                              unsigned channels)
{
    vc_dct_configuration read;
    unsigned channel, size, spacing;
    if (channels < 1 || channels > VC_MAX_CHANNELS || length < 9)
        return VC_BAD_CONFIGURATION;
    size = bytes[0] & 7u;
    spacing = bytes[0] & (LOGARITHMIC | LINEAR);
    if (bytes[0] > 63 || (size > 4 && size != WHOLE) || (spacing != LOGARITHMIC && spacing != LINEAR))
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    read.channels = channels;
    read.whole = size == WHOLE;
    read.block = read.whole ? number_at(bytes + 1) : 64u << size;
    read.packet_blocks = read.whole ? 1 : number_at(bytes + 1);
    read.logarithmic = spacing == LOGARITHMIC;
    read.range_coded = bytes[0] >> 4 & 1;
    read.levels = number_at(bytes + 3);
    read.first = number_at(bytes + 5);
    read.end = number_at(bytes + 7);
    if (read.packet_blocks < 1 || read.packet_blocks > MAX_PACKET_BLOCKS ||
        read.packet_blocks * read.block > MAX_PACKET_SAMPLES || (read.levels > 0 && read.levels < VC_DCT_MIN_LEVELS) ||
        read.block < VC_DCT_FADE_SAMPLES || read.first >= read.end || read.end > read.block ||
        read.end > VC_DCT_MAX_BLOCK || length != 9u + (read.logarithmic ? 2 * channels : 0))
        return VC_BAD_CONFIGURATION;
    for (channel = 0; channel < channels && read.logarithmic; channel++)
        read.smallest[channel] = number_at(bytes + 9 + 2 * channel);
    *configuration = read;
    return VC_OK;
}

int vc_dct_decoder_init(vc_dct_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels)
{
    memset(decoder, 0, sizeof *decoder);
    return vc_dct_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
}

uint32_t vc_dct_decoder_packet_samples(const vc_dct_decoder *decoder)
{
    return decoder->configuration.packet_blocks * decoder->configuration.block;
}

/* cos(2 pi angle / (4 VC_DCT_MAX_BLOCK)) in 1/2^24 from a quarter of a turn. */
static int32_t cosine(uint32_t angle)
{
    angle &= 4 * VC_DCT_MAX_BLOCK - 1;
    if (angle > 2 * VC_DCT_MAX_BLOCK)
        angle = 4 * VC_DCT_MAX_BLOCK - angle;
    return angle > VC_DCT_MAX_BLOCK ? -vc_dct_cosine[2 * VC_DCT_MAX_BLOCK - angle] : vc_dct_cosine[angle];
}

static int32_t sine(uint32_t angle)
{
    return cosine(angle + 3 * VC_DCT_MAX_BLOCK);
}

static uint32_t reversed(uint32_t index, uint32_t count)
{
    uint32_t result = 0;
    for (; count > 1; count >>= 1, index >>= 1)
        result = result << 1 | (index & 1u);
    return result;
}

/* Writes one block of samples, `stride` apart: the inverse of the orthonormal DCT-II, by a complex Fourier transform of
 * the same length (Makhoul, "A fast cosine transform in one and two dimensions", 1980). */
static void inverse_dct(vc_dct_decoder *decoder, int16_t *samples, unsigned stride)
{
    const uint32_t count = decoder->configuration.block, unit = VC_DCT_MAX_BLOCK / count;
    const unsigned octaves = vc_floor_log2(count);
    /* sqrt(1 / count) and sqrt(1 / (2 count)) in 1/2^24: the weights of X[0] and the others. Inside they are 4 times as
     * large, so that rounding at every stage does not show. */
    const int64_t first_weight = (octaves & 1u ? ROOT_OF_HALF : ONE) * 4 >> octaves / 2;
    const int64_t weight = (octaves & 1u ? ONE / 2 : ROOT_OF_HALF) * 4 >> octaves / 2;
    int32_t *real = decoder->real, *imaginary = decoder->imaginary;
    uint32_t k, half, start, n;
    for (k = 0; k < count; k++) {
        /* (X[k] - i X[count - k]) exp(i pi k / (2 count)), X[count] = 0. */
        const int64_t even = decoder->spectrum[k], odd = k > 0 ? decoder->spectrum[count - k] : 0;
        const int64_t turn_real = cosine(k * unit), turn_imaginary = sine(k * unit);
        const uint32_t place = reversed(k, count);
        real[place] =
            vc_scaled_down((k > 0 ? weight : first_weight) * vc_scaled_down(even * turn_real + odd * turn_imaginary));
        imaginary[place] = vc_scaled_down(weight * vc_scaled_down(even * turn_imaginary - odd * turn_real));
    }
    for (half = 1; half < count; half *= 2)
        for (n = 0; n < half; n++) {
            const int64_t turn_real = cosine(n * (2 * VC_DCT_MAX_BLOCK / half));
            const int64_t turn_imaginary = sine(n * (2 * VC_DCT_MAX_BLOCK / half));
            for (start = n; start < count; start += 2 * half) {
                int32_t *a = real + start, *b = imaginary + start;
                const int64_t c = vc_scaled_down(turn_real * a[half] - turn_imaginary * b[half]);
                const int64_t d = vc_scaled_down(turn_real * b[half] + turn_imaginary * a[half]);
                a[half] = vc_limited(*a - c);
                b[half] = vc_limited(*b - d);
                *a = vc_limited(*a + c);
                *b = vc_limited(*b + d);
            }
        }
    for (n = 0; n < count; n++)
        samples[n * stride] = vc_rounded_sample(real[n & 1u ? count - 1 - n / 2 : n / 2] / 4);
}

static uint32_t read_bits(vc_bit_reader *reader, unsigned count)
{
    uint32_t bits = 0;
    while (count-- > 0) {
        const size_t byte = reader->position / 8;
        const unsigned shift = 7 - reader->position % 8;
        bits = bits << 1 | (byte < reader->length ? reader->bytes[byte] >> shift & 1u : 0u);
        reader->position++;
    }
    return bits;
}

/* Returns 0 unless the code is complete: every sequence of bits has a meaning. */
static int huffman_read(vc_huffman_code *code, vc_bit_reader *reader)
{
    uint8_t length_of[VC_HUFFMAN_SYMBOLS];
    uint32_t count = read_bits(reader, 7) + 1, symbol, used = 0, filled = 0;
    unsigned length;
    if (count > VC_HUFFMAN_SYMBOLS)
        return 0;
    for (symbol = 0; symbol < count; symbol++)
        length_of[symbol] = (uint8_t)read_bits(reader, 4);
    memset(code, 0, sizeof *code);
    for (length = 1; length <= VC_HUFFMAN_LONGEST_CODE; length++)
        for (symbol = 0; symbol < count; symbol++)
            if (length_of[symbol] == length) {
                code->lengths[length]++;
                code->symbols[used++] = (uint8_t)symbol;
                filled += 1u << (VC_HUFFMAN_LONGEST_CODE - length);
            }
    return filled == 1u << VC_HUFFMAN_LONGEST_CODE;
}

static uint32_t huffman_value(const vc_huffman_code *code, vc_bit_reader *reader)
{
    uint32_t bits = 0, first = 0, index = 0, symbol;
    unsigned length, octave;
    for (length = 1; length <= VC_HUFFMAN_LONGEST_CODE; length++) {
        bits = bits << 1 | read_bits(reader, 1);
        first <<= 1;
        if (bits - first < code->lengths[length])
            break;
        first += code->lengths[length];
        index += code->lengths[length];
    }
    symbol = code->symbols[index + bits - first];
    if (symbol < FIRST_CLASS)
        return symbol;
    octave = symbol / 8 + 2;
    return (8 + symbol % 8) << (octave - 3) | read_bits(reader, octave - 3);
}

static uint32_t decode_rank(vc_range_coder *coder, vc_dct_context context)
{
    uint32_t rank = 0;
    while (rank < VC_DCT_UNARY_LIMIT && vc_adaptive_decode(coder, &context.above[rank], VC_DCT_ADAPTATION))
        rank++;
    if (rank == VC_DCT_UNARY_LIMIT)
        rank += vc_golomb_decode(coder);
    if (rank > VC_DCT_MAX_LEVELS >> context.low_bits)
        rank = VC_DCT_MAX_LEVELS >> context.low_bits;
    return rank << context.low_bits | vc_range_decode_bits(coder, context.low_bits);
}

static uint32_t range_value(vc_range_coder *coder, vc_dct_model *model, uint32_t bin, uint32_t block,
                            uint32_t first_pair, uint32_t zeros)
{
    const vc_dct_context context = vc_dct_context_find(model, bin, block);
    const int zero = zeros && vc_adaptive_decode(coder, context.zero, VC_DCT_ADAPTATION);
    const uint32_t rank = zero ? context.expected : decode_rank(coder, context);
    vc_dct_model_set(model, bin, rank, zero);
    if (zero)
        return 0;
    return zeros + (rank < first_pair ? rank : 2 * rank - first_pair + vc_range_decode_bits(coder, 1));
}

/* Reads the fields before the values. Returns VC_OK or VC_BAD_PACKET. */
static int packet_open(vc_dct_packet *reader, vc_dct_decoder *decoder, const uint8_t *packet, size_t length)
{
    const vc_dct_configuration *configuration = &decoder->configuration;
    uint32_t sequence;
    int refresh, sounds = 0;
    size_t i, head = vc_packet_head_read(packet, length, &sequence, &refresh), start;
    if (head == 0 || !refresh)
        return VC_BAD_PACKET;
    memset(reader, 0, sizeof *reader);
    reader->levels = configuration->levels;
    if (reader->levels == 0) {
        if (length == head || packet[head] >= VC_DCT_LEVEL_CODES)
            return VC_BAD_PACKET;
        reader->levels = vc_dct_levels_of(packet[head++]);
    }
    start = head + 4 * (size_t)configuration->channels;
    if (length < start)
        return VC_BAD_PACKET;
    for (i = head; i < start; i++)
        sounds |= packet[i];
    reader->ranges = packet + head;
    reader->bits.bytes = packet + start;
    reader->bits.length = length - start;
    vc_range_decoder_init(&reader->range, packet + start, length - start);
    if (configuration->logarithmic)
        reader->zeros =
            configuration->range_coded ? vc_range_decode_bits(&reader->range, 1) : read_bits(&reader->bits, 1);
    if (sounds && !configuration->range_coded && !huffman_read(&reader->huffman, &reader->bits))
        return VC_BAD_PACKET;
    vc_dct_model_reset(&decoder->model);
    return VC_OK;
}

/* Moves to the next channel; returns 0 for a silent one, whose coefficients are all 0. */
static int channel_open(const vc_dct_packet *reader, vc_dct_decoder *decoder, unsigned channel,
                        vc_dct_quantiser *quantiser)
{
    const uint32_t below = number_at(reader->ranges + 4 * (size_t)channel);
    const uint32_t above = number_at(reader->ranges + 4 * (size_t)channel + 2);
    memset(decoder->spectrum, 0, sizeof decoder->spectrum);
    vc_dct_model_next_channel(&decoder->model);
    if (below == 0 && above == 0)
        return 0;
    vc_dct_quantiser_init(quantiser, decoder->configuration.logarithmic, reader->levels, reader->zeros,
                          decoder->configuration.smallest[channel], below, above);
    return 1;
}

/* The coefficients of a block that are coded. */
static uint32_t bins_of(const vc_dct_decoder *decoder)
{
    return decoder->configuration.end - decoder->configuration.first;
}

static void decode_bins(vc_dct_decoder *decoder, vc_dct_packet *reader, const vc_dct_quantiser *quantiser,
                        uint32_t block, uint32_t first, uint32_t end)
{
    const uint32_t first_pair = vc_dct_first_pair(decoder->configuration.logarithmic);
    uint32_t bin;
    for (bin = first; bin < end; bin++) {
        const uint32_t value = decoder->configuration.range_coded
                                   ? range_value(&reader->range, &decoder->model, bin, block, first_pair, reader->zeros)
                                   : huffman_value(&reader->huffman, &reader->bits);
        decoder->spectrum[decoder->configuration.first + bin] = vc_dct_level(quantiser, value);
    }
}

/* Rises from zero after a gap. `samples`: of the channel's first block. */
static void rise(const vc_dct_decoder *decoder, int16_t *samples)
{
    uint32_t n;
    for (n = 0; n < VC_DCT_FADE_SAMPLES; n++, samples += decoder->configuration.channels)
        *samples = (int16_t)(*samples * (int32_t)(n + 1) / (int32_t)VC_DCT_FADE_SAMPLES);
}

/* Keeps the samples that a later gap would fade. `samples`: of the channel's last block. */
static void keep_last(vc_dct_decoder *decoder, const int16_t *samples)
{
    uint32_t n;
    samples += (size_t)(decoder->configuration.block - VC_DCT_FADE_SAMPLES) * decoder->configuration.channels;
    for (n = 0; n < VC_DCT_FADE_SAMPLES; n++, samples += decoder->configuration.channels)
        decoder->last[decoder->channel][n] = *samples;
}

/* Writes a missing packet. */
static void conceal(vc_dct_decoder *decoder, int16_t *samples)
{
    const size_t values = (size_t)vc_dct_decoder_packet_samples(decoder) * decoder->configuration.channels;
    uint32_t n;
    unsigned channel;
    memset(samples, 0, values * sizeof *samples);
    /* A DCT-II continues after its block as its mirror image, so playing backwards makes no step. */
    for (n = 0; n < VC_DCT_FADE_SAMPLES; n++)
        for (channel = 0; channel < decoder->configuration.channels; channel++)
            samples[n * decoder->configuration.channels + channel] =
                (int16_t)(decoder->last[channel][VC_DCT_FADE_SAMPLES - 1 - n] * (int32_t)(VC_DCT_FADE_SAMPLES - 1 - n) /
                          (int32_t)VC_DCT_FADE_SAMPLES);
    memset(decoder->last, 0, sizeof decoder->last);
    decoder->rises = 1;
}

int vc_dct_feed(vc_dct_decoder *decoder, const uint8_t *packet, size_t length)
{
    if (decoder->configuration.whole)
        return VC_HOST_ONLY;
    if (packet != NULL && packet_open(&decoder->packet, decoder, packet, length) != VC_OK)
        return VC_BAD_PACKET;
    decoder->channel = decoder->block = decoder->bin = 0;
    decoder->concealing = packet == NULL;
    return decoder->concealing ? VC_CONCEALED : VC_OK;
}

/* Samples per channel that the last channel has, before the end of the packet. */
static uint32_t complete_samples(const vc_dct_decoder *decoder)
{
    return decoder->channel + 1 == decoder->configuration.channels ? decoder->block * decoder->configuration.block : 0;
}

uint32_t vc_dct_poll(vc_dct_decoder *decoder, int16_t *samples)
{
    const vc_dct_configuration *configuration = &decoder->configuration;
    const uint32_t packet_samples = vc_dct_decoder_packet_samples(decoder), bins = bins_of(decoder);
    const uint32_t first = decoder->bin;
    if (decoder->concealing) {
        conceal(decoder, samples);
        return packet_samples;
    }
    samples += (size_t)decoder->block * configuration->block * configuration->channels + decoder->channel;
    if (decoder->block == 0 && first == 0)
        decoder->sounds = channel_open(&decoder->packet, decoder, decoder->channel, &decoder->quantiser);
    if (decoder->sounds) {
        decoder->bin = bins - first > POLLED_BINS ? first + POLLED_BINS : bins;
        decode_bins(decoder, &decoder->packet, &decoder->quantiser, decoder->block, first, decoder->bin);
        if (decoder->bin < bins)
            return complete_samples(decoder);
        decoder->bin = 0;
    }
    inverse_dct(decoder, samples, configuration->channels);
    if (decoder->block == 0 && decoder->rises)
        rise(decoder, samples);
    if (++decoder->block == configuration->packet_blocks) {
        keep_last(decoder, samples);
        decoder->block = 0;
        decoder->channel++;
    }
    if (decoder->channel == configuration->channels) {
        decoder->rises = 0;
        return packet_samples;
    }
    return complete_samples(decoder);
}

int vc_dct_decode(vc_dct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_codec_decode(&vc_dct_codec, decoder, vc_dct_decoder_packet_samples(decoder), packet, length, samples);
}

int vc_dct_decode_whole(vc_dct_decoder *decoder, const uint8_t *packet, size_t length, int32_t *coefficients)
{
    const uint32_t first = decoder->configuration.first, bins = bins_of(decoder);
    vc_dct_packet reader;
    vc_dct_quantiser quantiser;
    unsigned channel;
    if (!decoder->configuration.whole)
        return VC_BAD_CONFIGURATION;
    if (packet_open(&reader, decoder, packet, length) != VC_OK)
        return VC_BAD_PACKET;
    for (channel = 0; channel < decoder->configuration.channels; channel++) {
        if (channel_open(&reader, decoder, channel, &quantiser))
            decode_bins(decoder, &reader, &quantiser, 0, 0, bins);
        memcpy(coefficients + (size_t)channel * bins, decoder->spectrum + first, bins * sizeof *coefficients);
    }
    return VC_OK;
}

static int check(vc_coding *coding)
{
    vc_dct_configuration read;
    const int status =
        vc_dct_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK && read.whole)
        return VC_HOST_ONLY;
    if (status == VC_OK) {
        coding->packet_samples = read.packet_blocks * read.block;
        coding->delay_samples = 0;
        coding->cycles_per_sample = coding->channels * CYCLES;
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_dct_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels);
}

static int feed(void *decoder, const uint8_t *packet, size_t length)
{
    return vc_dct_feed(decoder, packet, length);
}

static uint32_t poll(void *decoder, int16_t *samples)
{
    return vc_dct_poll(decoder, samples);
}

const vc_codec vc_dct_codec = {2, "dct", sizeof(struct vc_dct_decoder), 0, NULL, check, init, feed, poll};
