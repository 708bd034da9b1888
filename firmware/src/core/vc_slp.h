/* The codec `slp`: sparse linear prediction, closed loop, its residual quantised in the DCT domain.
 *
 * Decoder, and the encoder's integer half that mirrors it; the predictors are found in codec/slp.py. The layout of
 * streams is in docs/reference/bitstream.md. Statuses are those of vibrocast/status.h. */
#ifndef VIBROCAST_SLP_H
#define VIBROCAST_SLP_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
#define VC_SLP_SILENT 32768
typedef struct vc_slp_decoder vc_slp_decoder;
typedef struct vc_slp_encoder vc_slp_encoder;

/* Bytes of memory, aligned for int64_t, that the caller provides for each structure. */
size_t vc_slp_decoder_size(void);
size_t vc_slp_encoder_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header. Returns VC_OK or
 * VC_BAD_CONFIGURATION. The first packet must be a refresh packet. */
int vc_slp_decoder_init(vc_slp_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels);

/* Samples per channel in every packet of the stream. The output does not lag the input. */
uint32_t vc_slp_decoder_packet_samples(const vc_slp_decoder *decoder);

/* As the functions of `mdct` with these names; a block is a frame. Any bytes are safe: the synthesis filter is stable
 * for each of them. A concealed packet fades the last sound to zero within the packet or its first 256 samples. */
int vc_slp_feed(vc_slp_decoder *decoder, const uint8_t *packet, size_t length);
uint32_t vc_slp_poll(vc_slp_decoder *decoder, int16_t *samples);
int vc_slp_decode(vc_slp_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);

/* Prepares an encoder. `refresh_packets`: packets from one refresh to the next, 0 = only the first packet is one.
 * `rounding`: what is added to a magnitude in steps before its fraction is dropped, in 1/256; 128 = plain rounding. */
int vc_slp_encoder_init(vc_slp_encoder *encoder, const uint8_t *configuration, size_t configuration_length,
                        unsigned channels, uint32_t refresh_packets, uint32_t rounding);

/* Codes one packet. `samples`: frames x channels x frame length, in 1/256 of a 16-bit sample's least significant bit,
 * within full scale. `reflections`: frames x channels x order, codes, -15 to 15, of the predictor that suits each
 * frame; the encoder keeps the one before where that is cheaper. `quantiser_offset`: of a rate-controlled stream, in
 * 1/16 octave of the steps, or VC_SLP_SILENT: nothing but silence, whatever the samples; others ignore it. Returns the
 * bytes written to `packet`, or VC_PACKET_TOO_LARGE. */
int32_t vc_slp_encode(vc_slp_encoder *encoder, const int32_t *samples, const int8_t *reflections,
                      int32_t quantiser_offset, uint8_t *packet, size_t capacity);
/* cffi: end */

#endif
