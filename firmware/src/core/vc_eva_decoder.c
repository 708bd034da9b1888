/* Decoder of `eva`: packets to latents, latents to samples, fades where packets miss; see vc_eva.h. */
#include "vc_codec.h"
#include "vc_decoder_memory.h"

#define FADE_COLUMNS 8u /* longest time that concealment sounds */
#define MAX_LATENT 32767
#define STEPS_PER_UNIT 4096
/* For a column, for each of its latents and hidden channels, and for each of the network's multiplications: fitted to
 * four sizes of networks, and a tenth more; docs/benchmarks/firmware.md. */
#define CYCLES_BY_COLUMN 16000u
#define CYCLES_BY_CHANNEL 430u
#define CYCLES_BY_20_PRODUCTS 29u

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

/* Decodes the next column of the channel into its latents. */
static void decode_column(vc_eva_decoder *decoder, const int32_t *steps)
{
    vc_eva_channel *state = &decoder->channels[decoder->channel];
    int32_t levels[VC_EVA_MAX_WIDTH];
    uint32_t k;
    vc_eva_code_column(&decoder->coder, 0, &state->contexts, &decoder->model, levels);
    for (k = 0; k < decoder->model.latents; k++)
        state->latents[k] = dequantised(levels[k], steps[k]);
}

/* Turns the last latents of the channel into those of a missing column: the same with random signs, scaled to ramp to
 * zero. */
static void fade_column(vc_eva_decoder *decoder)
{
    const uint32_t column = decoder->column;
    const uint32_t packet_columns = decoder->configuration.packet_columns;
    const uint32_t fade = packet_columns < FADE_COLUMNS ? packet_columns : FADE_COLUMNS;
    int16_t *latents = decoder->channels[decoder->channel].latents;
    uint32_t k;
    for (k = 0; k < decoder->model.latents; k++)
        latents[k] = column < fade ? (int16_t)(latents[k] * (int32_t)(fade - column - 1) / (int32_t)(fade - column) *
                                               vc_random_sign(&decoder->random))
                                   : 0;
}

/* Takes a packet, NULL where it is missing. */
static int take(vc_eva_decoder *decoder, const uint8_t *packet, size_t length)
{
    uint32_t sequence;
    int refresh;
    unsigned channel;
    const size_t head = packet == NULL ? 0 : vc_packet_head_read(packet, length, &sequence, &refresh);
    if (packet != NULL && head == 0)
        return VC_BAD_PACKET;
    decoder->channel = decoder->column = decoder->inputs = 0;
    decoder->concealing = packet == NULL || (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence));
    decoder->in_sequence = !decoder->concealing;
    if (decoder->concealing)
        return VC_CONCEALED;
    for (channel = 0; channel < decoder->configuration.channels && refresh; channel++)
        vc_eva_contexts_reset(&decoder->channels[channel].contexts, &decoder->model);
    if (refresh)
        vc_quantiser_offset_reset(&decoder->quantiser_offset);
    decoder->next_sequence = sequence + 1;
    vc_range_decoder_init(&decoder->coder, packet + head, length - head);
    if (decoder->configuration.rate_controlled)
        vc_quantiser_offset_decode(&decoder->coder, &decoder->quantiser_offset);
    return VC_OK;
}

/* Writes the latents of the channel's next columns, at most `count`. Returns how many there were. */
static uint32_t next_columns(vc_eva_decoder *decoder, uint32_t count, int16_t *latents)
{
    const uint32_t left = decoder->configuration.packet_columns - decoder->column, each = decoder->model.latents;
    const vc_eva_channel *state = &decoder->channels[decoder->channel];
    int32_t steps[VC_EVA_MAX_WIDTH];
    uint32_t i;
    if (count > left)
        count = left;
    vc_eva_packet_steps(&decoder->model, decoder->quantiser_offset.value, steps);
    for (i = 0; i < count; i++, decoder->column++, latents += each) {
        if (decoder->concealing)
            fade_column(decoder);
        else
            decode_column(decoder, steps);
        memcpy(latents, state->latents, each * sizeof *latents);
    }
    return count;
}

/* Goes on to the next channel behind the last column. Returns whether that was the packet's last one. */
static int next_channel(vc_eva_decoder *decoder)
{
    if (decoder->column < decoder->configuration.packet_columns)
        return 0;
    decoder->channel++;
    decoder->column = 0;
    return decoder->channel == decoder->configuration.channels;
}

int vc_eva_feed(vc_eva_decoder *decoder, const uint8_t *packet, size_t length)
{
    return decoder->model.has_network ? take(decoder, packet, length) : VC_BAD_TABLES;
}

/* Entropy decoder and network take turns, since each needs about as long as the other in the worst case. */
uint32_t vc_eva_poll(vc_eva_decoder *decoder, int16_t *samples)
{
    const vc_eva_configuration *configuration = &decoder->configuration;
    const unsigned channel = decoder->channel, last = channel + 1 == configuration->channels;
    const uint32_t before = decoder->column - decoder->inputs;
    if (decoder->inputs == 0) {
        decoder->inputs = next_columns(decoder, VC_EVA_COLUMNS, decoder->work.inputs);
        return last ? before * VC_EVA_HOP : 0;
    }
    samples += (size_t)before * VC_EVA_HOP * configuration->channels + channel;
    vc_eva_synthesise(&decoder->model, &decoder->channels[channel].history, &decoder->work, decoder->inputs,
                      configuration->level[channel], samples, configuration->channels);
    decoder->inputs = 0;
    if (next_channel(decoder))
        return configuration->packet_columns * VC_EVA_HOP;
    return last ? decoder->column * VC_EVA_HOP : 0;
}

int vc_eva_decode(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_codec_decode(&vc_eva_codec, decoder, vc_eva_decoder_packet_samples(decoder), packet, length, samples);
}

int vc_eva_decode_latents(vc_eva_decoder *decoder, const uint8_t *packet, size_t length, int16_t *latents)
{
    const int status = take(decoder, packet, length);
    while (status >= VC_OK) {
        latents += next_columns(decoder, decoder->configuration.packet_columns, latents) * decoder->model.latents;
        if (next_channel(decoder))
            break;
    }
    return status;
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

/* Cycles for a sample of a channel, as vc_coding has them. Each stage multiplies for its normalisation and for five
 * taps, the last one for nine taps to one sample; stages have 1, 2 and 4 columns for each of the latents. */
static uint32_t cycles(const vc_eva_model *model)
{
    const uint32_t latents = model->latents, width = model->width;
    const uint32_t products =
        latents * (latents + 5 * width) + 2 * width * (width + 5 * width) + 4 * width * (width + 9);
    return (CYCLES_BY_COLUMN + CYCLES_BY_CHANNEL * (latents + width) + CYCLES_BY_20_PRODUCTS * (products / 20)) /
           VC_EVA_HOP;
}

static int check(vc_coding *coding)
{
    vc_eva_model model;
    vc_eva_configuration read;
    int status = vc_eva_model_read(&model, coding->tables, coding->tables_length);
    if (status == VC_OK)
        status =
            vc_eva_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_columns * VC_EVA_HOP;
        coding->cycles_per_sample = coding->channels * cycles(&model);
    }
    coding->delay_samples = VC_EVA_DELAY;
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_eva_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels,
                              coding->tables, coding->tables_length);
}

static int feed(void *decoder, const uint8_t *packet, size_t length)
{
    return vc_eva_feed(decoder, packet, length);
}

static uint32_t poll(void *decoder, int16_t *samples)
{
    return vc_eva_poll(decoder, samples);
}

const vc_codec vc_eva_codec = {4, "eva", sizeof(struct vc_eva_decoder), 1, check_tables, check, init, feed, poll};
