/* A driver chip with a queue of samples as the output: blocks over SPI, and no interrupt for each sample.
 *
 * The chip is like a BOS1901: 64 samples of 12 bits at 8000 Hz by a clock of its own. Its registers are written here
 * from memory and no chip has run this: check them with the datasheet. A word has 4 bits of address and 12 of data, and
 * each transfer returns the register that CONFIG names. docs/how-to/use_a_board.md says how it plays.
 */
#include "vibrocast/settings.h"

enum {
    REFERENCE = 0x0 << 12, /* queues a sample */
    CONFIG = 0x5 << 12,
    RETURN_STATUS = 0xC << 7, /* of CONFIG: each transfer returns the register 0xC */
    OUTPUT_ON = 1 << 4,
    PLAY_8_KHZ = 7,
    ROOM = 0x7F /* of the status: samples that the queue has room for */
};
#define QUEUE 64u
#define BITS 12
#define LONGEST_BLOCK 32u /* of vc_dac_port.play */
#define LAG 24u           /* samples queued at the start: 3 ms, in which a block is decoded */
#define LEAST 16u         /* fewer, after a pause or as the chip's clock is ahead: a sample is played twice */
#define MOST (QUEUE - LONGEST_BLOCK) /* more: it is behind, and a sample is left out */
#define REFRESH_US 40000u

static uint16_t (*transfer)(uint16_t word);
static vc_output_counts counts;
static int16_t last;
static uint64_t refreshed_us;

/* Sets the chip up, which changes nothing unless it has lost its power. Returns the samples that wait. */
static uint32_t queued(void)
{
    uint32_t room;
    (void)transfer(CONFIG | RETURN_STATUS | OUTPUT_ON | PLAY_8_KHZ);
    room = transfer(CONFIG | RETURN_STATUS | OUTPUT_ON | PLAY_8_KHZ) & ROOM;
    if (room <= QUEUE)
        return QUEUE - room;
    counts.refused++; /* there is no chip */
    return QUEUE;
}

static void queue(int16_t code, uint32_t times)
{
    for (; times > 0; times--)
        (void)transfer((uint16_t)(REFERENCE | ((code >> (16 - BITS)) & 0xFFF)));
    last = code;
}

static void play(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    const uint32_t waiting = queued();
    uint32_t sample;
    (void)context;
    refreshed_us = due_us;
    if (waiting == QUEUE)
        return;
    counts.gaps += waiting == 0 && last != 0;
    /* At rest, the queue is filled up to the lag. Away from rest, one sample more or less keeps the clocks together. */
    if (waiting < LEAST)
        queue(last, waiting == 0 || last == 0 ? LAG - waiting : 1);
    for (sample = waiting > MOST; sample < samples; sample++)
        queue(codes[sample * channels], 1);
}

static void count(void *context, vc_output_counts *filled)
{
    (void)context;
    *filled = counts;
}

/* What waits is played first: at most 8 ms. */
const vc_dac_port vc_fifo_dac = {.play = play, .count = count};

/* Brings the chip to rest. `used`: transfers a word over SPI in both directions. */
void vc_fifo_start(uint16_t (*used)(uint16_t word))
{
    transfer = used;
    last = 0;
    refreshed_us = 0;
    (void)queued();
    queue(0, 1);
}

/* For the main loop: sends the last code again every 40 ms, in case the chip has lost it. */
void vc_fifo_turn(uint64_t now_us)
{
    if (now_us - refreshed_us < REFRESH_US)
        return;
    refreshed_us = now_us;
    if (queued() == 0)
        queue(last, 1);
}
