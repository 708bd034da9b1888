/* Decodes a .vct file, or a stream that arrives in packets: all that you need without a controller.
 *
 * Fill in the first members of a vc_stream, and open it. vc_stream_next takes each packet, and vc_stream_poll decodes
 * its blocks into your memory.
 * firmware/examples/decode.c is a whole program. docs/how-to/use_the_decoder.md has sizes and lists of sources.
 *
 * - Samples are int16_t; 32768 = full scale. Channels are interleaved. Numbers of samples are per channel.
 * - You own the structure and all memory. Nothing is allocated. There is no global state. You need not clear the
 *   structure, and there is nothing to close.
 * - Call a stream from one thread or interrupt at a time; different streams need no lock.
 * - Any bytes are safe: of a file, a packet or a model image. So is any order of calls after vc_stream_open, also one
 *   that failed. Pointers are not checked.
 * - The deepest call takes 4 kB of stack on a 32-bit processor; the page has the figure of each codec.
 */
#ifndef VIBROCAST_DECODER_H
#define VIBROCAST_DECODER_H

#include <stddef.h>
#include <stdint.h>

#include "config.h"
#include "status.h"

#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

/* Memory for the decoder of any stream that this build takes: `static int64_t memory[VC_DECODER_WORDS]`. The macros of
 * the codecs are upper bounds, which are checked when the decoders are compiled. */
#define VC_DECODER_WORDS                                                                                               \
    VC_LARGER(VC_WITH_EVA ? VC_EVA_WORDS : 0,                                                                          \
              VC_LARGER(VC_LARGER(VC_WITH_MDCT ? VC_MDCT_WORDS : 0, VC_WITH_DCT ? VC_DCT_WORDS : 0),                   \
                        VC_LARGER(VC_WITH_SLP ? VC_SLP_WORDS : 0, VC_WITH_PARAMETRIC ? VC_PARAMETRIC_WORDS : 0)))
#define VC_MDCT_WORDS (1818 + 279 * VC_MAX_CHANNELS + 2 * VC_MAX_CHANNELS * VC_MAX_CHANNELS)
#define VC_DCT_WORDS (2127 + 17 * VC_MAX_CHANNELS)
#define VC_SLP_WORDS (101 + 174 * VC_MAX_CHANNELS)
#define VC_EVA_WORDS (2148 + 737 * VC_MAX_CHANNELS)
#define VC_PARAMETRIC_WORDS (76 + 189 * VC_MAX_CHANNELS)
#define VC_LARGER(a, b) ((a) > (b) ? (a) : (b))

/* cffi: begin */
/* Your function: copies the next `length` bytes of the file into `data`. Returns how many there were: fewer only at the
 * end of the file. */
typedef size_t (*vc_stream_read)(void *context, uint8_t *data, size_t length);

typedef struct {
    /* You set these before vc_stream_open. The memory stays yours, and must stay in place while you use the stream. */
    vc_stream_read read;  /* vc_stream_open and vc_stream_next call it */
    void *context;        /* argument of `read` */
    void *memory;         /* of the decoder, aligned for int64_t */
    size_t memory_bytes;  /* vc_stream_open sets `needed_bytes` if that is too small */
    uint8_t *packet;      /* holds one packet; NULL if you call vc_stream_feed only */
    size_t packet_bytes;  /* of the longest packet, its number included, and 2 more; at least 8, at most 65 537 */
    const uint8_t *model; /* the model image (.vcmi) that the stream was coded for, read in place; NULL: none */
    size_t model_bytes;

    /* vc_stream_open sets these, if it returns VC_OK or VC_TOO_SMALL. */
    const char *codec; /* its name, a constant */
    uint64_t samples;  /* of the recording; UINT64_MAX: a live stream, whose length is open */
    uint32_t rate_hz;  /* samples a second; of a height profile, a metre */
    uint8_t unit;      /* 0: full scale, 1: m/s^2, 2: um, 3: um over position (a height profile) */
    uint8_t channels;  /* 1 to VC_MAX_CHANNELS */
    uint16_t gain[16]; /* of each channel: upper half of the float32 physical value of full scale */
    uint32_t packet_samples, delay_samples; /* of each packet; by which the output lags the recording */
    size_t needed_bytes;                    /* of `memory` */

    /* vc_stream_next and vc_stream_feed set these: samples `first` to `last` - 1 of the packet are the recording's. The
     * others are the codec's delay and what fills the last packet. */
    uint32_t first, last;

    /* Private. */
    const void *decodes;
    uint64_t number;
    uint32_t decoded;
    int ended;
    uint16_t crc;
    uint8_t one_packet;
} vc_stream;

/* Reads a stream's header with `read`, and prepares its decoder. Returns VC_OK, VC_BAD_HEADER, VC_NO_CODEC,
 * VC_BAD_CONFIGURATION, VC_HOST_ONLY, VC_NEEDS_MODEL, VC_BAD_TABLES or VC_TOO_SMALL. */
int vc_stream_open(vc_stream *stream);

/* Reads the next packet of a .vct file with `read`, and checks it. Returns VC_OK, and VC_END behind the last packet.
 * Poll the packet before to its end first, or what follows sounds otherwise until the next refresh. Use either this
 * function or vc_stream_feed for a stream.
 * Any error ends the stream, and each later call returns it again: the error of vc_stream_open, VC_CUT,
 * VC_BAD_CHECKSUM, VC_BAD_PACKET, or VC_PACKET_TOO_LARGE for one longer than packet_bytes. */
int vc_stream_next(vc_stream *stream);

/* Takes the next packet of a link in place of vc_stream_next, its number included; NULL where it is missing. Its bytes
 * must stay in place until its last block has been polled. You order packets and drop late ones. Returns VC_OK;
 * VC_CONCEALED where the packet is missing or follows a missing one: its samples fade to silence; VC_BAD_PACKET, and
 * there is nothing to poll: feed NULL in its place; or the error of vc_stream_open. */
int vc_stream_feed(vc_stream *stream, const uint8_t *packet, size_t length);

/* Decodes the next block of the packet, and returns the samples that are complete, from the packet's first one on;
 * packet_samples end it. After the end, and without a packet, it does nothing but return them. `samples`: memory for
 * packet_samples x channels, the same in each call of a packet. */
uint32_t vc_stream_poll(vc_stream *stream, int16_t *samples);

/* Returns an English sentence for an enum vc_status, a constant which a zero ends. Any number is safe. */
const char *vc_status_text(int status);
/* cffi: end */

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
