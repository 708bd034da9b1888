/* The output by an amplifier with I2S, such as a MAX98357: both channels, 16 bits, 8 to 96 kHz. RP2040 datasheet: 3
 * (PIO), 2.5 (DMA).
 *
 * Pins: GPIO6 (bit clock), GPIO7 (word select), GPIO8 (data). A program of the PIO shifts out one frame of 32 bits a
 * sample. DMA feeds it from two halves of a buffer in turn, and the interrupt fills the half that is over. So a sample
 * leaves 8 samples after vc_paced_next(), and up to 5 more in the PIO's queue.
 */
#include "vibrocast/actuator_tables.h"
#include "board.h"
#include "paced_output.h"
#include "vibrocast/port.h"

#define HALF 8u /* samples */
#define FIRST_PIN 6u
#define PINS 3u
#define DATA_PIN 2u /* of the three */
#define BITS 16
#define CYCLES 64u        /* of the PIO for a frame: two for each bit */
#define RING_SIZE_BITS 5u /* of the bytes of a half, after which DMA begins it again */

/* Instructions, 3.4. `side`: word select and bit clock meanwhile. */
#define SIDE(side) ((uint16_t)((side) << 11))
#define OUT_PIN(side) (SIDE(side) | 0x6001u)
#define JUMP_X(side, to) (SIDE(side) | 0x0040u | (to))
#define SET_X(side, value) (SIDE(side) | 0xE020u | (value))
#define SET_DIRECTIONS(pins) (0xE080u | (pins))

/* Data change while the bit clock is low, and the amplifier takes them as it rises. Word select changes with the last
 * bit of a channel: in I2S, one bit before the first of the next. */
static const uint16_t program[] = {
    OUT_PIN(0), JUMP_X(1, 0), /* 15 bits of the left channel */
    OUT_PIN(2), SET_X(3, 14), /* its last bit */
    OUT_PIN(2), JUMP_X(3, 4), /* 15 bits of the right channel */
    OUT_PIN(0), SET_X(1, 14), /* its last bit */
};
enum { LAST = sizeof program / sizeof *program - 1 };

const vc_actuator *const vc_output_actuator = &VC_ACTUATOR(vc_lra);
const unsigned vc_output_line = VC_DMA_LINE;

static uint32_t frames[2][HALF] __attribute__((aligned(2 * HALF * sizeof(uint32_t))));

static void fill(unsigned half, const int32_t *(*next)(void))
{
    unsigned sample;
    for (sample = 0; sample < HALF; sample++) {
        const int32_t *level = next();
        frames[half][sample] = (uint32_t)level[0] << BITS | ((uint32_t)level[1] & 0xFFFFu);
    }
}

/* Fills the halves that are over. */
static void refill(const int32_t *(*next)(void))
{
    unsigned half;
    for (half = 0; half < 2; half++)
        if (VC_DMA_INTS0 & 1u << half) {
            VC_DMA_INTS0 = 1u << half;
            fill(half, next);
        }
}

/* The clock has a fraction of 1/256 cycle: at 8000 and 16 000 Hz, no error is left. */
static void start_pio(uint32_t rate_hz)
{
    unsigned place;
    vc_board_enable(VC_RESET_PIO0);
    for (place = 0; place <= LAST; place++)
        VC_PIO_MEMORY(place) = program[place];
    VC_PIO_CLKDIV = (uint32_t)(((uint64_t)VC_PROCESSOR_HZ << 16) / (rate_hz * CYCLES)) & ~0xFFu;
    VC_PIO_EXECCTRL = LAST << VC_PIO_WRAP_TOP;
    VC_PIO_SHIFTCTRL = VC_PIO_AUTOPULL; /* 32 bits, the highest first */
    VC_PIO_PINCTRL = 2u << VC_PIO_SIDE_COUNT | PINS << VC_PIO_SET_COUNT | 1u << VC_PIO_OUT_COUNT |
                     FIRST_PIN << VC_PIO_SIDE_BASE | FIRST_PIN << VC_PIO_SET_BASE |
                     (FIRST_PIN + DATA_PIN) << VC_PIO_OUT_BASE;
    VC_PIO_INSTRUCTION = SET_DIRECTIONS((1u << PINS) - 1);
    VC_PIO_INSTRUCTION = SET_X(0, 14);
    for (place = FIRST_PIN; place < FIRST_PIN + PINS; place++) {
        VC_GPIO_PAD(place) = VC_PAD_4_MA;
        VC_GPIO_CTRL(place) = VC_GPIO_PIO0;
    }
    VC_PIO_CTRL = 1;
}

static void start_dma(void)
{
    uint32_t control;
    unsigned half;
    vc_board_enable(VC_RESET_DMA);
    VC_DMA_INTE0 = 3;
    for (half = 2; half-- > 0;) { /* the first one last: it starts at once, and starts the other */
        VC_DMA_READ(half) = (uint32_t)(uintptr_t)frames[half];
        VC_DMA_WRITE(half) = VC_PIO_QUEUE;
        VC_DMA_COUNT(half) = HALF;
        control = VC_DMA_ENABLE | VC_DMA_WORDS | VC_DMA_READ_ON | RING_SIZE_BITS << VC_DMA_RING_SIZE |
                  (1 - half) << VC_DMA_CHAIN_TO | VC_DMA_PIO0_QUEUE;
        if (half > 0)
            VC_DMA_CONTROL(half) = control;
        else
            VC_DMA_START(half) = control;
    }
    vc_board_enable_interrupt(VC_DMA_LINE, 0);
}

void vc_output_start(void)
{
    vc_paced_start(vc_output_actuator->dac_rate_hz, vc_output_actuator->dac_bits - BITS);
    start_pio(vc_output_actuator->dac_rate_hz);
    start_dma();
}

void vc_output_interrupt(void)
{
    refill(vc_paced_next);
}

/* From full scale to rest within 70 ms. */
static const int32_t *next_of_rest(void)
{
    unsigned step;
    for (step = 1; step < 64; step++)
        (void)vc_paced_rest();
    return vc_paced_rest();
}

void vc_output_rest(void)
{
    for (;;)
        refill(next_of_rest);
}
