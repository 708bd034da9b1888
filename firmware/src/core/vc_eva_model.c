/* Reads EVA's models and configurations; see vc_eva_model.h. */
#include "vc_eva_model.h"

#define HEAD_BYTES 8u
#define STATIC_FLAG 1u
#define NETWORK_FLAG 2u
#define FLAGS 7u
#define MAX_FRACTION_BITS 14u
#define MAX_SHIFT 30u
/* Step codes, 64 an octave: that of a step of 1 in the latents' unit, and the largest of which a step fits 32 bits. */
#define UNIT_STEP_CODE (6 * 64)
#define MAX_STEP_CODE (24 * 64 - 1)
#define CODES_OF_QUANTISER_OFFSET 4

/* The remaining bytes of a model. */
typedef struct {
    const uint8_t *bytes;
    size_t length;
    int short_of; /* more was taken than the model has */
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
    uint32_t graph_bytes, latent;
    memset(model, 0, sizeof *model);
    if (from.short_of || head[0] != VC_EVA_LAYOUT_VERSION || head[1] > FLAGS)
        return VC_BAD_TABLES;
    model->width = head[2];
    model->latents = head[3];
    graph_bytes = number(head + 4) | number(head + 6) << 16;
    if (model->width < 1 || model->width > VC_EVA_MAX_WIDTH || model->latents < 1 || model->latents > VC_EVA_MAX_WIDTH)
        return VC_BAD_TABLES;
    model->adapts = (head[1] & STATIC_FLAG) == 0;
    model->has_network = (head[1] & NETWORK_FLAG) != 0;
    model->fraction_bits = take(&from, model->latents);
    model->probabilities = take(&from, (size_t)2 * VC_EVA_DECISIONS * model->latents);
    if (from.short_of || (model->has_network && read_network(model, &from) != VC_OK))
        return VC_BAD_TABLES;
    for (latent = 0; latent < model->latents; latent++)
        if (model->fraction_bits[latent] > MAX_FRACTION_BITS)
            return VC_BAD_TABLES;
    return from.length == graph_bytes && (model->has_network || graph_bytes > 0) ? VC_OK : VC_BAD_TABLES;
}

int vc_eva_configuration_read(vc_eva_configuration *configuration, const uint8_t *bytes, size_t length,
                              unsigned channels)
{
    vc_eva_configuration read;
    const size_t head_bytes = length > 0 && (bytes[0] & 0x80u) ? 2 : 1;
    unsigned channel;
    if (channels < 1 || channels > VC_MAX_CHANNELS || length < head_bytes || (bytes[head_bytes - 1] & 0x80u))
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    if (!vc_rate_control_read(bytes, length, head_bytes + 2 * channels, &read.rate_controlled))
        return VC_BAD_CONFIGURATION;
    read.packet_columns = head_bytes == 1 ? bytes[0] : (bytes[0] & 0x7Fu) | (uint32_t)bytes[1] << 7;
    read.channels = channels;
    if (read.packet_columns < 1 || read.packet_columns > VC_EVA_MAX_PACKET_COLUMNS)
        return VC_BAD_CONFIGURATION;
    for (channel = 0; channel < channels; channel++) {
        const uint32_t code = number(bytes + head_bytes + 2 * channel);
        if (code >= VC_STEP_CODES)
            return VC_BAD_CONFIGURATION;
        read.level[channel] = vc_step_of(code);
    }
    *configuration = read;
    return VC_OK;
}

void vc_eva_packet_steps(const vc_eva_model *model, int32_t quantiser_offset, int32_t *steps)
{
    uint32_t latent;
    for (latent = 0; latent < model->latents; latent++) {
        const int32_t code =
            UNIT_STEP_CODE + 64 * (int32_t)model->fraction_bits[latent] + CODES_OF_QUANTISER_OFFSET * quantiser_offset;
        steps[latent] = vc_step_of(code < 0 ? 0 : code < MAX_STEP_CODE ? (uint32_t)code : MAX_STEP_CODE);
    }
}

uint16_t vc_eva_probability(const vc_eva_model *model, uint32_t latent, uint32_t decision)
{
    return (uint16_t)number(model->probabilities + 2 * (latent * VC_EVA_DECISIONS + decision));
}
