/* The codec `dct`: blockwise DCT-II, quantised to a few levels, Huffman or range coded; layout in
 * docs/reference/bitstream.md.
 *
 * Portable C99, no allocation, no libc beyond memcpy and memset, no global state: everything lives in the structure
 * that the caller owns. Packets are independent of each other, so there is no state that a lost one could break.
 */
#ifndef VIBROCAST_DCT_H
#define VIBROCAST_DCT_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_dct_decoder vc_dct_decoder;

/* Bytes of memory, aligned for int64_t, that the caller provides for a decoder. */
size_t vc_dct_decoder_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header, for up to 16 channels (VC_MAX_CHANNELS
 * of vc_common.h). Returns VC_OK or VC_BAD_CONFIGURATION. */
int vc_dct_decoder_init(vc_dct_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels);

/* Samples per channel in every packet of the stream. The output does not lag the input: a block is coded when its last
 * sample is there, and decoded as a whole. */
uint32_t vc_dct_decoder_packet_samples(const vc_dct_decoder *decoder);

/* As the functions of `mdct` with these names. A block is one transform of one channel, in one poll for every 128
 * of its coefficients. No sample is complete before the last channel's blocks. vc_dct_feed returns VC_HOST_ONLY for a
 * stream of whole transforms. A bad packet is no refresh, lacks its ranges, or has an invalid Huffman table or number
 * of levels. A missing packet plays the last samples backwards, faded to zero, then silence. The first samples of the
 * packet that follows rise from zero. */
int vc_dct_feed(vc_dct_decoder *decoder, const uint8_t *packet, size_t length);
uint32_t vc_dct_poll(vc_dct_decoder *decoder, int16_t *samples);
int vc_dct_decode(vc_dct_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Decodes one packet of a stream of whole transforms: writes the coded coefficients, first to end - 1, of channel after
 * channel, in 1/256 of a sample's least significant bit. Returns VC_OK, VC_BAD_PACKET, or VC_BAD_CONFIGURATION for a
 * stream of blocks. For hosts, which have the inverse transform of any length. */
int vc_dct_decode_whole(vc_dct_decoder *decoder, const uint8_t *packet, size_t length, int32_t *coefficients);

/* The number of levels that a code in a packet stands for, 16 codes to an octave of the steps between them. `code`: 0
 * to 230, which are 4 and 63743. For encoders. */
uint32_t vc_dct_levels_of(uint32_t code);

/* Writes the reconstruction levels of one channel of a packet in the order of the coded values, without a zero of its
 * own, in 1/256 of a sample's least significant bit. Returns how many there are: `levels`, or with linear levels one
 * more. `logarithmic`: 0 = linear; `levels`: 4 to 65535; `smallest`, `below`, `above`: range codes of the least
 * magnitude and of the greatest on both sides of zero, the last two not both 0. For encoders. */
uint32_t vc_dct_levels(int logarithmic, uint32_t levels, uint32_t smallest, uint32_t below, uint32_t above,
                       int32_t *output);

/* Range codes the values of one packet: `rows` channels that are not silent, of `blocks` blocks of `bins` values, at
 * most 1024. `zeros`: with logarithmic levels, whether value 0 is zero itself; else 0. Returns the bytes written,
 * VC_PACKET_TOO_LARGE, or VC_BAD_CONFIGURATION for too many bins. For encoders. */
int32_t vc_dct_range_encode(const uint32_t *values, uint32_t rows, uint32_t blocks, uint32_t bins, int logarithmic,
                            int zeros, uint8_t *output, size_t capacity);
/* cffi: end */

#endif
