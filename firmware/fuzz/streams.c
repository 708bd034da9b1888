/* Target: streams of every codec. */
#include <stdlib.h>
#include <string.h>

#include "decoders.h"
#include "stream_header.h"
#include "targets.h"

/* Beyond these, a controller takes no stream. */
#define MAX_PACKET_SAMPLES 4096u
#define MAX_PACKETS 64

static void decode(const vc_stream_header *header, const uint8_t *tables, size_t tables_length, const uint8_t *data,
                   size_t length)
{
    vc_coding coding;
    vc_rejection rejection;
    vc_decoder *decoder;
    int16_t *samples;
    uint8_t *packet;
    size_t packet_length;
    int count;
    memset(&coding, 0, sizeof coding);
    coding.codec = header->codec;
    coding.channels = header->output.channels;
    coding.configuration = header->configuration;
    coding.configuration_length = header->configuration_length;
    coding.tables = tables;
    coding.tables_length = tables_length;
    if (vc_coding_check(&coding, NULL, &rejection) != 0 || coding.packet_samples > MAX_PACKET_SAMPLES)
        return;
    vc_fuzz_check(coding.packet_samples > 0, "packets without samples");
    decoder = malloc(sizeof *decoder);
    samples = malloc(coding.packet_samples * coding.channels * sizeof *samples);
    vc_decoder_init(decoder, &coding);
    for (count = 0; count < MAX_PACKETS && vc_fuzz_record(&data, &length, &packet, &packet_length); count++) {
        if (packet_length == 0 || !vc_decoder_decode(decoder, packet, packet_length, samples))
            vc_decoder_conceal(decoder, samples);
        free(packet);
    }
    free(samples);
    free(decoder);
}

void vc_fuzz_streams(const uint8_t *data, size_t length)
{
    uint8_t *tables = NULL, *bytes = NULL;
    size_t tables_length, bytes_length;
    vc_stream_header header;
    vc_rejection rejection;
    if (vc_fuzz_record(&data, &length, &tables, &tables_length) &&
        vc_fuzz_record(&data, &length, &bytes, &bytes_length) &&
        vc_stream_header_read(&header, bytes, bytes_length, &rejection) == 0)
        decode(&header, tables_length > 0 ? tables : NULL, tables_length, data, length);
    free(bytes);
    free(tables);
}
