/* The state of the decoders, for a caller that reserves their memory at compile time.
 *
 * Only the decoders themselves read and write it. */
#ifndef VIBROCAST_DECODER_MEMORY_H
#define VIBROCAST_DECODER_MEMORY_H

#include "vc_block_coder.h"
#include "vc_dct_model.h"
#include "vc_eva_latents.h"
#include "vc_eva_synthesis.h"
#include "vc_mdct_rotation.h"
#include "vc_parametric_frame.h"
#include "vc_slp_frame.h"
#include "vibrocast/decoder.h"

#define VC_HUFFMAN_SYMBOLS 120
#define VC_HUFFMAN_LONGEST_CODE 15

typedef struct {
    vc_block_state block;
    int32_t spectrum[VC_MAX_BINS]; /* of the last block, in 1/256 of a least significant bit */
    int32_t overlap[VC_MAX_BINS];  /* windowed second half of the last block, in the same unit */
} vc_mdct_channel;

struct vc_mdct_decoder {
    vc_mdct_configuration configuration;
    const uint8_t *tables;
    vc_model model;
    vc_quantiser_offset quantiser_offset;
    uint32_t next_sequence;
    int in_sequence; /* packets since the last refresh all came */
    uint32_t random; /* state of the generator that gives signs to fill and concealment */
    vc_mdct_channel channels[VC_MAX_CHANNELS];
    vc_rotation rotation;       /* only where the configuration has one */
    int32_t mixed[VC_MAX_BINS]; /* spectrum of an output channel of the rotation */
    /* Of the packet that is being decoded: its next block and channel, whether all spectra of the block are there and
     * the rotation's output comes next, and where to read it, unless it is concealed. */
    uint32_t block;
    unsigned channel;
    int synthesising;
    int concealing;
    vc_range_coder coder;
};

/* Bits from the highest of each byte on; those past the end are 0. */
typedef struct {
    const uint8_t *bytes;
    size_t length, position; /* in bytes, in bits */
} vc_bit_reader;

/* A canonical Huffman code: how many symbols have each length, and the symbols by length, then by number. */
typedef struct {
    uint8_t lengths[VC_HUFFMAN_LONGEST_CODE + 1];
    uint8_t symbols[VC_HUFFMAN_SYMBOLS];
} vc_huffman_code;

/* A packet that is being read: its ranges, its number of levels, and the source of its values. */
typedef struct {
    const uint8_t *ranges;
    uint32_t levels;
    vc_range_coder range;
    vc_bit_reader bits;
    vc_huffman_code huffman;
    unsigned zeros;
} vc_dct_packet;

struct vc_dct_decoder {
    vc_dct_configuration configuration;
    int rises; /* a packet was missing before the next one */
    int16_t last[VC_MAX_CHANNELS][VC_DCT_FADE_SAMPLES];
    vc_dct_model model;
    int32_t real[VC_DCT_MAX_BLOCK], imaginary[VC_DCT_MAX_BLOCK], spectrum[VC_DCT_MAX_BLOCK];
    /* Of the packet that is being decoded: its next channel, block and coefficient, and how to read it, unless it is
     * concealed. */
    unsigned channel;
    uint32_t block, bin;
    int concealing, sounds; /* `sounds`: the channel is not silent */
    vc_dct_packet packet;
    vc_dct_quantiser quantiser; /* of the channel */
};

struct vc_slp_decoder {
    vc_slp_configuration configuration;
    vc_slp_model model;
    vc_quantiser_offset quantiser_offset;
    uint32_t next_sequence;
    int in_sequence;    /* packets since the last refresh all came */
    uint32_t concealed; /* samples of the gap so far, as long as it sounds */
    vc_slp_channel channels[VC_MAX_CHANNELS];
    int16_t last[VC_MAX_CHANNELS][VC_SLP_MAX_FRAME]; /* the last frame played */
    /* Of the packet that is being decoded: its next frame, where to read it unless it is concealed, and whether the
     * packet rises from silence. */
    uint32_t index;
    int concealing, rising;
    vc_range_coder coder;
};

typedef struct {
    int32_t spectrum[VC_MAX_BINS];                   /* of the last block, in 1/256 of a least significant bit */
    int32_t overlap[VC_MAX_BINS];                    /* windowed second half of the last block, in the same unit */
    int32_t amplitudes[VC_PARAMETRIC_MAX_HARMONICS]; /* of the ridges after the last block, in the same unit */
    uint32_t turn;                                   /* of their phase from sample to sample, in 1/2^32 turn */
    vc_parametric_frame frame;                       /* that is being played */
    uint32_t random;                                 /* state of the generator that gives the frame's noise its signs */
} vc_parametric_synthesis;

struct vc_parametric_decoder {
    vc_parametric_configuration configuration;
    vc_parametric_model model;
    uint32_t next_sequence;
    int in_sequence; /* packets since the last refresh all came */
    uint32_t random; /* state of the generator that gives noise its signs, at the next frame */
    vc_parametric_channel channels[VC_MAX_CHANNELS];
    vc_parametric_synthesis synthesis[VC_MAX_CHANNELS];
    /* Of the packet that is being decoded: its next block, where to read its frames unless it is concealed, and whether
     * it is a refresh. */
    uint32_t block;
    int concealing, refresh;
    vc_range_coder coder;
};

typedef struct {
    vc_eva_contexts contexts;
    vc_eva_history history;
    int16_t latents[VC_EVA_MAX_WIDTH]; /* of the last column */
} vc_eva_channel;

struct vc_eva_decoder {
    vc_eva_model model;
    vc_eva_configuration configuration;
    vc_quantiser_offset quantiser_offset;
    uint32_t next_sequence;
    int in_sequence; /* packets since the last refresh all came */
    uint32_t random; /* state of the generator that gives concealment its signs */
    vc_eva_channel channels[VC_MAX_CHANNELS];
    vc_eva_work work;
    /* Of the packet that is being decoded: its next channel and column, and where to read it, unless it is concealed.
     */
    unsigned channel;
    uint32_t column;
    int concealing;
    vc_range_coder coder;
    uint32_t inputs; /* columns before `column` whose latents are in work.inputs, and wait for the network */
};

/* The constants of vibrocast/decoder.h have room for them. */
#define VC_FITS(decoder, words) (sizeof(struct decoder) <= (words) * sizeof(int64_t))
typedef char vc_decoders_fit[VC_FITS(vc_mdct_decoder, VC_MDCT_WORDS) && VC_FITS(vc_dct_decoder, VC_DCT_WORDS) &&
                                     VC_FITS(vc_slp_decoder, VC_SLP_WORDS) && VC_FITS(vc_eva_decoder, VC_EVA_WORDS) &&
                                     VC_FITS(vc_parametric_decoder, VC_PARAMETRIC_WORDS)
                                 ? 1
                                 : -1];

#endif
