/* Rotation of the channels of `mdct`, by bands, and a delay for each channel: redundant channels become few. */
#ifndef VIBROCAST_MDCT_ROTATION_H
#define VIBROCAST_MDCT_ROTATION_H

#include "vc_mdct_state.h"

#define VC_ROTATION_BANDS 4
#define VC_MAX_DELAY 63 /* samples */

typedef struct {
    /* By band: whether it mixes channels; and the weight of a coded channel (column) in an output channel (row), in
     * 1/2^24 of its octaves. Without mixing only the diagonal counts. */
    uint8_t mixes[VC_ROTATION_BANDS];
    int32_t weight[VC_ROTATION_BANDS][VC_MAX_CHANNELS][VC_MAX_CHANNELS];
    uint8_t octaves[VC_MAX_CHANNELS]; /* by which an output channel's step exceeds that of the coded channels */
    uint8_t delay[VC_MAX_CHANNELS], next[VC_MAX_CHANNELS]; /* next: where a line's oldest sample is */
    int16_t line[VC_MAX_CHANNELS][VC_MAX_DELAY];
} vc_rotation;

/* Checks the section of a configuration that holds a rotation. Returns the bytes that it takes, 0 if it is not valid.
 * `longest`: becomes the longest delay in samples. */
size_t vc_rotation_check(const uint8_t *section, size_t length, unsigned channels, uint32_t *longest);

/* Prepares the rotation of a section that was found valid; its configuration has the steps of the channels. */
void vc_rotation_init(vc_rotation *rotation, const vc_mdct_configuration *configuration, const uint8_t *section);

/* Mixes the coded channels into one output channel. `coded`: the spectrum of each coded channel, `stride` values apart.
 * `spectrum`: becomes that of the output channel, hop coefficients within +-VC_MAX_COEFFICIENT. */
void vc_rotate(const vc_rotation *rotation, const int32_t *coded, size_t stride, unsigned channels, uint32_t hop,
               unsigned channel, int32_t *spectrum);

/* Delays the next `count` samples of a channel, which are `stride` values apart. */
void vc_delay(vc_rotation *rotation, unsigned channel, int16_t *samples, uint32_t count, unsigned stride);

#endif
