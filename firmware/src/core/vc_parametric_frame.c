/* Configuration and syntax of a frame of `parametric`; see vc_parametric_frame.h. */
#include "vc_parametric_frame.h"

#define ADAPTATION 4u
#define FIRST_OCTAVE 12          /* expected level of the very first band: 1/32 of full scale */
#define LARGEST_DIFFERENCE 1024u /* of two numbers; more than the range of levels */

int vc_parametric_configuration_read(vc_parametric_configuration *configuration, const uint8_t *bytes, size_t length,
                                     unsigned channels)
{
    vc_parametric_configuration read;
    unsigned spacing;
    uint32_t edge = 0;
    if (channels < 1 || channels > VC_MAX_CHANNELS || length != 5 || bytes[0] > 63 || (bytes[1] >> 4) > 6 ||
        (bytes[1] & 15u) > VC_PARAMETRIC_MAX_HARMONICS || bytes[2] > bytes[1] >> 4)
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    read.hop = 16u << (bytes[0] & 3u);
    spacing = bytes[0] >> 2 & 3u;
    read.level_bits = bytes[0] >> 4;
    read.harmonics = bytes[1] & 15u;
    read.frame_blocks = 1u << (bytes[1] >> 4);
    read.level_blocks = 1u << bytes[2];
    read.packet_frames = bytes[3] | (uint32_t)bytes[4] << 8;
    read.channels = channels;
    if (read.packet_frames < 1 || read.packet_frames > VC_PARAMETRIC_MAX_PACKET_FRAMES ||
        read.packet_frames > VC_PARAMETRIC_MAX_PACKET_SAMPLES / vc_parametric_frame_samples(&read))
        return VC_BAD_CONFIGURATION;
    while (edge < read.hop) {
        read.edges[read.bands++] = (uint8_t)edge;
        edge += edge >> spacing > 1 ? edge >> spacing : 1;
        if (edge < read.hop && 2 * (read.hop - edge) < edge >> spacing)
            edge = read.hop; /* the remaining bins belong to the last band */
    }
    read.edges[read.bands] = (uint8_t)read.hop;
    *configuration = read;
    return VC_OK;
}

void vc_parametric_model_reset(vc_parametric_model *model)
{
    unsigned kind, context, i;
    for (i = 0; i < 2; i++) {
        model->silent[i] = VC_UNTRAINED / 4;
        model->ridges[i] = VC_UNTRAINED;
    }
    for (kind = 0; kind < VC_PARAMETRIC_KINDS; kind++) {
        model->negative[kind] = VC_UNTRAINED;
        for (context = 0; context < VC_PARAMETRIC_CONTEXTS; context++)
            for (i = 0; i < VC_PARAMETRIC_ABOVE; i++)
                model->above[kind][context][i] = VC_UNTRAINED;
    }
}

void vc_parametric_channel_reset(vc_parametric_channel *channel)
{
    channel->silent = channel->known = 0;
    channel->frame.pitch = -1;
}

static int coded(vc_range_coder *coder, int encoding, int bit, uint16_t *probability)
{
    return vc_adaptive_code(coder, encoding, bit, probability, ADAPTATION);
}

static int32_t within(int32_t value, int32_t least, int32_t greatest)
{
    return value < least ? least : value > greatest ? greatest : value;
}

/* The coder of a frame's numbers. */
typedef struct {
    vc_range_coder *coder;
    int encoding;
    vc_parametric_model *model;
    unsigned context; /* magnitude of the last difference, at most 2 */
} number_coder;

/* Codes a number of a kind, from `least` to `greatest`, as its difference from the expected value. */
static int16_t code_number(number_coder *with, unsigned kind, int32_t expected, int32_t least, int32_t greatest,
                           int32_t number)
{
    uint16_t *above = with->model->above[kind][with->context];
    const int32_t difference = with->encoding ? within(number, least, greatest) - expected : 0;
    const uint32_t wanted = (uint32_t)(difference < 0 ? -difference : difference);
    uint32_t magnitude = 0;
    int negative = 0;
    while (magnitude < VC_PARAMETRIC_ABOVE && coded(with->coder, with->encoding, wanted > magnitude, &above[magnitude]))
        magnitude++;
    if (magnitude == VC_PARAMETRIC_ABOVE) {
        if (with->encoding) {
            vc_golomb_encode(with->coder, wanted - VC_PARAMETRIC_ABOVE);
            magnitude = wanted;
        } else {
            magnitude += vc_golomb_decode(with->coder);
        }
    }
    if (magnitude > 0)
        negative = coded(with->coder, with->encoding, difference < 0, &with->model->negative[kind]);
    with->context = magnitude < 2 ? magnitude : 2;
    if (magnitude > LARGEST_DIFFERENCE)
        magnitude = LARGEST_DIFFERENCE;
    return (int16_t)within(expected + (negative ? -(int32_t)magnitude : (int32_t)magnitude), least, greatest);
}

/* Codes bits with even odds, the highest first. */
static uint32_t code_bits(const number_coder *with, unsigned bits, uint32_t value)
{
    uint32_t coded_value = 0;
    while (bits-- > 0) {
        int bit = (int)(value >> bits & 1u);
        if (with->encoding)
            vc_range_encode(with->coder, bit, VC_EVEN_ODDS);
        else
            bit = (int)vc_range_decode_bits(with->coder, 1);
        coded_value = coded_value << 1 | (uint32_t)bit;
    }
    return coded_value;
}

static void code_bands(number_coder *with, const vc_parametric_configuration *configuration,
                       const vc_parametric_channel *channel, vc_parametric_frame *frame)
{
    const int32_t levels = vc_parametric_levels(configuration);
    const int16_t *last = channel->frame.bands;
    int16_t *bands = frame->bands;
    unsigned band;
    for (band = 0; band < configuration->bands; band++) {
        const int32_t below = band > 0 ? bands[band - 1] : FIRST_OCTAVE << configuration->level_bits;
        const int32_t change = band > 0 ? bands[band - 1] - last[band - 1] : 0;
        bands[band] = channel->known
                          ? code_number(with, VC_PARAMETRIC_BAND, last[band] + change / 2, 0, levels, bands[band])
                          : code_number(with, VC_PARAMETRIC_FIRST_BAND, below, 0, levels, bands[band]);
    }
}

static void code_times(number_coder *with, const vc_parametric_configuration *configuration, vc_parametric_frame *frame)
{
    const uint32_t times = configuration->frame_blocks / configuration->level_blocks;
    const int32_t levels = vc_parametric_levels(configuration);
    uint32_t i;
    frame->times[0] = times > 1 ? frame->times[0] : 0;
    for (i = 0; i < times && times > 1; i++)
        frame->times[i] = code_number(with, VC_PARAMETRIC_TIME, i > 0 ? frame->times[i - 1] / 2 : 0, -levels, levels,
                                      frame->times[i]);
}

static void code_ridges(number_coder *with, const vc_parametric_configuration *configuration, int refresh,
                        vc_parametric_channel *channel, vc_parametric_frame *frame)
{
    const int continued = channel->frame.pitch >= 0;
    const int32_t levels = vc_parametric_levels(configuration);
    unsigned i;
    if (!coded(with->coder, with->encoding, frame->pitch >= 0, &with->model->ridges[continued])) {
        frame->pitch = -1;
        return;
    }
    if (continued)
        frame->pitch =
            code_number(with, VC_PARAMETRIC_PITCH, channel->frame.pitch, 0, VC_PARAMETRIC_PITCHES - 1, frame->pitch);
    else
        frame->pitch = (int16_t)code_bits(with, 9, (uint32_t)within(frame->pitch, 0, VC_PARAMETRIC_PITCHES - 1));
    if (refresh)
        channel->phase = code_bits(with, 8, channel->phase >> 24) << 24;
    else if (!continued)
        channel->phase = 0;
    for (i = 0; i < configuration->harmonics; i++) {
        const int32_t below = i > 0 ? frame->harmonics[i - 1] : FIRST_OCTAVE << configuration->level_bits;
        if ((i + 1) * (uint64_t)vc_parametric_turn(frame->pitch) >= 1ull << 31)
            frame->harmonics[i] = 0; /* beyond half the sampling rate */
        else
            frame->harmonics[i] =
                continued ? code_number(with, VC_PARAMETRIC_HARMONIC, channel->frame.harmonics[i], 0, levels,
                                        frame->harmonics[i])
                          : code_number(with, VC_PARAMETRIC_FIRST_HARMONIC, below, 0, levels, frame->harmonics[i]);
    }
}

void vc_parametric_code_frame(vc_range_coder *coder, int encoding, vc_parametric_model *model,
                              vc_parametric_channel *channel, const vc_parametric_configuration *configuration,
                              int refresh, vc_parametric_frame *frame)
{
    number_coder with = {coder, encoding, model, 0};
    int silent = frame->pitch < 0;
    unsigned band;
    for (band = 0; band < configuration->bands && silent; band++)
        silent = frame->bands[band] <= 0;
    channel->silent = coded(coder, encoding, silent, &model->silent[channel->silent]);
    if (channel->silent) {
        memset(frame, 0, sizeof *frame);
        frame->pitch = channel->frame.pitch = -1;
        return;
    }
    code_bands(&with, configuration, channel, frame);
    code_times(&with, configuration, frame);
    if (configuration->harmonics > 0)
        code_ridges(&with, configuration, refresh, channel, frame);
    else
        frame->pitch = -1;
    channel->known = 1;
    channel->frame = *frame;
}
