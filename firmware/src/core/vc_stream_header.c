/* The header of a coded stream, and the heads of its packets; see vc_stream_header.h. */
#include "vc_stream_header.h"

#include "vc_common.h"

#define INFINITE_GAIN 0x7F80u

int vc_stream_header_read(vc_stream_header *header, const uint8_t *data, size_t length, vc_rejection *rejection)
{
    vc_fields fields;
    vc_piece hash, configuration;
    uint64_t rate, samples, rate_hz;
    unsigned magic, codec_and_length, length_of_configuration, flags, channel;
    vc_fields_begin(&fields, data, length);
    memset(header, 0, sizeof *header);
    magic = (unsigned)vc_take_number(&fields, 1);
    if (fields.cut || magic != VC_STREAM_MAGIC)
        return vc_reject_numbers(
            rejection, VC_BAD_VALUE,
            "no stream header of format #, which this controller reads: encode the recording again", VC_STREAM_FORMAT,
            0);
    codec_and_length = (unsigned)vc_take_number(&fields, 1);
    header->codec = codec_and_length >> 4;
    length_of_configuration = codec_and_length & 0x0Fu;
    flags = (unsigned)vc_take_number(&fields, 1);
    header->output.unit = flags & VC_STREAM_UNIT_BITS;
    header->output.channels = (uint8_t)((flags >> 4) + 1);
    rate = vc_take_varint(&fields, VC_STREAM_RATE_BITS);
    rate_hz = rate & 1u ? rate >> 1 : (rate >> 1) * VC_STREAM_ROUND_RATE_HZ;
    samples = vc_take_varint(&fields, VC_STREAM_VARINT_BITS);
    header->samples = samples == 0 ? VC_LENGTH_UNKNOWN : samples - 1;
    for (channel = 0; channel < header->output.channels; channel++)
        header->output.gain[channel] = (uint16_t)vc_take_number(&fields, 2);
    header->needs_image = (flags & VC_STREAM_HAS_IMAGE_HASH) != 0;
    hash = vc_take_piece(&fields, header->needs_image ? VC_IMAGE_HASH_BYTES : 0);
    if (length_of_configuration == VC_STREAM_LONG_CONFIGURATION)
        length_of_configuration = (unsigned)vc_take_number(&fields, 1);
    configuration = vc_take_piece(&fields, length_of_configuration);
    if (fields.cut)
        return vc_reject_numbers(rejection, VC_BAD_VALUE,
                                 "the stream header is cut at # bytes, or a number in it is too long", length, 0);
    if (fields.rest.length > 0)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "# bytes are left after the stream header",
                                 fields.rest.length, 0);
    if (header->codec == 0)
        return vc_reject(rejection, VC_BAD_VALUE, "the stream header is damaged: no codec has number 0");
    if (rate_hz < 1 || rate_hz > VC_STREAM_MAX_RATE_HZ)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "a rate of # Hz is outside 1 to # Hz: resample the signal",
                                 rate_hz, VC_STREAM_MAX_RATE_HZ);
    header->output.rate_hz = (uint32_t)rate_hz;
    for (channel = 0; channel < header->output.channels; channel++)
        if (header->output.gain[channel] == 0 || header->output.gain[channel] >= INFINITE_GAIN)
            return vc_reject_numbers(rejection, VC_BAD_VALUE, "the full scale of channel # is no positive number",
                                     channel, 0);
    if (hash.length > 0)
        memcpy(header->image_hash, hash.bytes, hash.length);
    header->configuration_length = (uint8_t)configuration.length;
    if (configuration.length > 0)
        memcpy(header->configuration, configuration.bytes, configuration.length);
    return 0;
}

int vc_packet_sequence(const uint8_t *packet, size_t length, uint32_t *sequence, int *refresh)
{
    vc_fields fields;
    uint64_t head;
    vc_fields_begin(&fields, packet, length);
    head = vc_take_varint(&fields, VC_PACKET_SEQUENCE_BITS + 1);
    *sequence = (uint32_t)(head >> 1);
    *refresh = (int)(head & 1u);
    return fields.cut ? -1 : 0;
}
