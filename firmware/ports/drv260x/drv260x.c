/* A haptic driver of the DRV260x family as the output: real-time playback (RTP), 8 bits over I2C. */
#include "drv260x.h"

/* An interrupt calls it, perhaps while flash cannot be read. */
#define IN_RAM __attribute__((section(".ramfunc"), noinline))

/* DRV2605 datasheet (SLOS825), 8.6. Both modes take signed input: 127 is full drive. Below zero, the open loop drives
 * the other way, and the closed loop brakes. */
enum {
    MODE = 0x01,
    RTP_INPUT = 0x02,
    RATED_VOLTAGE = 0x16,
    OVERDRIVE_CLAMP = 0x17,
    FEEDBACK_CONTROL = 0x1A,
    CONTROL_3 = 0x1D,
    MODE_RTP = 5,            /* of MODE: out of standby, real-time playback */
    N_ERM_LRA = 1 << 7,      /* of FEEDBACK_CONTROL: the actuator is an LRA */
    FEEDBACK_DEFAULT = 0x36, /* its other bits, as after power-up: brake factor 4, medium loop gain, back-EMF gain */
    ERM_OPEN_LOOP = 1 << 5,  /* of CONTROL_3, whose other bits are 0: signed input, no noise gate */
    HIGHEST = 127
};

static void (*write_register)(uint8_t address, uint8_t value); /* a copy in RAM, and so are the others */
static int follows_envelope;
static uint32_t period, left;
static int32_t highest, last;

void vc_drv260x_start(const vc_drv260x *used, uint32_t rate_hz)
{
    write_register = used->write;
    follows_envelope = used->mode == VC_DRV260X_ENVELOPE;
    period = left = rate_hz * VC_DRV260X_ENVELOPE_MS / 1000;
    highest = last = 0;
    used->write(RTP_INPUT, 0);
    used->write(RATED_VOLTAGE, used->rated_voltage);
    used->write(OVERDRIVE_CLAMP, used->overdrive_clamp);
    used->write(FEEDBACK_CONTROL, (uint8_t)(FEEDBACK_DEFAULT | (follows_envelope ? N_ERM_LRA : 0)));
    used->write(CONTROL_3, follows_envelope ? 0 : ERM_OPEN_LOOP);
    used->write(MODE, MODE_RTP);
}

/* Returns the highest magnitude at the end of a period, and meanwhile the last one. */
static inline int32_t envelope(int32_t sample)
{
    const int32_t magnitude = sample < 0 ? -sample : sample;
    int32_t value = last;
    if (magnitude > highest)
        highest = magnitude;
    if (--left == 0) {
        value = highest;
        left = period;
        highest = 0;
    }
    return value;
}

IN_RAM void vc_drv260x_sample(int32_t sample)
{
    int32_t value = sample < -HIGHEST ? -HIGHEST : sample;
    if (follows_envelope)
        value = envelope(value);
    if (value != last)
        write_register(RTP_INPUT, (uint8_t)value);
    last = value;
}
