/* The fuzz targets: each takes any bytes, and stops the program on a fault. FUZZ_TARGET in the environment names it.
 *
 * They run in two programs: that of libFuzzer (`make fuzz`), and that of engine.c, which any Clang compiles, and where
 * it finds less, any compiler. These programs may use an operating system.
 */
#ifndef VIBROCAST_FUZZ_TARGETS_H
#define VIBROCAST_FUZZ_TARGETS_H

#include <stddef.h>
#include <stdint.h>

#include "../src/core/vc_codec.h"

typedef void (*vc_fuzz_target)(const uint8_t *data, size_t length);

/* The bytes of a link, which a reader of frames gets in pieces. */
void vc_fuzz_frames(const uint8_t *data, size_t length);
/* The payload of a frame: the message, the stream header in it, the heads of its packets. */
void vc_fuzz_messages(const uint8_t *data, size_t length);
/* A stream header, and the head of a packet. */
void vc_fuzz_headers(const uint8_t *data, size_t length);
/* A model image, as it is and with its CRC-32 put right. */
void vc_fuzz_images(const uint8_t *data, size_t length);
/* A stream of the codec of this name, in records: the number of channels and the configuration, the model, then
 * packets; an empty one is lost. The model is that of `eva`; of `mdct`, changes of the built-in tables; and none of
 * other codecs. */
#define VC_FUZZ_DECLARED(name) void vc_fuzz_##name(const uint8_t *data, size_t length);
VC_CODECS(VC_FUZZ_DECLARED)
/* The decoder library. Records of its setting and of the model image, which is empty for none; then, by the kind:
 * - 0: a file as it is;
 * - 1: records of a header and of packets, which get the right checksums. A packet begins with a byte, 1 = a refresh;
 * - 2: records of a header and of the packets of a link. An empty one is missing.
 * The setting: a byte each for the kind and the polls of a packet (0: to its end). Two bytes each for the memory (0:
 * what the stream needs), the longest packet, and where the file is cut (0: nowhere). */
void vc_fuzz_streams(const uint8_t *data, size_t length);
/* A stream's way to the DAC: a record of its setting, then records of events; see output.c. */
void vc_fuzz_output(const uint8_t *data, size_t length);
/* A height profile under a hand: a record of its setting, one of its samples, then events; see profile.c. */
void vc_fuzz_profile(const uint8_t *data, size_t length);
/* Records: the two copies of the record, without their CRC-32, and the two slots of a flash, then requests. */
void vc_fuzz_flash(const uint8_t *data, size_t length);
/* Records for a whole controller; a record's first byte is its kind. 0: bytes of the link. 1: a payload that becomes a
 * frame. 2: milliseconds that pass, in two bytes. */
void vc_fuzz_controller(const uint8_t *data, size_t length);

/* Takes the next record off the front of `data`: a length of two bytes and that number of bytes, fewer at the end.
 * Returns whether there was one. The record is a copy of exactly this length, so that a sanitiser sees any read beyond
 * it. The caller frees it. */
int vc_fuzz_record(const uint8_t **data, size_t *length, uint8_t **record, size_t *record_length);

/* Stops the program unless `holds`. */
void vc_fuzz_check(int holds, const char *what);

#endif
