/* Samples that wait for the interrupt of a board's sample clock: paced_output.h says how the output lags. */
#include "paced_output.h"
#include "cortex_m.h"
#include "vibrocast/port.h"

#define CHANNELS VC_PACED_CHANNELS
#define SHORTEST_LAG_US 1000
#define LONGEST_LAG_US 4000 /* before any sample came late */
#define CAPACITY 4096u      /* samples; a power of two */
#define SPARE 64u           /* samples beyond the lag: the ramp to rest comes at once, in one piece */
#define FADE_MS 20          /* to rest, and back, where samples are missing or dropped: a Stop is at rest in 30 ms */
#define ONE 32768           /* of the parts of a fade: the difference of two samples of 16 bits, times this, fits */

/* Written by the loop. */
static int16_t ring[CAPACITY][CHANNELS] VC_CORE_MEMORY;
static volatile uint32_t put;
static uint32_t rate_hz, least_lag_samples, lag_samples;
static int shift;

/* Written by the interrupt; by the loop as well where the ring is empty, or with interrupts off. */
static volatile uint32_t taken;
static volatile uint32_t waiting; /* samples to wait before the next is taken */
static volatile int broken;       /* the next sample does not follow the last output */
static volatile int missing;      /* the stream goes on, but the ring is empty */
vc_output_counts vc_paced_counts;

/* Of the interrupt. */
static int playing;                                   /* the last sample came from the ring */
static int away;                                      /* the last one that did was not rest */
static int32_t level[CHANNELS], faded_from[CHANNELS]; /* 0 = rest; `level`: at the output */
static int32_t fade_samples, fade_left, fade_part;

static uint32_t samples_in(uint64_t us)
{
    return (uint32_t)(us * rate_hz / 1000000);
}

void vc_paced_start(uint32_t sample_rate_hz, int bits_less)
{
    shift = bits_less;
    rate_hz = sample_rate_hz;
    lag_samples = least_lag_samples = samples_in(LONGEST_LAG_US);
    fade_samples = (int32_t)samples_in(FADE_MS * 1000) + 1;
    fade_part = ONE / fade_samples;
}

VC_IN_RAM const int32_t *vc_paced_next(void)
{
    int32_t target[CHANNELS] = {0};
    const uint32_t next = taken;
    const int taking = next != put && waiting == 0;
    const int stopping = playing && !taking && (level[0] != 0 || level[1] != 0);
    unsigned channel;
    int32_t faded;
    if (stopping || (taking && broken)) {
        for (channel = 0; channel < CHANNELS; channel++)
            faded_from[channel] = level[channel];
        fade_left = fade_samples;
        broken = stopping;
    }
    if (stopping && away && !missing) {
        missing = 1;
        vc_paced_counts.gaps++;
    }
    vc_paced_counts.late_samples += missing && !taking;
    if (taking) {
        for (channel = 0; channel < CHANNELS; channel++)
            target[channel] = ring[next & (CAPACITY - 1)][channel];
        away = target[0] != 0 || target[1] != 0;
        taken = next + 1;
        missing = 0;
    } else if (waiting > 0) {
        waiting--;
    }
    playing = taking;
    if (fade_left > 0)
        fade_left--;
    faded = fade_left * fade_part; /* the Cortex-M0+ divides by a function, which is in flash */
    for (channel = 0; channel < CHANNELS; channel++)
        level[channel] = target[channel] + (faded_from[channel] - target[channel]) * faded / ONE;
    return level;
}

static int16_t as_output(int16_t code)
{
    return (int16_t)(shift >= 0 ? code >> shift : code * (1 << -shift));
}

static void put_sample(const int16_t *codes, unsigned channels)
{
    unsigned channel;
    for (channel = 0; channel < CHANNELS; channel++)
        ring[put & (CAPACITY - 1)][channel] = channel < channels ? as_output(codes[channel]) : 0;
    __asm volatile("" ::: "memory"); /* the sample is stored before the count says so */
    put++;
}

/* The ring was empty: sets the lag, during which its samples wait. It grows only, until the stream is dropped. */
static void begin_lag(uint64_t due_us)
{
    /* Rounded up: a block that comes as late as the first one must not miss the lag by a part of a sample. */
    const uint32_t late = samples_in(vc_port_now_us() - due_us) + 1, needed = least_lag_samples + 2 * late;
    if (lag_samples < needed)
        lag_samples = needed < CAPACITY - 2 * SPARE ? needed : CAPACITY - 2 * SPARE;
    waiting = late < lag_samples ? lag_samples - late : 0;
}

/* Lets no sample wait longer than the lag; part of it has passed already if many samples come at once. If something
 * else stopped the loop for long, drops the oldest samples. */
static void keep_lag(void)
{
    uint32_t held;
    __asm volatile("cpsid i" ::: "memory");
    held = put - taken;
    if (waiting + held > lag_samples)
        waiting = held < lag_samples ? lag_samples - held : 0;
    if (held > lag_samples + SPARE) {
        taken = put - lag_samples;
        broken = 1;
    }
    __asm volatile("cpsie i" ::: "memory");
}

static void play(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    uint32_t sample;
    (void)context;
    if (put == taken)
        begin_lag(due_us);
    for (sample = 0; sample < samples; sample++)
        put_sample(codes + sample * channels, channels);
    keep_lag();
}

static void begin(void *context, uint32_t packet_us)
{
    const uint32_t lag_us = packet_us < SHORTEST_LAG_US ? SHORTEST_LAG_US : packet_us;
    (void)context;
    least_lag_samples = samples_in(lag_us < LONGEST_LAG_US ? lag_us : LONGEST_LAG_US);
    if (put == taken)
        lag_samples = least_lag_samples;
}

/* The output goes to rest from the next interrupt on. */
static void drop(void *context)
{
    unsigned channel;
    (void)context;
    __asm volatile("cpsid i" ::: "memory");
    taken = put;
    waiting = 0;
    lag_samples = least_lag_samples;
    missing = playing = 0;
    broken = 1;
    for (channel = 0; channel < CHANNELS; channel++)
        faded_from[channel] = level[channel];
    fade_left = fade_samples;
    __asm volatile("cpsie i" ::: "memory");
}

static void count(void *context, vc_output_counts *filled)
{
    (void)context;
    __asm volatile("cpsid i" ::: "memory");
    *filled = vc_paced_counts;
    __asm volatile("cpsie i" ::: "memory");
}

const vc_dac_port vc_paced_dac = {.play = play, .begin = begin, .drop = drop, .count = count};

const int32_t *vc_paced_rest(void)
{
    unsigned channel;
    __asm volatile("cpsid i" ::: "memory");
    for (channel = 0; channel < CHANNELS; channel++)
        level[channel] += level[channel] < 0 ? 1 : level[channel] > 0 ? -1 : 0;
    return level;
}
