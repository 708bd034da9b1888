/* One row for each codec of the core: what it is called, and the functions that decode it, behind one interface. */
#ifndef VIBROCAST_CODEC_H
#define VIBROCAST_CODEC_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
/* Calls that take the place of a decoder in C; only a controller that has them knows what they are. */
typedef struct vc_decoder_callbacks vc_decoder_callbacks;

/* A stream to decode; the bytes belong to the caller. `tables`: payload of the model image that the stream needs, which
 * must stay valid while a decoder uses it; NULL = those built in. */
typedef struct {
    uint8_t codec; /* identifier */
    uint8_t channels;
    const uint8_t *configuration;
    size_t configuration_length;
    const uint8_t *tables;
    size_t tables_length;
    /* The check fills these: samples per channel in each packet, by which of them the output lags the input, and the
     * callbacks that decode the stream; NULL = a codec of the core does. */
    uint32_t packet_samples, delay_samples;
    const vc_decoder_callbacks *callbacks;
} vc_coding;
/* cffi: end */

/* A row. `decoder` is memory for the codec's own decoder. Any bytes are safe. */
typedef struct {
    uint8_t identifier;
    const char *name;
    int needs_tables; /* none are built in */
    /* Returns NULL if a decoder takes the tables, else why it does not. NULL: the codec takes none. */
    const char *(*check_tables)(const uint8_t *tables, size_t length);
    /* Finds packet_samples and delay_samples. Returns an enum vc_status. */
    int (*check)(vc_coding *coding);
    /* Make a decoder of what `check` has passed, and use it: as vc_mdct_decoder_init and the functions below it. */
    void (*init)(void *decoder, const vc_coding *coding);
    int (*decode)(void *decoder, const uint8_t *packet, size_t length, int16_t *samples);
    void (*conceal)(void *decoder, int16_t *samples);
} vc_codec;

/* The codecs of the core, a line each: vc_NAME_codec is the row, struct vc_NAME_decoder (decoder_memory.h) the memory.
 */
#define VC_CODECS(CODEC)                                                                                               \
    CODEC(mdct)                                                                                                        \
    CODEC(dct)                                                                                                         \
    CODEC(slp)                                                                                                         \
    CODEC(eva)                                                                                                         \
    CODEC(lapped)                                                                                                      \
    CODEC(parametric)

#define VC_CODEC_DECLARED(name) extern const vc_codec vc_##name##_codec;
VC_CODECS(VC_CODEC_DECLARED)

#endif
