/* The learned part of the context model; see mdct_network.h. */
#include "mdct_network.h"

#include "eva_kernels.h"
#include "mdct_mixing.h"

#define MAX_ACTIVATION 32767
#define INPUT_DIVISOR 4       /* weights in 1/64 times inputs in 1/16, to 1/256 */
#define ACTIVATION_DIVISOR 64 /* weights in 1/64 times activations in 1/256, to 1/256 */

void vc_network_inputs(int16_t *inputs, const vc_model *model, const vc_contexts *contexts, const vc_history *history,
                       const vc_below *below, uint32_t bins, uint32_t k, unsigned quantiser)
{
    const uint8_t *last = history->rows[1] + k + VC_PADDING;
    const uint8_t *second = history->rows[2] + k + VC_PADDING;
    const uint8_t *third = history->rows[3] + k + VC_PADDING;
    const uint16_t *mean = history->mean + k + VC_PADDING;
    /* In 1/8 step. */
    const uint32_t magnitudes[VC_NETWORK_MAGNITUDES] = {
        8 * below->nearest[0],
        8 * below->nearest[1],
        8 * below->nearest[2],
        8u * last[-2],
        8u * last[-1],
        8u * last[0],
        8u * last[1],
        8u * last[2],
        8u * second[-1],
        8u * second[0],
        8u * second[1],
        8u * third[0],
        mean[-1] / 64u,
        mean[0] / 64u,
        mean[1] / 64u,
        8 * below->sum / (k + 1),
        below->mean_sum / (64 * (k + 1)),
        history->mean_sum / (64 * bins),
    };
    unsigned i, decision;
    for (i = 0; i < VC_NETWORK_MAGNITUDES; i++)
        *inputs++ = (int16_t)vc_fine_class(magnitudes[i]);
    *inputs++ = (int16_t)(k * 64 / bins);
    *inputs++ = (int16_t)history->blocks;
    *inputs++ = (int16_t)(bins / 4);
    for (decision = 0; decision < VC_NETWORK_DECISIONS; decision++)
        for (i = 0; i < VC_INPUTS; i++)
            *inputs++ = (int16_t)(vc_stretched(model->probability[decision][quantiser][i][contexts->index[i]]) / 16);
}

/* sums / divisor + biases, from `least` to MAX_ACTIVATION; returns the bytes after the layer. */
static const uint8_t *layer(const uint8_t *bytes, uint32_t outputs, uint32_t inputs, const int16_t *from,
                            int32_t divisor, int32_t least, int16_t *to)
{
    const uint8_t *biases = bytes + outputs * inputs;
    int32_t sums[VC_NETWORK_FIRST];
    uint32_t i;
    vc_dot_products((const int8_t *)bytes, outputs, inputs, from, sums);
    for (i = 0; i < outputs; i++, biases += 2) {
        int32_t value = sums[i] / divisor + (int16_t)(biases[0] | biases[1] << 8);
        to[i] = (int16_t)(value < least ? least : value > MAX_ACTIVATION ? MAX_ACTIVATION : value);
    }
    return biases;
}

void vc_network_run(const uint8_t *network, const int16_t *inputs, unsigned quantiser, int32_t *logits)
{
    int16_t first[VC_NETWORK_FIRST], second[VC_NETWORK_SECOND], last[VC_DECISIONS];
    unsigned i;
    network = layer(network, VC_NETWORK_FIRST, VC_NETWORK_INPUTS, inputs, INPUT_DIVISOR, 0, first);
    network = layer(network, VC_NETWORK_SECOND, VC_NETWORK_FIRST, first, ACTIVATION_DIVISOR, 0, second);
    network += quantiser * VC_DECISIONS * (VC_NETWORK_SECOND + 2);
    layer(network, VC_DECISIONS, VC_NETWORK_SECOND, second, ACTIVATION_DIVISOR, -MAX_ACTIVATION, last);
    for (i = 0; i < VC_DECISIONS; i++)
        logits[i] = vc_clamped(last[i], VC_MAX_STRETCHED);
}
