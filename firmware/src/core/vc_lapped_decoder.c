/* Decoder of `lapped`: spectra as those of `mdct`, samples by an extended lapped transform with learned windows. */
#include "vc_codec.h"
#include "vc_mdct_decoder.h"
#include "vc_mdct_synthesis.h"

#define WINDOWS_BYTES (2 * 2 * (16 + 32 + 64 + 128)) /* 2 N values of each hop N, int16 */
#define DELAY_HOPS 3u

size_t vc_lapped_decoder_size(void)
{
    return sizeof(vc_lapped_decoder);
}

size_t vc_lapped_windows_size(void)
{
    return WINDOWS_BYTES;
}

static int check_model(const uint8_t *model, size_t length)
{
    return model != NULL && length > WINDOWS_BYTES
               ? vc_model_check_tables(model + WINDOWS_BYTES, length - WINDOWS_BYTES)
               : VC_BAD_TABLES;
}

int vc_lapped_decoder_init(vc_lapped_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                           unsigned channels, const uint8_t *model, size_t model_length)
{
    int status = check_model(model, model_length);
    memset(decoder, 0, sizeof *decoder);
    if (status == VC_OK)
        status = vc_mdct_decoder_init(&decoder->spectra, configuration, configuration_length, channels,
                                      model + WINDOWS_BYTES, model_length - WINDOWS_BYTES);
    if (status == VC_OK) /* the windows of shorter hops take 4 bytes for each of 16, 16 + 32, ... samples */
        decoder->window = model + 4 * (decoder->spectra.configuration.hop - 16);
    return status;
}

uint32_t vc_lapped_decoder_packet_samples(const vc_lapped_decoder *decoder)
{
    return vc_mdct_decoder_packet_samples(&decoder->spectra);
}

uint32_t vc_lapped_decoder_delay_samples(const vc_lapped_decoder *decoder)
{
    return DELAY_HOPS * decoder->spectra.configuration.hop + decoder->spectra.configuration.longest_delay;
}

static void synthesise(vc_mdct_decoder *spectra, unsigned channel, const int32_t *spectrum, int16_t *samples)
{
    vc_lapped_decoder *decoder = (vc_lapped_decoder *)spectra;
    vc_lapped_synthesise(decoder->window, spectrum, spectra->channels[channel].overlap, decoder->later[channel],
                         spectra->configuration.hop, samples, spectra->configuration.channels);
}

int vc_lapped_feed(vc_lapped_decoder *decoder, const uint8_t *packet, size_t length)
{
    return vc_spectra_feed(&decoder->spectra, packet, length);
}

uint32_t vc_lapped_poll(vc_lapped_decoder *decoder, int16_t *samples)
{
    return vc_spectra_poll(&decoder->spectra, synthesise, samples);
}

int vc_lapped_decode(vc_lapped_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    return vc_codec_decode(&vc_lapped_codec, decoder, vc_lapped_decoder_packet_samples(decoder), packet, length,
                           samples);
}

static const char *check_tables(const uint8_t *tables, size_t length)
{
    return check_model(tables, length) == VC_OK ? NULL : "a model of the wrong size for lapped: export it again";
}

static int check(vc_coding *coding)
{
    vc_mdct_configuration read;
    int status = check_model(coding->tables, coding->tables_length);
    if (status == VC_OK)
        status = vc_configuration_read(&read, coding->configuration, coding->configuration_length, coding->channels);
    if (status == VC_OK) {
        coding->packet_samples = read.packet_blocks * read.hop;
        coding->delay_samples = DELAY_HOPS * read.hop + read.longest_delay;
        coding->cycles_per_sample = vc_spectra_cycles(&read);
    }
    return status;
}

static void init(void *decoder, const vc_coding *coding)
{
    (void)vc_lapped_decoder_init(decoder, coding->configuration, coding->configuration_length, coding->channels,
                                 coding->tables, coding->tables_length);
}

static int feed(void *decoder, const uint8_t *packet, size_t length)
{
    return vc_lapped_feed(decoder, packet, length);
}

static uint32_t poll(void *decoder, int16_t *samples)
{
    return vc_lapped_poll(decoder, samples);
}

const vc_codec vc_lapped_codec = {12,   "lapped", sizeof(struct vc_lapped_decoder), 1, check_tables, check, init,
                                  feed, poll};
