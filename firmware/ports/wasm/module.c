/* The decoders as a WebAssembly module without imports, for docs/javascripts/vibrocast.js.
 *
 * The caller owns the memory from __heap_base on: it puts bytes there, and makes room there for results. The module
 * decodes one stream at a time. */
#include "../../src/core/vc_cobs.h"
#include "../../src/core/vc_crc.h"
#include "../../src/controller/vc_decoders.h"
#include "../../src/controller/vc_model_image.h"
#include "../../src/core/vc_sha256.h"
#include "../../src/controller/vc_stream_header.h"

#define EXPORT(name) __attribute__((export_name(#name), visibility("default"))) name

static vc_stream_header header;
static vc_coding coding;
static vc_decoder decoder;
static vc_rejection rejection;

/* Compares an image with the one that the header names, and gives its tables to the coding. Returns 0, or the
 * rejection's code. */
static int take_image(const uint8_t *image, size_t length)
{
    vc_model_image model;
    uint8_t digest[VC_SHA256_BYTES];
    int rejected = vc_model_image_read(&model, image, length, &rejection);
    if (rejected)
        return rejected;
    vc_sha256(image, vc_model_image_unsigned_bytes(image, length), digest);
    if (!vc_same_bytes(digest, header.image_hash, VC_IMAGE_HASH_BYTES))
        return vc_reject(&rejection, VC_UNKNOWN_IMAGE, "the stream was coded for another model image");
    coding.tables = model.payload.bytes;
    coding.tables_length = model.payload.length;
    return 0;
}

/* Reads a stream's header, and prepares its decoder. `image`: the model image that the header names, which stays in
 * place while packets are decoded; a stream that names none ignores it. Returns 0, or the rejection's code. */
int EXPORT(open_stream)(const uint8_t *data, size_t length, const uint8_t *image, size_t image_length)
{
    int rejected = vc_stream_header_read(&header, data, length, &rejection);
    memset(&coding, 0, sizeof coding);
    coding.codec = header.codec;
    coding.channels = header.output.channels;
    coding.configuration = header.configuration;
    coding.configuration_length = header.configuration_length;
    if (!rejected && header.needs_image)
        rejected = take_image(image, image_length);
    if (!rejected)
        rejected = vc_coding_check(&coding, NULL, &rejection);
    if (!rejected)
        vc_decoder_init(&decoder, &coding);
    return rejected;
}

/* Samples per channel of each packet of the open stream, and of the codec's delay. */
uint32_t EXPORT(packet_samples)(void)
{
    return coding.packet_samples;
}

uint32_t EXPORT(delay_samples)(void)
{
    return coding.delay_samples;
}

/* Decodes the next packet into packet_samples x channels interleaved samples. Returns 0, or -1 for a damaged one. */
int EXPORT(decode_packet)(const uint8_t *packet, size_t length, int16_t *samples)
{
    if (!vc_decoder_feed(&decoder, packet, length))
        return -1;
    while (vc_decoder_poll(&decoder, samples) < coding.packet_samples) {
    }
    return 0;
}

/* The text of the last rejection, without a zero behind it, and its length in bytes. */
const char *EXPORT(rejection_text)(void)
{
    return rejection.text;
}

uint32_t EXPORT(rejection_length)(void)
{
    return rejection.length;
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
