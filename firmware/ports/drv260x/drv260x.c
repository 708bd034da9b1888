/* A haptic driver of the DRV260x family as the output: real-time playback (RTP), 8 bits over I2C. */
#include "drv260x.h"

/* An interrupt calls it, perhaps while flash cannot be read. */
#define IN_RAM __attribute__((section(".ramfunc"), noinline))
#define INSIDE_RAM static inline __attribute__((always_inline))

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

#define SETUP 6
#define RETRY_MS 10

static int (*write_register)(uint8_t address, uint8_t value); /* a copy in RAM, and so are the others */
static vc_output_counts *counts;
static uint8_t setup[SETUP][2]; /* registers and their values, in order */
static unsigned done, turn;     /* registers set up; of the refreshes */
static int follows_envelope, was_set_up;
static uint32_t period, left, refresh, retry, wait;
static int32_t highest, last, sent;

static void set_up(unsigned place, uint8_t address, uint8_t value)
{
    setup[place][0] = address;
    setup[place][1] = value;
}

void vc_drv260x_start(const vc_drv260x *used, uint32_t rate_hz)
{
    write_register = used->write;
    counts = used->counts;
    follows_envelope = used->mode == VC_DRV260X_ENVELOPE;
    period = left = rate_hz * VC_DRV260X_ENVELOPE_MS / 1000;
    refresh = rate_hz * VC_DRV260X_REFRESH_MS / 1000;
    retry = rate_hz * RETRY_MS / 1000;
    highest = last = sent = 0;
    done = turn = 0;
    wait = 0;
    was_set_up = 0;
    set_up(0, RTP_INPUT, 0);
    set_up(1, RATED_VOLTAGE, used->rated_voltage);
    set_up(2, OVERDRIVE_CLAMP, used->overdrive_clamp);
    set_up(3, FEEDBACK_CONTROL, (uint8_t)(FEEDBACK_DEFAULT | (follows_envelope ? N_ERM_LRA : 0)));
    set_up(4, CONTROL_3, follows_envelope ? 0 : ERM_OPEN_LOOP);
    set_up(5, MODE, MODE_RTP);
}

/* Returns the highest magnitude at the end of a period, and meanwhile the last one. */
INSIDE_RAM int32_t envelope(int32_t sample)
{
    const int32_t magnitude = sample < 0 ? -sample : sample;
    if (magnitude > highest)
        highest = magnitude;
    if (--left == 0) {
        last = highest;
        left = period;
        highest = 0;
    }
    return last;
}

/* Writes a register. If it is refused, the set-up begins again a little later. */
INSIDE_RAM int is_taken(uint8_t address, uint8_t value)
{
    if (write_register(address, value))
        return 1;
    counts->refused++;
    done = 0;
    wait = retry;
    return 0;
}

/* Takes the next step of the set-up. */
INSIDE_RAM void go_on_with_setup(void)
{
    if (!is_taken(setup[done][0], setup[done][1]) || ++done < SETUP)
        return;
    counts->restarts += (uint32_t)was_set_up;
    was_set_up = 1;
    sent = 0;
    wait = refresh;
}

/* Sends the value again, and every other time a register of the set-up. */
INSIDE_RAM void refresh_chip(int32_t value)
{
    const unsigned place = turn % 2 == 0 ? 0 : turn / 2 + 1; /* the first one is the value's */
    wait = refresh;
    turn = turn + 1 < 2 * (SETUP - 1) ? turn + 1 : 0;
    if (is_taken(setup[place][0], place == 0 ? (uint8_t)value : setup[place][1]) && place == 0)
        sent = value;
}

IN_RAM void vc_drv260x_sample(int32_t sample)
{
    int32_t value = sample < -HIGHEST ? -HIGHEST : sample;
    if (follows_envelope)
        value = envelope(value);
    if (wait > 0)
        wait--;
    if (done < SETUP && wait == 0)
        go_on_with_setup();
    else if (done == SETUP && wait == 0)
        refresh_chip(value);
    else if (done == SETUP && value != sent && is_taken(RTP_INPUT, (uint8_t)value))
        sent = value;
}
