/* Decoder of `mdct`: packets to levels, levels to coefficients, fades where packets miss. */
#include "mdct_decoder.h"
#include "codec.h"
#include "mdct_synthesis.h"

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
    if (head >> 2 < 1 || head >> 2 > VC_MAX_PACKET_BLOCKS)
        return VC_BAD_CONFIGURATION;
    memset(&read, 0, sizeof read);
    if (!vc_rate_control_read(bytes, length, used + 2 * channels, &read.rate_controlled))
        return VC_BAD_CONFIGURATION;
    read.hop = 16u << (head & 3u);
    read.packet_blocks = head >> 2;
    read.channels = channels;
    for (channel = 0; channel < channels; channel++) {
        uint32_t code = bytes[used + 2 * channel] | (uint32_t)bytes[used + 2 * channel + 1] << 8;
        read.fill[channel] = (uint8_t)(code >> VC_STEP_CODE_BITS);
        code &= (1u << VC_STEP_CODE_BITS) - 1;
        if (code >= VC_STEP_CODES)
            return VC_BAD_CONFIGURATION;
        read.step_code[channel] = (uint16_t)code;
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

static void decode_block(vc_mdct_decoder *decoder, vc_range_coder *coder, unsigned number)
{
    const uint32_t hop = decoder->configuration.hop;
    const int32_t step = vc_packet_step(&decoder->configuration, number, decoder->quantiser_offset.value);
    vc_mdct_channel *channel = &decoder->channels[number];
    int32_t fill;
    uint32_t k;
    vc_block_decode(coder, &decoder->model, &channel->block, hop, channel->spectrum);
    fill = channel->block.history.silent_history & 1
               ? 0
               : (int32_t)((int64_t)step * decoder->configuration.fill[number] / 128);
    for (k = 0; k < hop; k++)
        channel->spectrum[k] = channel->spectrum[k] == 0 ? fill * vc_random_sign(&decoder->random)
                                                         : vc_reconstruct(channel->spectrum[k], step);
}

int vc_spectra_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, vc_synthesis synthesise,
                      int16_t *samples)
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
        vc_spectra_conceal(decoder, synthesise, samples);
        return VC_CONCEALED;
    }
    if (refresh) {
        vc_model_reset(&decoder->model, decoder->tables);
        vc_quantiser_offset_reset(&decoder->quantiser_offset);
    }
    for (channel = 0; channel < configuration->channels && refresh; channel++)
        vc_block_reset(&decoder->channels[channel].block);
    decoder->in_sequence = 1;
    decoder->next_sequence = sequence + 1;
    decoder->random = sequence; /* so that a decoder that begins here fills alike */
    vc_range_decoder_init(&coder, packet + head, length - head);
    if (configuration->rate_controlled)
        vc_quantiser_offset_decode(&coder, &decoder->quantiser_offset);
    for (block = 0; block < configuration->packet_blocks; block++)
        for (channel = 0; channel < configuration->channels; channel++) {
            decode_block(decoder, &coder, channel);
            synthesise(decoder, channel, samples + channel);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->hop * configuration->channels;
        }
    return VC_OK;
}

void vc_spectra_conceal(vc_mdct_decoder *decoder, vc_synthesis synthesise, int16_t *samples)
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
                                                        (int32_t)(fade - block - 1) * vc_random_sign(&decoder->random)
                                                  : 0;
            synthesise(decoder, channel, samples + channel);
            if (channel + 1 == configuration->channels)
                samples += (size_t)configuration->hop * configuration->channels;
        }
}

static void synthesise(vc_mdct_decoder *decoder, unsigned channel, int16_t *samples)
{
    vc_mdct_channel *state = &decoder->channels[channel];
    vc_mdct_synthesise(state->spectrum, state->overlap, decoder->configuration.hop, samples,
                       decoder->configuration.channels);
}

int vc_mdct_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_spectra_decode(decoder, packet, length, synthesise, samples);
}

void vc_mdct_conceal(vc_mdct_decoder *decoder, int16_t *samples)
{
    vc_spectra_conceal(decoder, synthesise, samples);
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
        coding->delay_samples = read.hop;
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_mdct_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels,
                               coding->tables, coding->tables_length);
}

static int decode(void *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_mdct_decode(decoder, packet, length, samples);
}

static void conceal(void *decoder, int16_t *samples)
{
    vc_mdct_conceal(decoder, samples);
}

const vc_codec vc_mdct_codec = {1, "mdct", 0, check_tables, check, init, decode, conceal};
