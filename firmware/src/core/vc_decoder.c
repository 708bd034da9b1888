/* Streams without a controller: .vct files, and packets of a link; see vibrocast/decoder.h. */
#include "vibrocast/decoder.h"

#include "vc_codec.h"
#include "vc_common.h"
#include "vc_crc.h"
#include "vc_model_image.h"
#include "vc_sha256.h"
#include "vc_stream_header.h"

#define TAKES_MODELS (VC_WITH_MDCT || VC_WITH_EVA)
#define FLAGS_AT 2
#define CRC_BYTES 2
#define VARINT_BYTES 9 /* of the 63 bits of VC_STREAM_VARINT_BITS */
/* The head, rate, length, gains, hash, length of the configuration, configuration. */
#define HEADER_BYTES (3 + 2 * VARINT_BYTES + 2 * VC_STREAM_MAX_CHANNELS + VC_IMAGE_HASH_BYTES + 1 + 255)
#define MAX_PACKET_BYTES 65535u

static int take(vc_stream *stream, uint8_t *data, size_t length)
{
    return stream->read(stream->context, data, length) == length;
}

/* Takes the bytes of a varint. Returns how many there are, 0 for none and for too many. */
static size_t take_varint(vc_stream *stream, uint8_t *data, size_t capacity)
{
    size_t length;
    for (length = 0; length < capacity && take(stream, data + length, 1); length++)
        if (data[length] < 0x80u)
            return length + 1;
    return 0;
}

static uint64_t varint(const uint8_t *data, size_t length)
{
    uint64_t value = 0;
    while (length-- > 0)
        value = value << 7 | (data[length] & 0x7Fu);
    return value;
}

/* Takes the bytes of a header into `data`, whatever is in them. Returns how many; 0: the file ends before. */
static size_t take_header(vc_stream *stream, uint8_t *data)
{
    size_t at = FLAGS_AT + 1, part, configuration;
    unsigned flags, varints;
    if (!take(stream, data, at) || data[0] != VC_STREAM_MAGIC)
        return 0;
    flags = data[FLAGS_AT];
    configuration = data[1] & 0x0Fu;
    for (varints = 0; varints < 2; varints++, at += part) {
        part = take_varint(stream, data + at, VARINT_BYTES);
        if (part == 0)
            return 0;
    }
    part = 2 * ((size_t)(flags >> 4) + 1) + (flags & VC_STREAM_HAS_IMAGE_HASH ? VC_IMAGE_HASH_BYTES : 0);
    if (!take(stream, data + at, part))
        return 0;
    at += part;
    if (configuration == VC_STREAM_LONG_CONFIGURATION) {
        if (!take(stream, data + at, 1))
            return 0;
        configuration = data[at++];
    }
    return take(stream, data + at, configuration) ? at + configuration : 0;
}

/* Finds the tables of the model that a stream needs. Returns VC_OK or VC_NEEDS_MODEL. */
static int find_tables(vc_coding *coding, const vc_stream *stream, const vc_stream_header *header)
{
#if TAKES_MODELS
    uint8_t sha256[VC_SHA256_BYTES];
    vc_model_image image;
    vc_rejection rejection;
    if (!header->needs_image)
        return VC_OK;
    if (stream->model == NULL || vc_model_image_read(&image, stream->model, stream->model_bytes, &rejection))
        return VC_NEEDS_MODEL;
    vc_sha256(stream->model, vc_model_image_unsigned_bytes(stream->model, stream->model_bytes), sha256);
    if (image.codec != header->codec || !vc_same_bytes(sha256, header->image_hash, VC_IMAGE_HASH_BYTES))
        return VC_NEEDS_MODEL;
    coding->tables = image.payload.bytes;
    coding->tables_length = image.payload.length;
    return VC_OK;
#else
    (void)coding;
    (void)stream;
    return header->needs_image ? VC_NEEDS_MODEL : VC_OK;
#endif
}

int vc_stream_open(vc_stream *stream)
{
    uint8_t data[HEADER_BYTES];
    const size_t length = take_header(stream, data);
    vc_stream_header header;
    vc_rejection rejection;
    vc_coding coding;
    const vc_codec *codec;
    int status;
    stream->decodes = NULL;
    stream->number = 0;
    stream->ended = VC_BAD_HEADER;
    stream->needed_bytes = 0;
    stream->packet_samples = stream->decoded = 0;
    stream->first = stream->last = 0;
    if (length == 0 || vc_stream_header_read(&header, data, length, &rejection))
        return VC_BAD_HEADER;
    codec = vc_codec_find(header.codec);
    memset(&coding, 0, sizeof coding);
    coding.codec = header.codec;
    coding.channels = header.output.channels;
    coding.configuration = header.configuration;
    coding.configuration_length = header.configuration_length;
    status = codec == NULL ? VC_NO_CODEC : find_tables(&coding, stream, &header);
    if (status == VC_OK)
        status = vc_codec_check(codec, &coding);
    stream->ended = status;
    if (status != VC_OK)
        return status;
    stream->codec = codec->name;
    stream->samples = header.samples;
    stream->rate_hz = header.output.rate_hz;
    stream->unit = header.output.unit;
    stream->channels = header.output.channels;
    memcpy(stream->gain, header.output.gain, sizeof stream->gain);
    stream->packet_samples = stream->decoded = coding.packet_samples;
    stream->delay_samples = coding.delay_samples;
    stream->needed_bytes = codec->decoder_bytes;
    if (stream->memory_bytes < codec->decoder_bytes)
        return stream->ended = VC_TOO_SMALL;
    stream->decodes = codec;
    stream->one_packet = (data[FLAGS_AT] & VC_STREAM_ONE_PACKET) != 0;
    stream->crc = vc_crc16(data, length, VC_CRC16_START);
    codec->init(stream->memory, &coding);
    return VC_OK;
}

int vc_stream_feed(vc_stream *stream, const uint8_t *packet, size_t length)
{
    const vc_codec *codec = stream->decodes;
    uint64_t before, end;
    int status;
    if (codec == NULL)
        return stream->ended;
    before = stream->number * stream->packet_samples;
    end = stream->delay_samples + stream->samples;
    status = codec->feed(stream->memory, packet, length);
    stream->decoded = status < 0 ? stream->packet_samples : 0;
    if (status < 0)
        return status;
    stream->number++;
    stream->first = before < stream->delay_samples ? (uint32_t)(stream->delay_samples - before) : 0;
    if (stream->first > stream->packet_samples)
        stream->first = stream->packet_samples;
    stream->last = stream->packet_samples;
    if (stream->samples != VC_LENGTH_UNKNOWN && end < before + stream->packet_samples)
        stream->last = end > before ? (uint32_t)(end - before) : 0;
    if (stream->first > stream->last)
        stream->first = stream->last;
    return status;
}

/* Whether the packets so far hold the whole recording. */
static int complete(const vc_stream *stream)
{
    return stream->number > 0 && (stream->samples == VC_LENGTH_UNKNOWN ||
                                  stream->number * stream->packet_samples >= stream->delay_samples + stream->samples);
}

/* Reads the only packet of a file, up to its end, behind `head` bytes. Returns a status, and the packet's `length`. */
static int take_rest(vc_stream *stream, size_t head, size_t *length)
{
    const size_t room = stream->packet_bytes - head, came = stream->read(stream->context, stream->packet + head, room);
    uint8_t further;
    if (came == room && take(stream, &further, 1))
        return VC_PACKET_TOO_LARGE;
    if (came < CRC_BYTES)
        return VC_CUT;
    *length = head + came - CRC_BYTES;
    stream->crc = vc_crc16(stream->packet + head, came - CRC_BYTES, stream->crc);
    return vc_number(stream->packet + *length, CRC_BYTES) == stream->crc ? VC_OK : VC_BAD_CHECKSUM;
}

/* Reads a packet whose length stands before it. Returns a status, VC_END for the end of the file, and `length`. */
static int take_packet(vc_stream *stream, size_t *length)
{
    uint8_t size[VARINT_BYTES], crc[CRC_BYTES];
    const size_t read = stream->read(stream->context, size, 1);
    size_t size_bytes = read, head;
    uint64_t payload;
    if (read == 0)
        return complete(stream) ? VC_END : VC_CUT;
    if (size[0] >= 0x80u) {
        size_bytes = take_varint(stream, size + 1, VARINT_BYTES - 1);
        if (size_bytes++ == 0)
            return VC_CUT;
    }
    payload = varint(size, size_bytes);
    head = vc_packet_head_write(stream->packet, (uint32_t)stream->number, payload & 1u);
    payload >>= 1;
    if (payload > MAX_PACKET_BYTES - head)
        return VC_BAD_PACKET;
    if (payload > stream->packet_bytes - head)
        return VC_PACKET_TOO_LARGE;
    *length = head + (size_t)payload;
    if (!take(stream, stream->packet + head, (size_t)payload) || !take(stream, crc, sizeof crc))
        return VC_CUT;
    stream->crc = vc_crc16(size, size_bytes, stream->crc);
    stream->crc = vc_crc16(stream->packet + head, (size_t)payload, stream->crc);
    return vc_number(crc, CRC_BYTES) == stream->crc ? VC_OK : VC_BAD_CHECKSUM;
}

/* Reads the next packet into the caller's memory. Returns a status, and the packet's `length`. */
static int read_packet(vc_stream *stream, size_t *length)
{
    const int first = stream->number == 0;
    int status;
    if (stream->packet == NULL || stream->packet_bytes < VC_PACKET_HEAD_BYTES)
        return VC_PACKET_TOO_LARGE;
    if (!stream->one_packet)
        status = take_packet(stream, length);
    else if (first)
        status = take_rest(stream, vc_packet_head_write(stream->packet, 0, 1), length);
    else
        return complete(stream) ? VC_END : VC_CUT;
    if (status == VC_OK && stream->samples != VC_LENGTH_UNKNOWN && complete(stream))
        return VC_CUT; /* a surplus packet */
    if (status == VC_OK && first && !(stream->packet[0] & 1u))
        return VC_BAD_PACKET; /* decoding cannot begin there */
    return status;
}

int vc_stream_next(vc_stream *stream)
{
    size_t length = 0;
    int status = stream->ended;
    stream->decoded = stream->packet_samples;
    if (status == VC_OK)
        status = read_packet(stream, &length);
    if (status == VC_OK)
        status = vc_stream_feed(stream, stream->packet, length);
    stream->ended = status;
    return status;
}

uint32_t vc_stream_poll(vc_stream *stream, int16_t *samples)
{
    const vc_codec *codec = stream->decodes;
    if (stream->decoded < stream->packet_samples)
        stream->decoded = codec->poll(stream->memory, samples);
    return stream->decoded;
}

const char *vc_status_text(int status)
{
    switch (status) {
    case VC_OK:
        return "success";
    case VC_CONCEALED:
        return "a packet is missing: its time is filled by a fade";
    case VC_END:
        return "the stream has ended";
    case VC_BAD_CONFIGURATION:
        return "the codec configuration is damaged or of another version, or there are more channels than "
               "VC_MAX_CHANNELS: copy the file again, or compile with more";
    case VC_BAD_TABLES:
        return "the model image has no tables for this codec: give the image that the stream was coded for";
    case VC_BAD_PACKET:
        return "a packet is damaged: copy the file again";
    case VC_PACKET_TOO_LARGE:
        return "a coded packet does not fit its buffer: give a larger one, or encode with --live";
    case VC_HOST_ONLY:
        return "one transform of a whole texture, which only hosts decode: encode in blocks";
    case VC_BAD_HEADER:
        return "no .vct file of this version: encode the recording again";
    case VC_NO_CODEC:
        return "this build lacks the codec: compile it with VC_WITH_... or encode with another codec";
    case VC_NO_VERIFIER:
        return "the controller has a public key and nothing that verifies signatures: build it with --verifier";
    case VC_BAD_SETTINGS:
        return "the controller's settings are none that settings.h allows: compare them with it";
    case VC_NEEDS_MODEL:
        return "the stream was coded for a model image: give that image";
    case VC_TOO_SMALL:
        return "your memory is too small: give what the stream needs, or compile with fewer VC_MAX_CHANNELS";
    case VC_BAD_CHECKSUM:
        return "a packet is damaged, or one before it is missing: copy the file again";
    case VC_CUT:
        return "the file is cut short or has surplus packets: copy it again";
    default:
        return "unknown status";
    }
}
