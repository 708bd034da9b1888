/* The codecs that a controller decodes, behind one interface: memory for any of them, chosen by a stream's header. */
#ifndef VIBROCAST_DECODERS_H
#define VIBROCAST_DECODERS_H

#include "codec.h"
#include "decoder_memory.h"
#include "messages.h"

/* cffi: begin */
/* Returns whether a codec is in C. */
int vc_codec_is_in_c(uint8_t identifier);

/* Decoders that are not in C, as a simulated controller may have. They decode one stream at a time.
 * `codecs`: all that hello lists, those in C among them.
 * `check_tables` and `check` do what vc_tables_check and vc_coding_check do. They return 0 for what these callbacks
 * decode, VC_NOT_BY_CALLBACKS to leave it to the decoders in C, or the rejection's code. C asks them about codecs that
 * it does not have, and about model images. `init`, `decode` and `conceal` then do what the functions in C do. */
struct vc_decoder_callbacks {
    void *context;
    const vc_codec_description *codecs;
    unsigned codec_count;
    int (*check_tables)(void *context, uint8_t codec, const uint8_t *tables, size_t length, vc_rejection *rejection);
    int (*check)(void *context, vc_coding *coding, vc_rejection *rejection);
    void (*init)(void *context, const vc_coding *coding);
    int (*decode)(void *context, const uint8_t *packet, size_t length, int16_t *samples);
    void (*conceal)(void *context, int16_t *samples);
};
enum { VC_NOT_BY_CALLBACKS = -1 };

/* Returns 0 if a codec's decoder takes the payload of a model image, or the rejection's code, VC_IMAGE_REJECTED. Any
 * bytes are safe. `callbacks`: a vc_decoder_callbacks; NULL = there are none. */
int vc_tables_check(const void *callbacks, uint8_t codec, const uint8_t *tables, size_t length,
                    vc_rejection *rejection);
/* cffi: end */

/* How many codecs are in C. */
#define VC_ONE(name) +1
enum { VC_CODEC_COUNT = 0 VC_CODECS(VC_ONE) };

/* Writes them: VC_CODEC_COUNT descriptions. */
void vc_codecs_describe(vc_codec_description *descriptions);

#define VC_DECODER_MEMORY(name) struct vc_##name##_decoder name;

typedef struct {
    const vc_codec *codec;                 /* NULL: */
    const vc_decoder_callbacks *callbacks; /* these decode */
    union {
        VC_CODECS(VC_DECODER_MEMORY)
    } of;
} vc_decoder;

/* Finds what the packets of a stream are. Returns 0, or the rejection's code, VC_UNKNOWN_CODEC, where it cannot be
 * decoded. Any bytes are safe. `callbacks`: as above. */
int vc_coding_check(vc_coding *coding, const vc_decoder_callbacks *callbacks, vc_rejection *rejection);

/* Makes a fresh decoder of what vc_coding_check has passed. */
void vc_decoder_init(vc_decoder *decoder, const vc_coding *coding);

/* Decodes the next packet into packet_samples x channels interleaved samples. Returns whether that could be done; if
 * not, nothing is written. A packet that does not follow the last one fades to silence. Any bytes are safe. */
int vc_decoder_decode(vc_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Stands in for one missing packet: packet_samples x channels samples, the last sound faded out, then silence. */
void vc_decoder_conceal(vc_decoder *decoder, int16_t *samples);

#endif
