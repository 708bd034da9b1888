/* Decoder of `mdct`: packets to levels, levels to coefficients, fades where packets miss. */
#include "vc_codec.h"
#include "vc_decoder_memory.h"
#include "vc_mdct_synthesis.h"

#define FADE_BLOCKS 8u /* longest time that concealment sounds */
/* For a sample of a channel, the longest hop and a tenth more; docs/benchmarks/firmware.md. */
#define CYCLES 2650u
/* More with a rotation: for a sample of a channel, and for each channel that is mixed into it. */
#define ROTATION_CYCLES 100u
#define MIXING_CYCLES 11u

/* The last byte before a rotation says what else packets and configuration hold. */
#define FEATURE_RATE_CONTROLLED 1u
#define FEATURE_ROTATION 2u
#define FEATURES (FEATURE_RATE_CONTROLLED | FEATURE_ROTATION)
/* Bits of the number that begins a configuration; above them the blocks of a packet. */
#define HOP 3u
#define SHAPED 4u
#define BLOCKS_SHIFT 3

size_t vc_mdct_decoder_size(void)
{
    return sizeof(vc_mdct_decoder);
}

/* Reads the step shape, from the lowest bit on 2 bits for each node, then the unit of which they are multiples. Returns
 * 0 for one that is flat. */
static int read_shape(vc_mdct_configuration *configuration, const uint8_t *bytes)
{
    const uint32_t section = bytes[0] | (uint32_t)bytes[1] << 8;
    const uint32_t unit = VC_SHAPE_UNIT_CODES * ((section >> 2 * VC_SHAPE_NODES) + 1);
    unsigned node;
    configuration->shaped = 1;
    for (node = 0; node < VC_SHAPE_NODES; node++)
        configuration->shape[node] = (uint16_t)(unit * (section >> 2 * node & 3u));
    return (section & ((1u << 2 * VC_SHAPE_NODES) - 1)) != 0;
}

/* Reads the features byte and the rotation that it announces, from `used` bytes on. Returns whether they are valid. */
static int read_features(vc_mdct_configuration *configuration, const uint8_t *bytes, size_t length, size_t used)
{
    unsigned features;
    if (used == length)
        return 1;
    features = bytes[used++];
    if (features == 0 || (features & ~FEATURES))
        return 0;
    configuration->rate_controlled = (features & FEATURE_RATE_CONTROLLED) != 0;
    if (features & FEATURE_ROTATION) {
        const size_t taken =
            vc_rotation_check(bytes + used, length - used, configuration->channels, &configuration->longest_delay);
        if (taken == 0)
            return 0;
        configuration->rotation = used;
        used += taken;
    }
    return used == length;
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
    if (head >> BLOCKS_SHIFT < 1)
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    if (length < used + 2 * channels)
        return VC_BAD_CONFIGURATION;
    read.hop = 16u << (head & HOP);
    read.packet_blocks = head >> BLOCKS_SHIFT;
    read.channels = channels;
    for (channel = 0; channel < channels; channel++) {
        uint32_t code = bytes[used + 2 * channel] | (uint32_t)bytes[used + 2 * channel + 1] << 8;
        read.fill[channel] = (uint8_t)(code >> VC_STEP_CODE_BITS);
        code &= (1u << VC_STEP_CODE_BITS) - 1;
        if (code >= VC_STEP_CODES)
            return VC_BAD_CONFIGURATION;
        read.step_code[channel] = (uint16_t)code;
        if (code < read.step_code[read.finest])
            read.finest = channel;
    }
    used += 2 * channels;
    if (head & SHAPED) {
        if (length < used + VC_SHAPE_BYTES || !read_shape(&read, bytes + used))
            return VC_BAD_CONFIGURATION;
        used += VC_SHAPE_BYTES;
    }
    if (!read_features(&read, bytes, length, used))
        return VC_BAD_CONFIGURATION;
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
    status = vc_configuration_read(&decoder->configuration, configuration, configuration_length, channels);
    if (status == VC_OK && decoder->configuration.rotation)
        vc_rotation_init(&decoder->rotation, &decoder->configuration, configuration + decoder->configuration.rotation);
    return status;
}

uint32_t vc_mdct_decoder_packet_samples(const vc_mdct_decoder *decoder)
{
    return decoder->configuration.packet_blocks * decoder->configuration.hop;
}

uint32_t vc_mdct_decoder_delay_samples(const vc_mdct_decoder *decoder)
{
    return decoder->configuration.hop + decoder->configuration.longest_delay;
}

/* Cycles for a sample of all channels, as vc_coding has them. */
static uint32_t cycles(const vc_mdct_configuration *configuration)
{
    const uint32_t channels = configuration->channels;
    const uint32_t rotation = configuration->rotation ? ROTATION_CYCLES + MIXING_CYCLES * channels : 0;
    return channels * (CYCLES + rotation);
}

static void decode_block(vc_mdct_decoder *decoder, vc_range_coder *coder, unsigned number)
{
    const vc_mdct_configuration *configuration = &decoder->configuration;
    vc_mdct_channel *channel = &decoder->channels[number];
    const int32_t flat_code = vc_flat_code(configuration, number, decoder->quantiser_offset.value);
    int8_t offsets[VC_MAX_BINS];
    uint32_t k, fill;
    vc_block_decode(coder, &decoder->model, &channel->block, configuration->hop, channel->spectrum, offsets);
    fill = channel->block.history.silent_history & 1 ? 0 : configuration->fill[number];
    for (k = 0; k < configuration->hop; k++) {
        const int32_t step = vc_bin_step(configuration, flat_code, k);
        channel->spectrum[k] = channel->spectrum[k] == 0
                                   ? (int32_t)((int64_t)step * fill / 128) * vc_random_sign(&decoder->random)
                                   : vc_reconstruct(channel->spectrum[k], offsets[k], step);
    }
}

int vc_mdct_feed(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length)
{
    const vc_mdct_configuration *configuration = &decoder->configuration;
    uint32_t sequence;
    int refresh;
    unsigned channel;
    const size_t head = packet == NULL ? 0 : vc_packet_head_read(packet, length, &sequence, &refresh);
    if (packet != NULL && head == 0)
        return VC_BAD_PACKET;
    decoder->block = decoder->channel = 0;
    decoder->synthesising = 0;
    decoder->concealing = packet == NULL || (!refresh && (!decoder->in_sequence || sequence != decoder->next_sequence));
    decoder->in_sequence = !decoder->concealing;
    if (decoder->concealing)
        return VC_CONCEALED;
    if (refresh) {
        vc_model_reset(&decoder->model, decoder->tables);
        vc_quantiser_offset_reset(&decoder->quantiser_offset);
    }
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_block_reset(&decoder->channels[channel].block);
    decoder->next_sequence = sequence + 1;
    decoder->random = sequence; /* so that a decoder that begins here fills alike */
    vc_range_decoder_init(&decoder->coder, packet + head, length - head);
    if (configuration->rate_controlled)
        vc_quantiser_offset_decode(&decoder->coder, &decoder->quantiser_offset);
    return VC_OK;
}

/* Repeats the last spectrum of a channel with random signs, scaled so that the blocks of a packet ramp to zero. */
static void conceal_block(vc_mdct_decoder *decoder, unsigned channel)
{
    const uint32_t blocks = decoder->configuration.packet_blocks, block = decoder->block;
    const uint32_t fade = blocks < FADE_BLOCKS ? blocks : FADE_BLOCKS;
    int32_t *spectrum = decoder->channels[channel].spectrum;
    uint32_t k;
    for (k = 0; k < decoder->configuration.hop; k++)
        spectrum[k] = block < fade ? spectrum[k] / (int32_t)(fade - block) * (int32_t)(fade - block - 1) *
                                         vc_random_sign(&decoder->random)
                                   : 0;
}

/* Turns a spectrum of a channel into its next hop samples, as many values apart as the stream has channels. */
static void synthesise(vc_mdct_decoder *decoder, unsigned channel, const int32_t *spectrum, int16_t *samples)
{
    vc_mdct_synthesise(spectrum, decoder->channels[channel].overlap, decoder->configuration.hop, samples,
                       decoder->configuration.channels);
}

uint32_t vc_mdct_poll(vc_mdct_decoder *decoder, int16_t *samples)
{
    const unsigned channels = decoder->configuration.channels, channel = decoder->channel;
    const uint32_t hop = decoder->configuration.hop;
    const int rotated = decoder->configuration.rotation != 0;
    int16_t *to = samples + (size_t)decoder->block * hop * channels + channel;
    if (!decoder->synthesising) {
        if (decoder->concealing)
            conceal_block(decoder, channel);
        else
            decode_block(decoder, &decoder->coder, channel);
    }
    if (!rotated) {
        synthesise(decoder, channel, decoder->channels[channel].spectrum, to);
    } else if (decoder->synthesising) {
        vc_rotate(&decoder->rotation, decoder->channels[0].spectrum, sizeof *decoder->channels / sizeof(int32_t),
                  channels, hop, channel, decoder->mixed);
        synthesise(decoder, channel, decoder->mixed, to);
        vc_delay(&decoder->rotation, channel, to, hop, channels);
    }
    decoder->channel = (channel + 1) % channels;
    if (decoder->channel == 0) {
        /* A rotation needs the spectra of all channels first. */
        decoder->synthesising = rotated && !decoder->synthesising;
        if (!decoder->synthesising)
            decoder->block++;
    }
    return decoder->block * hop;
}

int vc_mdct_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_codec_decode(&vc_mdct_codec, decoder, vc_mdct_decoder_packet_samples(decoder), packet, length, samples);
}

static const char *check_tables(const uint8_t *tables, size_t length)
{
    return vc_model_check_tables(tables, length) == VC_OK ? NULL
                                                          : "tables of the wrong size for mdct: export them again";
}

static int check(vc_coding *coding)
{
    vc_mdct_configuration read;
    const int status =
        vc_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_blocks * read.hop;
        coding->delay_samples = read.hop + read.longest_delay;
        coding->cycles_per_sample = cycles(&read);
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_mdct_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels,
                               coding->tables, coding->tables_length);
}

static int feed(void *decoder, const uint8_t *packet, size_t length)
{
    return vc_mdct_feed(decoder, packet, length);
}

static uint32_t poll(void *decoder, int16_t *samples)
{
    return vc_mdct_poll(decoder, samples);
}

const vc_codec vc_mdct_codec = {1, "mdct", sizeof(struct vc_mdct_decoder), 0, check_tables, check, init, feed, poll};
