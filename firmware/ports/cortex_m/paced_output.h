/* Samples that wait for the interrupt of a board's sample clock, on two channels.
 *
 * The loop hands on no sample while it decodes a block. So the output lags the controller's clock by the length of a
 * packet, at least 1 ms and at most 4 ms. Twice the time by which the stream's first sample came late is added, as far
 * as there is room. If samples come later than that, the output goes to rest, fades back into the stream, and sets the
 * lag again. A Stop drops the samples that wait, so the lag does not delay it.
 */
#ifndef VIBROCAST_PACED_OUTPUT_H
#define VIBROCAST_PACED_OUTPUT_H

#include "vibrocast/settings.h"

#define VC_PACED_CHANNELS 2

/* Prepares the output at rest, before the sample clock runs. `rate_hz`: of this clock. `bits_less`: bits
 * that the output has less than the codes of vc_paced_dac; below 0, more. */
void vc_paced_start(uint32_t rate_hz, int bits_less);

/* Returns the next sample of each channel; 0 = rest. The interrupt of the sample clock calls it, at each sample. */
const int32_t *vc_paced_next(void);

/* For a fault: switches interrupts off and returns the samples one step nearer to rest. */
const int32_t *vc_paced_rest(void);

/* Written in the interrupt of the sample clock alone. A port adds the faults of its chip. */
extern vc_output_counts vc_paced_counts;

extern const vc_dac_port vc_paced_dac;

#endif
