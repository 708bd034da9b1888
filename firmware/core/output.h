/* The way from decoded samples to DAC codes: unit, joints of iterations, rate, compensation; then gain, fades, limits.
 *
 * Integers only, so that every controller and the host that checks it put out the same codes, to the last bit, however
 * the samples are cut into pieces. Portable C99, no allocation, no global state: everything lives in memory that the
 * caller owns.
 *
 * A drive sample is an int32_t, in 1/1024 of a decoded sample's least significant bit (for acceleration: of the
 * displacement that VC_DISPLACEMENT_SCALE turns it into); the DAC's scale of each channel makes it a code. All that
 * comes before the DAC is linear in the signal, so that neither a weak signal nor a strong gain loses precision.
 */
#ifndef VIBROCAST_OUTPUT_H
#define VIBROCAST_OUTPUT_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */
typedef struct vc_drive vc_drive;
typedef struct vc_dac vc_dac;

/* What the output needs to know of a stream; device_protocol/coded_stream.py. */
typedef struct {
    uint32_t rate_hz;
    uint8_t unit;      /* 0: full scale, 1: m/s^2, 2: um */
    uint8_t channels;  /* 1 to 16 */
    uint16_t gain[16]; /* upper half of the float32 physical value of full scale of each channel: positive, finite */
} vc_output_stream;

/* DAC samples of all channels that each limit changed. */
typedef struct {
    uint32_t compensation_clipped, voltage_limited, slew_limited, power_limited;
} vc_limit_counts;
/* cffi: end */

#endif
