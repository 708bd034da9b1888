/* Rotations as products of Givens rotations, and delay lines; see vc_mdct_rotation.h. */
#include "vc_mdct_rotation.h"

#define DELAY_BITS 6u
#define STATE_BITS 2u
#define ANGLE_BITS 6u
#define ONE (1 << 24)

enum state { IDENTITY, COMMON, OWN };

/* Bits from the highest of each byte on. */
typedef struct {
    const uint8_t *bytes;
    size_t position;
} bit_reader;

static unsigned take(bit_reader *reader, unsigned count)
{
    unsigned value = 0;
    for (; count > 0; count--, reader->position++)
        value = value << 1 | (reader->bytes[reader->position / 8] >> (7 - reader->position % 8) & 1u);
    return value;
}

size_t vc_rotation_check(const uint8_t *section, size_t length, unsigned channels, uint32_t *longest)
{
    const unsigned head_bits = DELAY_BITS * channels + STATE_BITS * VC_ROTATION_BANDS;
    const unsigned matrix_bits = ANGLE_BITS * channels * (channels - 1) / 2;
    bit_reader reader;
    unsigned matrices = 0, common = 0, shortest = VC_MAX_DELAY, i;
    size_t bits;
    reader.bytes = section;
    reader.position = 0;
    *longest = 0;
    if (channels < 2 || 8 * length < head_bits)
        return 0;
    for (i = 0; i < channels; i++) {
        const unsigned delay = take(&reader, DELAY_BITS);
        shortest = delay < shortest ? delay : shortest;
        *longest = delay > *longest ? delay : *longest;
    }
    for (i = 0; i < VC_ROTATION_BANDS; i++) {
        const unsigned state = take(&reader, STATE_BITS);
        if (state > OWN)
            return 0;
        common |= state == COMMON;
        matrices += state == OWN;
    }
    matrices += common;
    bits = head_bits + (size_t)matrices * matrix_bits;
    if (matrices == 0 || shortest > 0 || 8 * length < bits)
        return 0;
    reader.position = bits;
    return take(&reader, (unsigned)(-bits & 7u)) == 0 ? (bits + 7) / 8 : 0;
}

/* Multiplies the first `channels` rows and columns of the identity by the next rotations, one for each pair. */
static void read_matrix(bit_reader *reader, unsigned channels, int32_t (*matrix)[VC_MAX_CHANNELS])
{
    unsigned first, second, row;
    for (first = 0; first + 1 < channels; first++)
        for (second = first + 1; second < channels; second++) {
            const unsigned angle = 8 * take(reader, ANGLE_BITS); /* in 1/1024 of a turn */
            const int32_t cosine = vc_cosine[angle], sine = vc_cosine[(angle + 768) & 1023u];
            for (row = 0; row < channels; row++) {
                const int64_t a = matrix[row][first], b = matrix[row][second];
                matrix[row][first] = (int32_t)vc_rounded(a * cosine - b * sine);
                matrix[row][second] = (int32_t)vc_rounded(a * sine + b * cosine);
            }
        }
}

/* The step of a channel relative to that of the coded channels, in 1/2^24, without its octaves, which become `octaves`.
 */
static int32_t relative_step(const vc_mdct_configuration *configuration, unsigned channel, uint8_t *octaves)
{
    const unsigned code = configuration->step_code[channel];
    const unsigned finest = configuration->step_code[configuration->finest];
    *octaves = (uint8_t)((code >> 6) - (finest >> 6));
    return (int32_t)(((64 + (code & 63u)) << 24) / (64 + (finest & 63u)));
}

void vc_rotation_init(vc_rotation *rotation, const vc_mdct_configuration *configuration, const uint8_t *section)
{
    const unsigned channels = configuration->channels;
    bit_reader reader, common;
    unsigned states[VC_ROTATION_BANDS], any_common = 0, band, row, column;
    memset(rotation, 0, sizeof *rotation);
    reader.bytes = section;
    reader.position = 0;
    for (row = 0; row < channels; row++)
        rotation->delay[row] = (uint8_t)take(&reader, DELAY_BITS);
    for (band = 0; band < VC_ROTATION_BANDS; band++) {
        states[band] = take(&reader, STATE_BITS);
        any_common |= states[band] == COMMON;
    }
    common = reader;
    if (any_common)
        reader.position += ANGLE_BITS * channels * (channels - 1) / 2;
    for (band = 0; band < VC_ROTATION_BANDS; band++) {
        int32_t (*matrix)[VC_MAX_CHANNELS] = rotation->weight[band];
        bit_reader shared = common;
        rotation->mixes[band] = states[band] != IDENTITY;
        for (row = 0; row < channels; row++)
            matrix[row][row] = ONE;
        if (rotation->mixes[band])
            read_matrix(states[band] == COMMON ? &shared : &reader, channels, matrix);
        for (row = 0; row < channels; row++) {
            const int32_t step = relative_step(configuration, row, &rotation->octaves[row]);
            for (column = 0; column < channels; column++)
                matrix[row][column] = (int32_t)vc_rounded((int64_t)matrix[row][column] * step);
        }
    }
}

void vc_rotate(const vc_rotation *rotation, const int32_t *coded, size_t stride, unsigned channels, uint32_t hop,
               unsigned channel, int32_t *spectrum)
{
    static const uint8_t ends[VC_ROTATION_BANDS] = {4, 12, 28, 64}; /* of the bands, at a hop of 64 */
    uint32_t k = 0;
    unsigned band, column;
    for (band = 0; band < VC_ROTATION_BANDS; band++) {
        const int32_t *const weights = rotation->weight[band][channel];
        const uint32_t end = ends[band] * hop / 64;
        const unsigned first = rotation->mixes[band] ? 0 : channel;
        const unsigned last = rotation->mixes[band] ? channels - 1 : channel;
        for (; k < end; k++) {
            int64_t sum = 0;
            for (column = first; column <= last; column++)
                sum += (int64_t)weights[column] * coded[column * stride + k];
            spectrum[k] = vc_clamped(vc_limited(vc_rounded(sum) * ((int64_t)1 << rotation->octaves[channel])),
                                     VC_MAX_COEFFICIENT);
        }
    }
}

void vc_delay(vc_rotation *rotation, unsigned channel, int16_t *samples, uint32_t count, unsigned stride)
{
    const unsigned delay = rotation->delay[channel];
    unsigned next = rotation->next[channel];
    for (; delay > 0 && count > 0; count--, samples += stride) {
        const int16_t oldest = rotation->line[channel][next];
        rotation->line[channel][next] = *samples;
        *samples = oldest;
        next = next + 1 < delay ? next + 1 : 0;
    }
    rotation->next[channel] = (uint8_t)next;
}
