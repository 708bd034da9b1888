/* EVA's synthesis in integers: columns of latents to samples; the state between columns belongs to the caller. */
#ifndef VIBROCAST_EVA_SYNTHESIS_H
#define VIBROCAST_EVA_SYNTHESIS_H

#include "vc_eva_model.h"

/* Columns of latents processed at once, so that each weight is loaded once for all of them. */
#define VC_EVA_COLUMNS 4u
#define VC_EVA_HISTORY 2u

/* The last two columns before each convolution; all zero at the start. */
typedef struct {
    int16_t columns[VC_EVA_STAGES][VC_EVA_HISTORY * VC_EVA_MAX_WIDTH];
} vc_eva_history;

/* Working memory, without meaning between calls. */
typedef struct {
    int16_t inputs[4 * VC_EVA_COLUMNS * VC_EVA_MAX_WIDTH];                        /* the input columns of a stage */
    int16_t normalised[(VC_EVA_HISTORY + 4 * VC_EVA_COLUMNS) * VC_EVA_MAX_WIDTH]; /* its history, then its columns */
    int32_t sums[4 * VC_EVA_COLUMNS * VC_EVA_MAX_WIDTH];
} vc_eva_work;

/* Turns `columns` columns of latents, at most VC_EVA_COLUMNS, in work->inputs into as many times 16 samples, `stride`
 * apart. The result is the same however columns are taken together. */
void vc_eva_synthesise(const vc_eva_model *model, vc_eva_history *history, vc_eva_work *work, uint32_t columns,
                       int32_t level, int16_t *samples, unsigned stride);

#endif
