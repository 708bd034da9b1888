/* The learned codec `lapped`: streams of `mdct` with learned windows and learned initial tables. The encoder is that of
 * `mdct`, for coefficients of another analysis. */
#ifndef VIBROCAST_LAPPED_H
#define VIBROCAST_LAPPED_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_lapped_decoder vc_lapped_decoder;

/* Bytes of memory, aligned for int64_t, that the caller provides. */
size_t vc_lapped_decoder_size(void);

/* Bytes of the windows at the beginning of a model; behind them it is one of `mdct`. */
size_t vc_lapped_windows_size(void);

/* Prepares a decoder. `configuration`: the codec's bytes from the stream header, those of `mdct`. `model`: the payload
 * of a model image; it must stay valid while the decoder is used. Returns VC_OK, VC_BAD_TABLES where that is no model,
 * or VC_BAD_CONFIGURATION. */
int vc_lapped_decoder_init(vc_lapped_decoder *decoder, const uint8_t *configuration, size_t configuration_length,
                           unsigned channels, const uint8_t *model, size_t model_length);

/* As the functions of `mdct` with these names. */
uint32_t vc_lapped_decoder_packet_samples(const vc_lapped_decoder *decoder);
uint32_t vc_lapped_decoder_delay_samples(const vc_lapped_decoder *decoder);
int vc_lapped_feed(vc_lapped_decoder *decoder, const uint8_t *packet, size_t length);
uint32_t vc_lapped_poll(vc_lapped_decoder *decoder, int16_t *samples);
int vc_lapped_decode(vc_lapped_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples);
/* cffi: end */

#endif
