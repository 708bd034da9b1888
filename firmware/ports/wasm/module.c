/* The decoders as a WebAssembly module without imports, for docs/javascripts/vibrocast.js.
 *
 * The caller owns the memory from __heap_base on: it puts bytes there, and makes room there for results. The module
 * decodes one stream at a time. */
#include "../../src/core/vc_cobs.h"
#include "../../src/core/vc_common.h"
#include "../../src/core/vc_crc.h"
#include "vibrocast/decoder.h"

#define EXPORT(name) __attribute__((export_name(#name), visibility("default"))) name

static vc_stream stream;
static const uint8_t *unread; /* of the header */
static size_t left;

static size_t read_header(void *context, uint8_t *data, size_t length)
{
    const size_t taken = length < left ? length : left;
    (void)context;
    memcpy(data, unread, taken);
    unread += taken;
    left -= taken;
    return taken;
}

/* Reads a stream's header, and prepares its decoder in `memory`. `model`: the image that the header names; image and
 * memory stay in place while packets are decoded. Returns as vc_stream_open. */
int EXPORT(open_stream)(const uint8_t *header, size_t length, const uint8_t *model, size_t model_bytes, void *memory,
                        size_t memory_bytes)
{
    unread = header;
    left = length;
    stream.read = read_header;
    stream.model = model;
    stream.model_bytes = model_bytes;
    stream.memory = memory;
    stream.memory_bytes = memory_bytes;
    return vc_stream_open(&stream);
}

/* The size of `memory` that the last stream needs. */
size_t EXPORT(needed_bytes)(void)
{
    return stream.needed_bytes;
}

/* Samples per channel of each packet of the open stream, and of the codec's delay. */
uint32_t EXPORT(packet_samples)(void)
{
    return stream.packet_samples;
}

uint32_t EXPORT(delay_samples)(void)
{
    return stream.delay_samples;
}

/* Decodes the next packet into packet_samples x channels interleaved samples. Returns as vc_stream_feed. */
int EXPORT(decode_packet)(const uint8_t *packet, size_t length, int16_t *samples)
{
    const int status = vc_stream_feed(&stream, packet, length);
    while (status >= VC_OK && vc_stream_poll(&stream, samples) < stream.packet_samples) {
    }
    return status;
}

/* The sentence of a status, which a zero ends. */
const char *EXPORT(status_text)(int status)
{
    return vc_status_text(status);
}

/* CRC-16 of bytes, going on from `start`. */
uint32_t EXPORT(crc16)(const uint8_t *data, size_t length, uint32_t start)
{
    return vc_crc16(data, length, (uint16_t)start);
}

/* COBS: encodes into VC_COBS_BYTES(length) bytes. Returns the bytes written. */
size_t EXPORT(cobs_encode)(const uint8_t *data, size_t length, uint8_t *encoded)
{
    vc_cobs_encoder encoder;
    vc_cobs_begin(&encoder, encoded, VC_COBS_BYTES(length));
    vc_cobs_put(&encoder, data, length);
    return vc_cobs_end(&encoder);
}

/* COBS: decodes in place. Returns the bytes that are left, or -1 for bytes that no encoder makes. */
int32_t EXPORT(cobs_decode)(uint8_t *bytes, size_t length)
{
    size_t decoded;
    return vc_cobs_decode(bytes, length, &decoded) ? -1 : (int32_t)decoded;
}
