/* Packets to spectra, for codecs whose streams differ from `mdct` only in the synthesis. */
#ifndef VIBROCAST_MDCT_DECODER_H
#define VIBROCAST_MDCT_DECODER_H

#include "decoder_memory.h"

/* Turns a channel's spectrum into its next hop samples, as many values apart as the stream has channels. */
typedef void (*vc_synthesis)(vc_mdct_decoder *decoder, unsigned channel, int16_t *samples);

/* As vc_mdct_decode and vc_mdct_conceal. */
int vc_spectra_decode(vc_mdct_decoder *decoder, const uint8_t *packet, size_t length, vc_synthesis synthesise,
                      int16_t *samples);
void vc_spectra_conceal(vc_mdct_decoder *decoder, vc_synthesis synthesise, int16_t *samples);

#endif
