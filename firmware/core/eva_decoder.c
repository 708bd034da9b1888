/* Decoder of `eva`: packets to latents, latents to samples, fades where packets miss; see eva.h. */
#include "codec.h"
#include "decoder_memory.h"

#define FADE_COLUMNS 8u /* longest time that concealment sounds */
#define MAX_LATENT 32767
#define STEPS_PER_UNIT 4096

/* The destination of a packet: samples, or else latents. */
typedef struct {
    int16_t *samples, *latents;
} output;

size_t vc_eva_decoder_size(void)
{
    return sizeof(vc_eva_decoder);
}

int vc_eva_decoder_init(vc_eva_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, const uint8_t *model, size_t model_length)
{
    int status;
    memset(decoder, 0, sizeof *decoder);
    decoder->random = 1;
    status = vc_eva_model_read(&decoder->model, model, model_length);
    if (status != VC_OK)
        return status;
    return vc_eva_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
}

uint32_t vc_eva_decoder_packet_samples(const vc_eva_decoder *decoder)
{
    return decoder->configuration.packet_columns * VC_EVA_HOP;
}

uint32_t vc_eva_decoder_delay_samples(const vc_eva_decoder *decoder)
{
    (void)decoder;
    return VC_EVA_DELAY;
}

/* The latent of a level, in its unit. */
static int16_t dequantised(int32_t level, int32_t step)
{
    int64_t value = (int64_t)level * step;
    if (level == 0) /* as for most latents */
        return 0;
    value = (value + (value < 0 ? -STEPS_PER_UNIT / 2 : STEPS_PER_UNIT / 2)) / STEPS_PER_UNIT;
    return (int16_t)(value > MAX_LATENT ? MAX_LATENT : value < -MAX_LATENT ? -MAX_LATENT : value);
}

/* Decodes the next column of a channel into its latents. */
static void decode_column(vc_eva_decoder *decoder, vc_range_coder *coder, unsigned channel, const int32_t *steps)
{
    vc_eva_channel *state = &decoder->channels[channel];
    int32_t levels[VC_EVA_MAX_WIDTH];
    uint32_t k;
    vc_eva_code_column(coder, 0, &state->contexts, &decoder->model, levels);
    for (k = 0; k < decoder->model.latents; k++)
        state->latents[k] = dequantised(levels[k], steps[k]);
}

/* Turns the last latents of a channel into those of a missing column: the same with random signs, scaled to ramp to
 * zero. */
static void fade_column(vc_eva_decoder *decoder, unsigned channel, uint32_t column)
{
    const uint32_t packet_columns = decoder->configuration.packet_columns;
    const uint32_t fade = packet_columns < FADE_COLUMNS ? packet_columns : FADE_COLUMNS;
    int16_t *latents = decoder->channels[channel].latents;
    uint32_t k;
    for (k = 0; k < decoder->model.latents; k++)
        latents[k] = column < fade ? (int16_t)(latents[k] * (int32_t)(fade - column - 1) / (int32_t)(fade - column) *
                                               vc_random_sign(&decoder->random))
                                   : 0;
}

/* Puts out a packet: columns from the range decoder, or faded ones without it. */
static void put_out(vc_eva_decoder *decoder, vc_range_coder *coder, output to)
{
    const vc_eva_configuration *configuration = &decoder->configuration;
    const uint32_t latents = decoder->model.latents, columns = configuration->packet_columns;
    vc_eva_work *work = &decoder->work;
    int32_t steps[VC_EVA_MAX_WIDTH];
    unsigned channel;
    vc_eva_packet_steps(&decoder->model, decoder->quantiser_offset.value, steps);
    for (channel = 0; channel < configuration->channels; channel++) {
        vc_eva_channel *state = &decoder->channels[channel];
        uint32_t column, gathered = 0;
        for (column = 0; column < columns; column++) {
            if (coder != NULL)
                decode_column(decoder, coder, channel, steps);
            else
                fade_column(decoder, channel, column);
            if (to.latents != NULL) {
                memcpy(to.latents, state->latents, latents * sizeof *to.latents);
                to.latents += latents;
                continue;
            }
            memcpy(work->inputs + gathered++ * latents, state->latents, latents * sizeof *work->inputs);
            if (gathered == VC_EVA_COLUMNS || column + 1 == columns) {
                size_t start = (size_t)(column + 1 - gathered) * VC_EVA_HOP * configuration->channels;
                vc_eva_synthesise(&decoder->model, &state->history, work, gathered, configuration->level[channel],
                                  to.samples + start + channel, configuration->channels);
                gathered = 0;
            }
        }
    }
}

static int decode_packet(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, output to)
{
    vc_range_coder coder;
    uint32_t sequence;
    int refresh;
    unsigned channel;
    size_t head = vc_packet_head_read(packet, length, &sequence, &refresh);
    if (head == 0)
        return VC_BAD_PACKET;
    if (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence)) {
        decoder->in_sequence = 0;
        put_out(decoder, NULL, to);
        return VC_CONCEALED;
    }
    for (channel = 0; channel < decoder->configuration.channels && refresh; channel++)
        vc_eva_contexts_reset(&decoder->channels[channel].contexts, &decoder->model);
    if (refresh)
        vc_quantiser_offset_reset(&decoder->quantiser_offset);
    decoder->in_sequence = 1;
    decoder->next_sequence = sequence + 1;
    vc_range_decoder_init(&coder, packet + head, length - head);
    if (decoder->configuration.rate_controlled)
        vc_quantiser_offset_decode(&coder, &decoder->quantiser_offset);
    put_out(decoder, &coder, to);
    return VC_OK;
}

int vc_eva_decode(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    const output to = {samples, NULL};
    return decoder->model.has_network ? decode_packet(decoder, packet, length, to) : VC_BAD_TABLES;
}

int vc_eva_decode_latents(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, int16_t *latents)
{
    const output to = {NULL, latents};
    return decode_packet(decoder, packet, length, to);
}

void vc_eva_conceal(vc_eva_decoder *decoder, int16_t *samples)
{
    const output to = {samples, NULL};
    const vc_eva_configuration *configuration = &decoder->configuration;
    decoder->in_sequence = 0;
    if (decoder->model.has_network)
        put_out(decoder, NULL, to);
    else
        memset(samples, 0, (size_t)configuration->packet_columns * VC_EVA_HOP * configuration->channels * 2);
}

void vc_eva_conceal_latents(vc_eva_decoder *decoder, int16_t *latents)
{
    const output to = {NULL, latents};
    decoder->in_sequence = 0;
    put_out(decoder, NULL, to);
}

static const char *check_tables(const uint8_t *tables, size_t length)
{
    vc_eva_model model;
    if (length > 0 && tables[0] != VC_EVA_LAYOUT_VERSION)
        return "a model image of EVA with another layout than this controller reads: export it again";
    if (vc_eva_model_read(&model, tables, length) != VC_OK)
        return "the model image of EVA is damaged; export it again";
    return model.has_network ? NULL
                             : "the model has no integer network, the only one that this controller runs: export it "
                               "with one";
}

static int check(vc_coding *coding)
{
    vc_eva_model model;
    vc_eva_configuration read;
    int status = vc_eva_model_read(&model, coding->tables, coding->tables_length);
    if (status == VC_OK)
        status =
            vc_eva_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK)
        coding->packet_samples = read.packet_columns * VC_EVA_HOP;
    coding->delay_samples = VC_EVA_DELAY;
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_eva_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels,
                              coding->tables, coding->tables_length);
}

static int decode(void *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_eva_decode(decoder, packet, length, samples);
}

static void conceal(void *decoder, int16_t *samples)
{
    vc_eva_conceal(decoder, samples);
}

const vc_codec vc_eva_codec = {4, "eva", 1, check_tables, check, init, decode, conceal};
