/* Configuration, syntax of a frame, transform, lattice filter and steps of `slp`; see vc_slp_frame.h. */
#include "vc_slp_frame.h"

#define ADAPTATION 5u
#define LOWEST_OCTAVE 4 /* of the threshold table: 16 Hz */
/* Contexts of single bins adapt as those of single latents do; see vc_eva_latents.c. */
#define FAST_FRAMES 8u
#define MEDIUM_FRAMES 24u

int vc_slp_configuration_read(vc_slp_configuration *configuration, const uint8_t *bytes, size_t length,
                              unsigned channels)
{
    vc_slp_configuration read;
    unsigned channel;
    memset(&read, 0, sizeof read);
    if (channels < 1 || channels > VC_MAX_CHANNELS ||
        !vc_rate_control_read(bytes, length, 5 + (size_t)channels, &read.rate_controlled))
        return VC_BAD_CONFIGURATION;
    read.frame = 32u << (bytes[0] >> 5 & 3u);
    read.contexts = (uint16_t)(bytes[0] & 128u ? read.frame : VC_SLP_NEIGHBOUR_CONTEXTS);
    read.order = bytes[0] & 31u;
    read.packet_frames = bytes[1] | (uint32_t)bytes[2] << 8;
    read.shaping = bytes[3];
    read.rate_code = bytes[4];
    read.channels = channels;
    if (read.frame > VC_SLP_MAX_FRAME || read.order > VC_SLP_MAX_ORDER || read.packet_frames < 1 ||
        read.packet_frames > VC_SLP_MAX_PACKET_FRAMES || read.rate_code >= VC_SLP_RATE_CODES)
        return VC_BAD_CONFIGURATION;
    for (channel = 0; channel < channels; channel++) {
        if (bytes[5 + channel] >= VC_SLP_STEP_CODES)
            return VC_BAD_CONFIGURATION;
        read.log_step[channel] = 3 * 256 + 32 * bytes[5 + channel];
    }
    *configuration = read;
    return VC_OK;
}

/* Class of a number on a logarithmic scale, four to the octave. */
static uint32_t scale_class(uint32_t x)
{
    unsigned exponent;
    if (x < 4)
        return x;
    exponent = vc_floor_log2(x);
    return 4 * (exponent - 1) + ((x >> (exponent - 2)) & 3u);
}

/* Smallest number of a class. */
static uint32_t class_start(uint32_t number)
{
    return number < 4 ? number : (4 + (number & 3u)) << (number / 4 - 1);
}

/* Whether magnitudes have a context a bin, in place of those by neighbours. */
static int by_bin(const vc_slp_configuration *configuration)
{
    return configuration->contexts == configuration->frame;
}

void vc_slp_model_reset(vc_slp_model *model, const vc_slp_configuration *configuration)
{
    unsigned context, i;
    /* Assumes that magnitudes have a geometric distribution with the mean that the context expects (in 1/64). */
    for (context = 0; context < VC_SLP_NEIGHBOUR_CONTEXTS; context++) {
        const uint32_t expected = class_start(context) + class_start(context + 1);
        const uint32_t odds = by_bin(configuration) ? VC_UNTRAINED / 4 : 65535u * expected / (expected + 128);
        for (i = context; i < VC_SLP_LEVEL_PROBABILITIES; i += VC_SLP_NEIGHBOUR_CONTEXTS)
            model->level[i] = (uint16_t)odds;
    }
    model->frames = 0;
    model->silent[0] = model->silent[1] = model->silent[2] = VC_UNTRAINED / 8;
    model->silent[3] = VC_UNTRAINED;
    model->changed[0] = model->changed[1] = VC_UNTRAINED / 4;
    for (i = 0; i < VC_SLP_MAX_ORDER; i++)
        model->reflection_differs[i] = model->reflection_sign[i] = VC_UNTRAINED;
    for (i = 0; i < VC_SLP_MAX_REFLECTION; i++)
        model->reflection_above[i] = VC_UNTRAINED;
}

void vc_slp_channel_reset(vc_slp_channel *channel, const vc_slp_configuration *configuration, unsigned number)
{
    memset(channel, 0, sizeof *channel);
    vc_slp_log_steps(configuration, number, channel->reflections, channel->log_steps);
}

/* One adaptive decision, either way. */
static int coded(vc_range_coder *coder, int encoding, int bit, uint16_t *probability)
{
    return vc_adaptive_code(coder, encoding, bit, probability, ADAPTATION);
}

/* Codes a predictor as differences, modulo the number of codes, to the channel's last one. */
static void code_reflections(vc_range_coder *coder, int encoding, vc_slp_model *model, const int8_t *last,
                             int8_t *reflections, unsigned order)
{
    const int codes = 2 * VC_SLP_MAX_REFLECTION + 1;
    unsigned i;
    for (i = 0; i < order; i++) {
        int difference = encoding ? reflections[i] - last[i] : 0, magnitude = 0, negative;
        if (difference > VC_SLP_MAX_REFLECTION)
            difference -= codes;
        if (difference < -VC_SLP_MAX_REFLECTION)
            difference += codes;
        if (coded(coder, encoding, difference != 0, &model->reflection_differs[i])) {
            negative = coded(coder, encoding, difference < 0, &model->reflection_sign[i]);
            magnitude = 1;
            while (magnitude < VC_SLP_MAX_REFLECTION &&
                   coded(coder, encoding, (negative ? -difference : difference) > magnitude,
                         &model->reflection_above[magnitude]))
                magnitude++;
            difference = negative ? -magnitude : magnitude;
        }
        difference += last[i];
        reflections[i] = (int8_t)(difference > VC_SLP_MAX_REFLECTION    ? difference - codes
                                  : difference < -VC_SLP_MAX_REFLECTION ? difference + codes
                                                                        : difference);
    }
}

/* Context of bin k: the class of its expected magnitude, in 1/64, from its neighbours in this and the last frame, and
 * from the averages over time. */
static unsigned level_context(const vc_slp_channel *channel, uint32_t k)
{
    const uint8_t *now = channel->now + k + 2, *last = channel->last + k + 2;
    const uint16_t *average = channel->average + k + 2;
    uint32_t expected = 14u * (now[-1] + now[-2]) + 4u * (last[-1] + last[0] + last[1] + last[2]) +
                        (28u * (average[-1] + average[0] + average[1]) >> 8);
    return scale_class(expected >> 1);
}

/* `probability`: of the first decision in this context. Those of the next ones lie `contexts` further on each, and
 * end before `end`. */
static int32_t code_level(vc_range_coder *coder, int encoding, uint16_t *probability, const uint16_t *end,
                          uint32_t contexts, unsigned shift, int32_t level)
{
    const uint32_t wanted = (uint32_t)(level < 0 ? -level : level);
    uint32_t magnitude = 0;
    int negative;
    while (magnitude < VC_SLP_UNARY_LIMIT &&
           vc_adaptive_code(coder, encoding, wanted > magnitude, probability, shift)) {
        magnitude++;
        if (end - probability > (ptrdiff_t)contexts)
            probability += contexts;
    }
    if (magnitude == VC_SLP_UNARY_LIMIT) {
        if (encoding) {
            vc_golomb_encode(coder, wanted - VC_SLP_UNARY_LIMIT);
            magnitude = wanted;
        } else {
            magnitude += vc_golomb_decode(coder);
        }
    }
    if (magnitude == 0)
        return 0;
    negative = level < 0;
    if (encoding)
        vc_range_encode(coder, negative, VC_EVEN_ODDS);
    else
        negative = (int)vc_range_decode_bits(coder, 1);
    return negative ? -(int32_t)magnitude : (int32_t)magnitude;
}

void vc_slp_code_frame(vc_range_coder *coder, int encoding, vc_slp_model *model, vc_slp_channel *channel,
                       const vc_slp_configuration *configuration, unsigned number, vc_slp_frame *frame)
{
    const unsigned shift = !by_bin(configuration)
                               ? ADAPTATION
                               : ADAPTATION - (model->frames < FAST_FRAMES) - (model->frames < MEDIUM_FRAMES);
    const uint32_t contexts = configuration->contexts;
    const uint16_t *const end = &model->level[VC_SLP_LEVEL_PROBABILITIES / contexts * contexts];
    uint32_t k;
    frame->silent = coded(coder, encoding, frame->silent, &model->silent[channel->silent_history]);
    channel->silent_history = (uint8_t)((channel->silent_history << 1 | frame->silent) & 3);
    if (frame->silent)
        memset(frame->levels, 0, sizeof frame->levels);
    if (!frame->silent && configuration->order > 0) {
        int changed = 0;
        for (k = 0; k < configuration->order; k++)
            changed |= frame->reflections[k] != channel->reflections[k];
        changed = coded(coder, encoding, changed, &model->changed[channel->changed]);
        channel->changed = (uint8_t)changed;
        if (changed) {
            code_reflections(coder, encoding, model, channel->reflections, frame->reflections, configuration->order);
            memcpy(channel->reflections, frame->reflections, sizeof channel->reflections);
            vc_slp_log_steps(configuration, number, channel->reflections, channel->log_steps);
        }
    }
    for (k = 0; k < configuration->frame; k++) {
        uint32_t magnitude;
        if (!frame->silent) {
            const uint32_t context = by_bin(configuration) ? k : level_context(channel, k);
            frame->levels[k] =
                code_level(coder, encoding, &model->level[context], end, contexts, shift, frame->levels[k]);
        }
        magnitude = (uint32_t)(frame->levels[k] < 0 ? -frame->levels[k] : frame->levels[k]);
        channel->now[k + 2] = (uint8_t)(magnitude < 126 ? magnitude : 126);
    }
    for (k = 2; k < configuration->frame + 2; k++)
        channel->average[k] = (uint16_t)(channel->average[k] - (channel->average[k] >> 3) + 32u * channel->now[k]);
    memcpy(channel->last, channel->now, sizeof channel->last);
    memset(channel->now, 0, sizeof channel->now);
    model->frames = (uint8_t)(model->frames + (model->frames < MEDIUM_FRAMES));
}

int32_t vc_slp_log2(uint64_t value)
{
    unsigned exponent = 0;
    if (value == 0)
        return 0;
    while (value >> exponent > 1)
        exponent++;
    return (int32_t)(256 * exponent + ((exponent > 8 ? value >> (exponent - 8) : value << (8 - exponent)) & 255u));
}

/* 2^(x / 256), straight lines between powers of two; 1 to 2^26. */
static int32_t power_of_two(int32_t x)
{
    uint32_t exponent, mantissa;
    if (x <= 0)
        return 1;
    if (x >= 26 * 256)
        return 1 << 26;
    exponent = (uint32_t)x >> 8;
    mantissa = 256 + ((uint32_t)x & 255u);
    return (int32_t)(exponent > 8 ? mantissa << (exponent - 8) : mantissa >> (8 - exponent));
}

/* sin(code pi / 32) in 1/2^24: the cosine table has 256 steps in a quarter turn. */
static int32_t reflection_value(int code)
{
    return vc_cosine[(unsigned)(256 - 16 * code) & 1023u];
}

/* Rounds towards zero. */
static int64_t scaled(int64_t value, unsigned bits)
{
    return value / ((int64_t)1 << bits);
}

/* Detection threshold above its least at the centre of bin k, (2 k + 1) rate / (4 N), in 1/256 octave. */
static int32_t threshold(const vc_slp_configuration *configuration, uint32_t k)
{
    int32_t frequency =
        vc_slp_log2(2 * k + 1) + 32 * (int32_t)configuration->rate_code - 256 * 2 - vc_slp_log2(configuration->frame);
    int32_t index = (frequency - 256 * LOWEST_OCTAVE + 16) / 32;
    return vc_slp_threshold[index < 0 ? 0 : index > 56 ? 56 : index];
}

int32_t vc_slp_step(int32_t log_step, const vc_quantiser_offset *quantiser_offset)
{
    return power_of_two(log_step + 16 * quantiser_offset->value);
}

void vc_slp_log_steps(const vc_slp_configuration *configuration, unsigned number, const int8_t *reflections,
                      int32_t *log_steps)
{
    int64_t direct[VC_SLP_MAX_ORDER + 1] = {1 << 16}; /* A(z) in 1/2^16, by the step-up recursion */
    const unsigned order = configuration->order;
    const uint32_t frame = configuration->frame;
    unsigned i, m;
    uint32_t k;
    for (m = 1; m <= order; m++) {
        const int64_t reflection = reflection_value(reflections[m - 1]);
        for (i = 0; i <= m / 2; i++) {
            int64_t low = direct[i], high = direct[m - i];
            direct[i] = low + scaled(reflection * high, 24);
            direct[m - i] = high + scaled(reflection * low, 24);
        }
    }
    for (k = 0; k < frame; k++) {
        int64_t real = 0, imaginary = 0;
        int32_t log_gain;
        for (i = 0; i <= order; i++) {
            uint32_t angle = 2 * i * (2 * k + 1) * (VC_SLP_MAX_FRAME / frame);
            real += direct[i] * vc_cosine[angle & 1023u];
            imaginary += direct[i] * vc_cosine[(angle + 256) & 1023u];
        }
        real = scaled(real, 28); /* now in 1/2^12 */
        imaginary = scaled(imaginary, 28);
        log_gain = vc_slp_log2((uint64_t)(real * real + imaginary * imaginary)) / 2 - 12 * 256;
        log_steps[k] = configuration->log_step[number] + log_gain +
                       (int32_t)(configuration->shaping * (uint32_t)threshold(configuration, k) / 256);
    }
}

int32_t vc_slp_reconstruct(int32_t level, int32_t step)
{
    return vc_limited((int64_t)level * step);
}

/* Factor of bin k that makes the transform orthonormal, in 1/2^24: sqrt(2 / N), for bin 0 sqrt(1 / N). */
static int32_t norm(uint32_t frame, uint32_t k)
{
    const uint32_t doubled = frame * (k == 0 ? 2 : 1);
    return doubled == 32 ? 4194304 : doubled == 64 ? 2965821 : doubled == 128 ? 2097152 : 1482910;
}

/* cos(pi (2 n + 1) k / (2 N)) in 1/2^24. */
static int32_t basis(uint32_t frame, uint32_t n, uint32_t k)
{
    return vc_cosine[2 * (2 * n + 1) * k * (VC_SLP_MAX_FRAME / frame) & 1023u];
}

void vc_slp_dct(const int32_t *values, uint32_t frame, int32_t *spectrum)
{
    int64_t folded[VC_SLP_MAX_FRAME], differences[VC_SLP_MAX_FRAME / 2];
    uint32_t n, k, half;
    folded[0] = 0; /* a compiler cannot know that frame is above 0 */
    for (n = 0; n < frame; n++)
        folded[n] = values[n];
    /* Odd bins take the differences of opposite values. Even bins are a transform, half as long, of their sums. */
    for (half = frame / 2; half > 0; half /= 2) {
        for (n = 0; n < half; n++) {
            differences[n] = folded[n] - folded[2 * half - 1 - n];
            folded[n] += folded[2 * half - 1 - n];
        }
        for (k = frame / half / 2; k < frame; k += frame / half) {
            int64_t sum = 0;
            for (n = 0; n < half; n++)
                sum += differences[n] * basis(frame, n, k);
            spectrum[k] = vc_limited(scaled(scaled(sum, 24) * norm(frame, k), 24));
        }
    }
    spectrum[0] = vc_limited(scaled(folded[0] * norm(frame, 0), 24));
}

void vc_slp_inverse_dct(const int32_t *spectrum, uint32_t frame, int32_t *values)
{
    int64_t sums[VC_SLP_MAX_FRAME];
    uint32_t n, k;
    memset(sums, 0, sizeof sums);
    for (k = 0; k < frame; k++) {
        const int64_t weighted = scaled((int64_t)spectrum[k] * norm(frame, k), 20); /* in 1/16 */
        for (n = 0; n < frame && weighted != 0; n++)
            sums[n] += weighted * basis(frame, n, k);
    }
    for (n = 0; n < frame; n++)
        values[n] = vc_limited(scaled(sums[n] + (sums[n] < 0 ? -(1 << 27) : 1 << 27), 28));
}

/* Product of a value and a reflection coefficient, rounded towards zero, so that the filter's ringing dies out. */
static int32_t reflected(int8_t code, int32_t value)
{
    return (int32_t)scaled((int64_t)reflection_value(code) * value, 24);
}

static int32_t limited(int32_t value, int32_t limit)
{
    return value > limit ? limit : value < -limit ? -limit : value;
}

/* A backward error, as kept for the next sample. */
static int32_t kept(int32_t error)
{
    return limited((int32_t)scaled((int64_t)error * 255, 8), VC_SLP_MAX_STATE);
}

void vc_slp_analyse(const vc_slp_configuration *configuration, const int8_t *reflections, int32_t *backward,
                    const int32_t *samples, int32_t *residual)
{
    uint32_t n;
    unsigned i;
    for (n = 0; n < configuration->frame; n++) {
        int32_t forward = samples[n], error = samples[n];
        for (i = 0; i < configuration->order; i++) {
            const int32_t delayed = backward[i];
            backward[i] = kept(error);
            error = delayed + reflected(reflections[i], forward);
            forward += reflected(reflections[i], delayed);
        }
        residual[n] = forward;
    }
}

void vc_slp_synthesise(const vc_slp_configuration *configuration, const int8_t *reflections, int32_t *backward,
                       const int32_t *residual, int32_t *samples)
{
    uint32_t n;
    unsigned i;
    for (n = 0; n < configuration->frame; n++) {
        int32_t forward = limited(residual[n], VC_SLP_MAX_RESIDUAL);
        for (i = configuration->order; i-- > 0;) {
            forward -= reflected(reflections[i], backward[i]);
            backward[i + 1] = kept(backward[i] + reflected(reflections[i], forward));
        }
        backward[0] = kept(forward);
        samples[n] = forward;
    }
}
