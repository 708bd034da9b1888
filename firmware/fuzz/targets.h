/* The fuzz targets: each takes any bytes, and stops the program on a fault.
 *
 * They run in two programs: libFuzzer's, which looks for new inputs (`make fuzz`), and replay.c, which runs those of
 * the corpus and changed copies of them. These programs may use an operating system.
 */
#ifndef VIBROCAST_FUZZ_TARGETS_H
#define VIBROCAST_FUZZ_TARGETS_H

#include <stddef.h>
#include <stdint.h>

typedef void (*vc_fuzz_target)(const uint8_t *data, size_t length);

/* The bytes of a link, which a reader of frames gets in pieces. */
void vc_fuzz_frames(const uint8_t *data, size_t length);
/* The payload of a frame: the message, the stream header in it, the heads of its packets. */
void vc_fuzz_messages(const uint8_t *data, size_t length);
/* A model image, as it is and with its CRC-32 put right. */
void vc_fuzz_images(const uint8_t *data, size_t length);
/* Records: the tables of a model (none: the built-in ones), a stream header, then packets; an empty one is lost. */
void vc_fuzz_streams(const uint8_t *data, size_t length);
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

/* libFuzzer's interface; the environment variable FUZZ_TARGET names the target. */
int LLVMFuzzerInitialize(int *argument_count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length);

#endif
