/* The DAC, one sample of both channels at each interrupt of TIM6. RM0090: 14.3 (DAC), 20.3 (timer), 8.3 (pins). */
#include "board.h"
#include "common.h"
#include "port.h"

#define CHANNELS 2
#define REST 2048
/* The output lags the controller's clock by so much, for as long as which decoding a packet may keep the loop. */
#define LEAD_MS 100
#define CAPACITY 2048u /* samples; a power of two */
#define SLOW_MS 50     /* from the end of the range to rest, at boot and when the ring ran dry */

/* Written by the loop, but for `taken`, which the interrupt writes. */
static int16_t ring[CAPACITY][CHANNELS] VC_RING_MEMORY;
static volatile uint32_t put, taken;
static unsigned shift;
static uint32_t lead_samples;

/* Of the interrupt. */
static int32_t level[CHANNELS]; /* code at the output, 12 bits, 0 = rest */
static int32_t slow_step;
static int slow;

void vc_dac_output_start(uint32_t dac_rate_hz, unsigned dac_bits)
{
    unsigned channel;
    shift = dac_bits - 12;
    lead_samples = dac_rate_hz * LEAD_MS / 1000;
    slow_step = (int32_t)(REST * 1000 / (dac_rate_hz * SLOW_MS)) + 1;
    for (channel = 0; channel < CHANNELS; channel++)
        level[channel] = -REST;
    slow = 1;
    VC_RCC_AHB1ENR |= VC_RCC_GPIOA;
    VC_RCC_APB1ENR |= VC_RCC_DAC | VC_RCC_TIM6;
    (void)VC_RCC_APB1ENR;                 /* as in uart.c */
    VC_GPIO_MODER(VC_GPIOA) |= 0xFu << 8; /* PA4 and PA5: analogue */
    VC_DAC_DHR12RD = 0;
    VC_DAC_CR = VC_DAC_EN1 | VC_DAC_EN2;
    VC_TIM6_ARR = VC_APB1_TIMERS_HZ / dac_rate_hz - 1;
    VC_TIM6_DIER = 1;
    VC_TIM6_CR1 = 1;
    vc_enable_interrupt(VC_TIM6_LINE, 0);
}

static inline void write_levels(void)
{
    VC_DAC_DHR12RD = (uint32_t)(level[0] + REST) | (uint32_t)(level[1] + REST) << 16;
}

VC_IN_RAM void TIM6_DAC_IRQHandler(void)
{
    int32_t target[CHANNELS] = {0};
    unsigned channel, there = 0;
    const uint32_t next = taken;
    VC_TIM6_SR = 0;
    if (next != put) {
        for (channel = 0; channel < CHANNELS; channel++)
            target[channel] = ring[next & (CAPACITY - 1)][channel];
        taken = next + 1;
    } else if (level[0] != 0 || level[1] != 0) {
        slow = 1; /* the ring ran dry in the midst of a stream: to rest, and from there back into it */
    }
    for (channel = 0; channel < CHANNELS; channel++) {
        int32_t step = target[channel] - level[channel];
        if (slow && step > slow_step)
            step = slow_step;
        if (slow && step < -slow_step)
            step = -slow_step;
        level[channel] += step;
        there += level[channel] == target[channel];
    }
    if (there == CHANNELS)
        slow = 0;
    write_levels();
}

/* What the ring has no room for is dropped: the loop was kept far longer than LEAD_MS. */
static void put_sample(const int16_t *codes, unsigned channels)
{
    unsigned channel;
    if (put - taken == CAPACITY)
        return;
    for (channel = 0; channel < CHANNELS; channel++)
        ring[put & (CAPACITY - 1)][channel] = channel < channels ? (int16_t)(codes[channel] >> shift) : 0;
    __asm volatile("" ::: "memory"); /* the sample is there before the count says so */
    put++;
}

void vc_port_play(void *context, const int16_t *codes, uint32_t samples, unsigned channels)
{
    uint32_t sample;
    (void)context;
    if (put == taken)
        for (sample = 0; sample < lead_samples; sample++)
            put_sample(NULL, 0);
    for (sample = 0; sample < samples; sample++)
        put_sample(codes + sample * channels, channels);
}

void vc_dac_output_rest(void)
{
    __asm volatile("cpsid i" ::: "memory");
    for (;;) {
        unsigned channel;
        volatile uint32_t turns;
        for (channel = 0; channel < CHANNELS; channel++)
            level[channel] += level[channel] < 0 ? 1 : level[channel] > 0 ? -1 : 0;
        write_levels();
        for (turns = 0; turns < 1000; turns++) {
        }
    }
}
