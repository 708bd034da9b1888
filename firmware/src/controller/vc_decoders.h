/* The codecs of a controller behind one interface, with memory for any of them; a stream's header selects one. */
#ifndef VIBROCAST_DECODERS_H
#define VIBROCAST_DECODERS_H

#include "../core/vc_codec.h"
#include "../core/vc_decoder_memory.h"
#include "vc_messages.h"

/* cffi: begin */
/* Returns whether a codec is in C. */
int vc_codec_is_in_c(uint8_t identifier);

/* Decoders that are not in C, as in a simulated controller. They decode one stream at a time.
 * `codecs`: all that HelloResponse lists, including those in C.
 * `check_tables` and `check` have the tasks of vc_tables_check and vc_coding_check. They return 0 if these callbacks
 * decode, VC_NOT_BY_CALLBACKS to leave it to C, or the rejection's code. C calls them for codecs that it lacks, and for
 * model images. `init`, `feed` and `poll` then replace the functions of vc_decoder below.
 */
struct vc_decoder_callbacks {
    void *context;
    const vc_codec_description *codecs;
    unsigned codec_count;
    int (*check_tables)(void *context, uint8_t codec, const uint8_t *tables, size_t length, vc_rejection *rejection);
    int (*check)(void *context, vc_coding *coding, vc_rejection *rejection);
    void (*init)(void *context, const vc_coding *coding);
    int (*feed)(void *context, const uint8_t *packet, size_t length);
    uint32_t (*poll)(void *context, int16_t *samples);
};
enum { VC_NOT_BY_CALLBACKS = -1 };

/* Returns 0 if a codec's decoder takes the payload of a model image, or the rejection's code, VC_IMAGE_REJECTED. Any
 * bytes are safe. `callbacks`: a vc_decoder_callbacks; NULL = there are none. */
int vc_tables_check(const void *callbacks, uint8_t codec, const uint8_t *tables, size_t length,
                    vc_rejection *rejection);

/* Fills in packet_samples and delay_samples of a coding. Returns 0, or the rejection's code, VC_UNKNOWN_CODEC, if no
 * decoder takes it. Any bytes are safe. `callbacks`: as above. */
int vc_coding_check(vc_coding *coding, const vc_decoder_callbacks *callbacks, vc_rejection *rejection);
/* cffi: end */

/* The number of codecs in C. */
#define VC_ONE(name) +1
enum { VC_CODEC_COUNT = 0 VC_CODECS(VC_ONE) };

/* Writes VC_CODEC_COUNT descriptions. */
void vc_codecs_describe(vc_codec_description *descriptions);

#define VC_DECODER_MEMORY(name) struct vc_##name##_decoder name;

typedef struct {
    const vc_codec *codec;                 /* NULL: */
    const vc_decoder_callbacks *callbacks; /* these decode */
    union {
        VC_CODECS(VC_DECODER_MEMORY)
    } of;
} vc_decoder;

/* Makes a fresh decoder for a coding that vc_coding_check has accepted. */
void vc_decoder_init(vc_decoder *decoder, const vc_coding *coding);

/* Takes the next packet, NULL where it is missing; it must stay valid until its last sample is there. Returns 0, and
 * takes nothing, if that fails. A packet that does not follow the last one fades to silence, as a missing one does. Any
 * bytes are safe. */
int vc_decoder_feed(vc_decoder *decoder, const uint8_t *packet, size_t length);

/* Decodes the next block of the packet, and returns the samples per channel that are complete, from the packet's first
 * one on; packet_samples end it. `samples`: memory for the packet's packet_samples x channels interleaved samples, the
 * same in each call of a packet. */
uint32_t vc_decoder_poll(vc_decoder *decoder, int16_t *samples);

#endif
