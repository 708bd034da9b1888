/* Reads EVA's models and configurations, and what they say of a quality; see eva_model.h. */
#include "eva_model.h"

#define HEAD_BYTES 10u
#define ADAPTS_FLAG 1u
#define NETWORK_FLAG 2u
#define FLAGS 7u
#define MAX_FRACTION_BITS 15u
#define MAX_SHIFT 30u
#define QUALITY_PARTS 16u
#define MIN_PROBABILITY 32u

/* What is left of the bytes of a model. */
typedef struct {
    const uint8_t *bytes;
    size_t length;
    int short_of; /* more was taken than there is */
} reader;

static const uint8_t *take(reader *from, size_t length)
{
    const uint8_t *taken = from->bytes;
    if (length > from->length) {
        from->short_of = 1;
        length = from->length;
    }
    from->bytes += length;
    from->length -= length;
    return taken;
}

static uint32_t number(const uint8_t *bytes)
{
    return bytes[0] | (uint32_t)bytes[1] << 8;
}

static int any_negative(const int8_t *weights, size_t count)
{
    int8_t all = 0;
    size_t i;
    for (i = 0; i < count; i++)
        all |= weights[i];
    return all < 0;
}

static int read_network(vc_eva_model *model, reader *from)
{
    static const uint8_t taps[VC_EVA_STAGES] = {5, 5, 9};
    unsigned stage;
    for (stage = 0; stage < VC_EVA_STAGES; stage++) {
        const size_t inputs = stage == 0 ? model->latents : model->width;
        const size_t outputs = stage == VC_EVA_STAGES - 1 ? 1 : model->width;
        vc_eva_normalisation *normalisation = &model->normalisations[stage];
        vc_eva_convolution *convolution = &model->convolutions[stage];
        const uint8_t *shift;
        normalisation->weights = (const int8_t *)take(from, inputs * inputs);
        normalisation->multipliers = take(from, 4 * inputs);
        normalisation->constants = take(from, 4 * inputs);
        shift = take(from, 1);
        convolution->weights = (const int8_t *)take(from, taps[stage] * outputs * inputs);
        convolution->multipliers = take(from, 4 * outputs);
        if (from->short_of || *shift > MAX_SHIFT || any_negative(normalisation->weights, inputs * inputs))
            return VC_BAD_TABLES;
        normalisation->shift = *shift;
    }
    return VC_OK;
}

int vc_eva_model_read(vc_eva_model *model, const uint8_t *bytes, size_t length)
{
    reader from = {bytes, length, 0};
    const uint8_t *head = take(&from, HEAD_BYTES);
    uint32_t graph_bytes, latent, codes;
    memset(model, 0, sizeof *model);
    if (from.short_of || head[0] != VC_EVA_LAYOUT_VERSION || head[1] > FLAGS || head[5] > MAX_FRACTION_BITS)
        return VC_BAD_TABLES;
    model->width = head[2];
    model->latents = head[3];
    model->rates = head[4];
    graph_bytes = number(head + 6) | number(head + 8) << 16;
    if (model->width < 1 || model->width > VC_EVA_MAX_WIDTH || model->latents < 1 ||
        model->latents > VC_EVA_MAX_WIDTH || model->rates < 1 || model->rates > VC_EVA_MAX_RATES)
        return VC_BAD_TABLES;
    codes = model->rates * model->latents;
    model->adapts = (head[1] & ADAPTS_FLAG) != 0;
    model->has_network = (head[1] & NETWORK_FLAG) != 0;
    model->step_codes = take(&from, 2 * codes);
    model->prior = take(&from, model->adapts ? vc_mdct_tables_size() : (size_t)2 * (VC_UNARY_LIMIT + 1) * codes);
    if (from.short_of || (model->has_network && read_network(model, &from) != VC_OK))
        return VC_BAD_TABLES;
    for (latent = 0; latent < codes; latent++)
        if (number(model->step_codes + 2 * latent) >= VC_STEP_CODES)
            return VC_BAD_TABLES;
    return from.length == graph_bytes && (model->has_network || graph_bytes > 0) ? VC_OK : VC_BAD_TABLES;
}

int vc_eva_configuration_read(vc_eva_configuration *configuration, const vc_eva_model *model, const uint8_t *bytes,
                              size_t length, unsigned channels)
{
    vc_eva_configuration read;
    const size_t head_bytes = length > 0 && (bytes[0] & 0x80u) ? 2 : 1;
    unsigned channel;
    if (channels < 1 || channels > VC_MAX_CHANNELS || length < head_bytes || (bytes[head_bytes - 1] & 0x80u))
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    if (!vc_rate_control_read(bytes, length, head_bytes + 3 * channels, &read.rate_controlled))
        return VC_BAD_CONFIGURATION;
    read.packet_columns = head_bytes == 1 ? bytes[0] : (bytes[0] & 0x7Fu) | (uint32_t)bytes[1] << 7;
    read.channels = channels;
    if (read.packet_columns < 1 || read.packet_columns > VC_EVA_MAX_PACKET_COLUMNS)
        return VC_BAD_CONFIGURATION;
    for (channel = 0; channel < channels; channel++) {
        const uint8_t *fields = bytes + head_bytes + 3 * channel;
        if (number(fields) >= VC_STEP_CODES || fields[2] > QUALITY_PARTS * (model->rates - 1))
            return VC_BAD_CONFIGURATION;
        read.level[channel] = vc_step_of(number(fields));
        read.quality[channel] = fields[2];
    }
    *configuration = read;
    return VC_OK;
}

uint32_t vc_eva_packet_quality(const vc_eva_model *model, const vc_eva_configuration *configuration, unsigned channel,
                               int32_t quantiser_offset)
{
    const int32_t finest = (int32_t)(QUALITY_PARTS * (model->rates - 1));
    const int32_t quality = (int32_t)configuration->quality[channel] - 4 * quantiser_offset;
    return (uint32_t)(quality < 0 ? 0 : quality < finest ? quality : finest);
}

void vc_eva_steps(const vc_eva_model *model, uint32_t quality, int32_t *steps)
{
    const uint32_t part = quality % QUALITY_PARTS;
    const uint8_t *below = model->step_codes + quality / QUALITY_PARTS * model->latents * 2;
    const uint8_t *above = part == 0 ? below : below + 2 * model->latents;
    uint32_t k;
    for (k = 0; k < model->latents; k++) {
        uint32_t sum = number(below + 2 * k) * (QUALITY_PARTS - part) + number(above + 2 * k) * part;
        steps[k] = vc_step_of((sum + QUALITY_PARTS / 2) / QUALITY_PARTS);
    }
}

const uint8_t *vc_eva_probabilities(const vc_eva_model *model, uint32_t quality, uint32_t k)
{
    const uint32_t rate = (quality + QUALITY_PARTS / 2) / QUALITY_PARTS;
    return model->prior + (size_t)2 * (VC_UNARY_LIMIT + 1) * (rate * model->latents + k);
}

uint32_t vc_eva_probability(const uint8_t *probabilities, unsigned decision)
{
    uint32_t probability = number(probabilities + 2 * decision);
    return probability < MIN_PROBABILITY           ? MIN_PROBABILITY
           : probability > 65536 - MIN_PROBABILITY ? 65536 - MIN_PROBABILITY
                                                   : probability;
}
