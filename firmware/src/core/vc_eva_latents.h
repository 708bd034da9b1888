/* The adaptive binary arithmetic coder of EVA's latents: contexts for each latent, and levels to bits and back.
 *
 * A level is binarised, and the probability of each decision adapts, as in CABAC (Marpe, Schwarz and Wiegand, "Context-
 * based adaptive binary arithmetic coding in the H.264/AVC video compression standard", 2003). */
#ifndef VIBROCAST_EVA_LATENTS_H
#define VIBROCAST_EVA_LATENTS_H

#include "vc_eva_model.h"

#define VC_EVA_MAX_LEVEL (1 << 22) /* of encoders, in magnitude */

/* Probabilities, in 1/65536, of the decisions on each latent of one channel of the stream: those on the magnitude, then
 * that of the sign. `columns`: coded since the refresh. */
typedef struct {
    uint16_t probabilities[VC_EVA_MAX_WIDTH][VC_EVA_DECISIONS];
    uint32_t columns;
} vc_eva_contexts;

/* At a refresh: the probabilities are those of the model's prior. */
void vc_eva_contexts_reset(vc_eva_contexts *contexts, const vc_eva_model *model);

/* Codes the next column of a channel: model->latents levels, read if `encoding`, else written. Levels that are read
 * count as VC_EVA_MAX_LEVEL at most. */
void vc_eva_code_column(vc_range_coder *coder, int encoding, vc_eva_contexts *contexts, const vc_eva_model *model,
                        int32_t *levels);

#endif
