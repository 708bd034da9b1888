/* One row for each codec of the core: its name, and the functions of its decoder, behind one interface. */
#ifndef VIBROCAST_CODEC_H
#define VIBROCAST_CODEC_H

#include <stddef.h>
#include <stdint.h>

#include "vibrocast/config.h"

/* cffi: begin */
/* Callbacks that replace a decoder in C; only a controller that has them knows their content. */
typedef struct vc_decoder_callbacks vc_decoder_callbacks;

/* A stream to decode. The bytes belong to the caller. `tables`: payload of the stream's model image, which must stay
 * valid while a decoder uses it; NULL: the built-in tables. */
typedef struct {
    uint8_t codec; /* identifier */
    uint8_t channels;
    const uint8_t *configuration;
    size_t configuration_length;
    const uint8_t *tables;
    size_t tables_length;
    /* The check fills these:
     * - samples per channel in each packet,
     * - samples per channel by which the output lags the input,
     * - Cortex-M4 cycles, with DSP instructions, that a sample of all channels takes where a stream has 30 dB SNR; 0:
     * not known,
     * - the callbacks that decode the stream; NULL for a codec of the core. */
    uint32_t packet_samples, delay_samples, cycles_per_sample;
    const vc_decoder_callbacks *callbacks;
} vc_coding;
/* cffi: end */

/* A row. `decoder`: memory for the codec's own decoder, struct vc_NAME_decoder, which the caller owns. Any bytes are
 * safe. */
typedef struct {
    uint8_t identifier;
    const char *name;
    size_t decoder_bytes; /* of that memory */
    int needs_tables;     /* there are no built-in tables */
    /* Returns NULL if a decoder takes the tables, else the reason as a text. NULL: the codec takes no tables. */
    const char *(*check_tables)(const uint8_t *tables, size_t length);
    /* Fills in packet_samples and delay_samples. Returns an enum vc_status. */
    int (*check)(vc_coding *coding);
    /* Prepare a decoder for a coding that `check` has accepted, and use it. They work as vc_mdct_decoder_init,
     * vc_mdct_feed and vc_mdct_poll. */
    void (*init)(void *decoder, const vc_coding *coding);
    int (*feed)(void *decoder, const uint8_t *packet, size_t length);
    uint32_t (*poll)(void *decoder, int16_t *samples);
} vc_codec;

#if VC_WITH_MDCT
#define VC_IF_MDCT(CODEC) CODEC(mdct)
#else
#define VC_IF_MDCT(CODEC)
#endif
#if VC_WITH_DCT
#define VC_IF_DCT(CODEC) CODEC(dct)
#else
#define VC_IF_DCT(CODEC)
#endif
#if VC_WITH_SLP
#define VC_IF_SLP(CODEC) CODEC(slp)
#else
#define VC_IF_SLP(CODEC)
#endif
#if VC_WITH_EVA
#define VC_IF_EVA(CODEC) CODEC(eva)
#else
#define VC_IF_EVA(CODEC)
#endif
#if VC_WITH_PARAMETRIC
#define VC_IF_PARAMETRIC(CODEC) CODEC(parametric)
#else
#define VC_IF_PARAMETRIC(CODEC)
#endif

/* The codecs of this build, a line each: vc_NAME_codec is the row, struct vc_NAME_decoder (vc_decoder_memory.h) the
 * memory. */
#define VC_CODECS(CODEC)                                                                                               \
    VC_IF_MDCT(CODEC)                                                                                                  \
    VC_IF_DCT(CODEC)                                                                                                   \
    VC_IF_SLP(CODEC)                                                                                                   \
    VC_IF_EVA(CODEC)                                                                                                   \
    VC_IF_PARAMETRIC(CODEC)

extern const vc_codec vc_mdct_codec, vc_dct_codec, vc_slp_codec, vc_eva_codec, vc_parametric_codec;

/* The codec of an identifier; NULL: this build does not have it. */
const vc_codec *vc_codec_find(uint8_t identifier);

/* Fills in packet_samples and delay_samples of a coding, whose codec is `codec`; NULL: there is none. Returns VC_OK,
 * VC_NO_CODEC, VC_BAD_TABLES, VC_NEEDS_MODEL, VC_HOST_ONLY or VC_BAD_CONFIGURATION. Any bytes are safe. */
int vc_codec_check(const vc_codec *codec, vc_coding *coding);

/* Feeds a packet, and polls it to its end. Returns as vc_mdct_decode. */
static inline int vc_codec_decode(const vc_codec *codec, void *decoder, uint32_t packet_samples, const uint8_t *packet,
                                  size_t length, int16_t *samples)
{
    const int status = codec->feed(decoder, packet, length);
    while (status >= 0 && codec->poll(decoder, samples) < packet_samples) {
    }
    return status;
}

#endif
