/* A haptic driver of the DRV260x family as the output: real-time playback (RTP), 8 bits over I2C.
 *
 * The port calls vc_drv260x_sample() at each sample of vc_paced_dac (paced_output.h), and moves the bytes.
 * docs/how-to/use_a_haptic_driver.md says which vibrations such a driver can render.
 */
#ifndef VIBROCAST_DRV260X_H
#define VIBROCAST_DRV260X_H

#include <stdint.h>

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

/* `rated_voltage`, `overdrive_clamp`: registers 0x16 and 0x17, which belong to the actuator: DRV2605 datasheet
 * (SLOS825), 8.5.2. A full sample is the voltage of `overdrive_clamp` where the waveform is rendered.
 * `write`: sends a value to a register, and need not wait until it is there. It gets six at the start, then one at
 * most a sample. */
typedef struct {
    vc_drv260x_mode mode;
    uint8_t rated_voltage, overdrive_clamp;
    void (*write)(uint8_t address, uint8_t value);
} vc_drv260x;

/* Sets the driver up and brings it to rest. Call it at least 0.25 ms after power-up. `driver` must stay valid.
 * `rate_hz`: of the samples. A write takes 29 bits of I2C: start, three bytes of 9 bits, stop. So 400 kHz carry 13 793
 * samples a second at most. */
void vc_drv260x_start(const vc_drv260x *driver, uint32_t rate_hz);

/* Takes a sample of 8 bits, -128 to 127, 0 = rest. */
void vc_drv260x_sample(int32_t sample);

#endif
