/* A haptic driver of the DRV260x family as the output: real-time playback (RTP), 8 bits over I2C.
 *
 * The port calls vc_drv260x_sample() at each sample of vc_paced_dac (paced_output.h), and moves the bytes.
 * docs/how-to/use_a_board.md says which vibrations such a driver can render.
 */
#ifndef VIBROCAST_DRV260X_H
#define VIBROCAST_DRV260X_H

#include "vibrocast/settings.h"

#define VC_DRV260X_ADDRESS 0x5Au /* on I2C, 7 bits */

typedef enum {
    /* The driver is an amplifier with an 8-bit input: each sample is a voltage. For voice coils, and for linear
     * resonant actuators whose response the controller compensates. Open loop, as for ERMs. */
    VC_DRV260X_WAVEFORM,
    /* The driver finds the resonance of a linear resonant actuator, and vibrates it there. Samples set the amplitude
     * alone: every VC_DRV260X_ENVELOPE_MS the driver gets the highest magnitude since. The waveform is lost. */
    VC_DRV260X_ENVELOPE
} vc_drv260x_mode;

/* About a period of a resonance of 200 Hz. */
#define VC_DRV260X_ENVELOPE_MS 5
#define VC_DRV260X_REFRESH_MS 40

/* `rated_voltage`, `overdrive_clamp`: registers 0x16 and 0x17, which belong to the actuator: DRV2605 datasheet
 * (SLOS825), 8.5.2. A full sample is the voltage of `overdrive_clamp` where the waveform is rendered.
 * `write`: hands a value for a register to the bus, and need not wait until it is there. It returns 1, or 0 if the bus
 * does not take it, or if the chip did not acknowledge the value before. It gets one at most a sample.
 * `counts`: where values that were refused and restarts are counted. */
typedef struct {
    vc_drv260x_mode mode;
    uint8_t rated_voltage, overdrive_clamp;
    int (*write)(uint8_t address, uint8_t value);
    vc_output_counts *counts;
} vc_drv260x;

/* Prepares for samples; the first ones bring the driver to rest and set it up. The first comes at least 0.25 ms after
 * power-up. `driver` must stay valid. `rate_hz`: of the samples. A write takes 29 bits of I2C: start, three bytes of 9
 * bits, stop. So 400 kHz carry 13 793 samples a second at most. */
void vc_drv260x_start(const vc_drv260x *driver, uint32_t rate_hz);

/* Takes a sample of 8 bits, -128 to 127, 0 = rest.
 *
 * The driver holds a value until the next one, so none may be lost. Every VC_DRV260X_REFRESH_MS the last value is sent
 * again, or a register of the set-up in turn, in case the chip has lost its power. Where a value is refused, the driver
 * comes to rest and is set up again. */
void vc_drv260x_sample(int32_t sample);

#endif
